"""Odd values, and good bytes and JSON that were spoilt."""

import json
import math
from typing import Any

import numpy as np

Rng = np.random.Generator

WORDS = ("", " ", "nan", "-", "--", "\0", "é", "🏖", "\ud800", "../../x", "/", ".", "x" * 300, "a\nb", "1e999", "٣", "#.S")
NUMBERS = (
    0,
    -0.0,
    1,
    -1,
    2,
    0.5,
    1e-300,
    1e308,
    -1e308,
    1e39,
    math.nan,
    math.inf,
    -math.inf,
    2**31,
    2**63,
    -(2**63) - 1,
    10**400,
)
TEXTS = (
    "0",
    "-1",
    "1e999",
    "nan",
    "inf",
    "-9999",
    "99999999999999999999",
    "1" * 5000,
    "0x10",
    "1_0",
    "",
    "x",
    "1e-320",
    "٣",
)


def pick(rng: Rng, some: Any) -> Any:
    """One of several."""
    return some[int(rng.integers(len(some)))]


def value(rng: Rng, deep: int = 2) -> Any:
    """Something that JSON can hold, seldom what is wanted."""
    kind = int(rng.integers(8))
    if kind < 3:
        return pick(rng, NUMBERS)
    if kind == 3:
        return float(rng.normal())
    if kind == 4:
        return pick(rng, (None, True, False))
    if kind == 5 or not deep:
        return pick(rng, WORDS)
    if kind == 6:
        return [value(rng, deep - 1) for _ in range(rng.integers(5))]
    return {str(pick(rng, WORDS)): value(rng, deep - 1) for _ in range(rng.integers(4))}


def spoilt(rng: Rng, thing: Any) -> Any:
    """A copy of what JSON holds, with one part of it changed, taken out, doubled or put elsewhere."""
    if not isinstance(thing, dict | list) or not thing or rng.random() < 0.15:
        return value(rng)
    if isinstance(thing, dict):
        key = pick(rng, sorted(thing))
        less = {k: v for k, v in thing.items() if k != key}
        more = thing | {str(pick(rng, WORDS)): value(rng)}
        return _one(rng, less, more, thing | {key: spoilt(rng, thing[key])})
    at = int(rng.integers(len(thing)))
    less, more = thing[:at] + thing[at + 1 :], thing[:at] + [thing[at]] * int(rng.integers(1, 5)) + thing[at:]
    return _one(rng, less, more, [*thing[:at], spoilt(rng, thing[at]), *thing[at + 1 :]])


def _one(rng: Rng, less: Any, more: Any, other: Any) -> Any:
    """One of the three, mostly the last."""
    return less if rng.random() < 0.15 else more if rng.random() < 0.1 else other


def as_json(rng: Rng, thing: Any) -> bytes:
    """A spoilt thing as JSON, whose bytes are spoilt now and then."""
    for _ in range(rng.integers(1, 4)):
        thing = spoilt(rng, thing)
    text = json.dumps(thing).encode()
    return spoilt_bytes(rng, text) if rng.random() < 0.3 else text


def spoilt_bytes(rng: Rng, good: bytes) -> bytes:
    """A file with up to four faults: bits turned, parts cut out, doubled, written over or put in."""
    data = bytearray(good)
    for _ in range(rng.integers(1, 5)):
        at, long = int(rng.integers(len(data) + 1)), int(rng.integers(1, 40))
        kind = int(rng.integers(6))
        if kind == 0 and at < len(data):
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + long]
        elif kind == 3:
            data[at:at] = data[at : at + long] * int(rng.integers(1, 30))
        elif kind == 4:
            data[at : at + long] = rng.bytes(long)
        else:
            data[at:at] = pick(rng, TEXTS).encode()
    return bytes(data)


def spoilt_words(rng: Rng, good: str) -> bytes:
    """A text of which some words were replaced, left out or doubled; or its bytes spoilt."""
    if rng.random() < 0.2:
        return spoilt_bytes(rng, good.encode())
    lines = [line.split(" ") for line in good.split("\n")]
    for _ in range(rng.integers(4)):
        line = pick(rng, lines)
        at = int(rng.integers(len(line)))
        kind = int(rng.integers(4))
        if kind < 2:
            line[at] = pick(rng, TEXTS + WORDS)
        elif kind == 2:
            line.insert(at, pick(rng, TEXTS))
        elif len(lines) > 1:
            lines.insert(int(rng.integers(len(lines))), lines.pop(int(rng.integers(len(lines)))))
    return "\n".join(" ".join(line) for line in lines).encode(errors="surrogatepass")


def array(rng: Rng) -> np.ndarray:
    """An array of some dtype and shape, with some cells that are no heights."""
    shape = pick(rng, ((), (0,), (3,), (12, 12), (12, 12), (1, 1), (0, 4), (2, 3, 4), (1, 12), (200, 1)))
    dtype = pick(rng, ("f8", "f4", "f2", ">f8", "i4", "u8", "i1", "?", "c16", "U3", "S2", "M8[s]", "V4", "g"))
    some = rng.normal(size=shape) * 10.0 ** float(rng.integers(-3, 4))
    if rng.random() < 0.5 and some.size:
        some = np.where(rng.random(shape) < 0.1, pick(rng, (math.nan, math.inf, -9999, 1e300)), some)
    if rng.random() < 0.1:
        return np.zeros(shape, [("a", "f4"), ("b", "i2")])
    with np.errstate(all="ignore"):
        plain = some if np.dtype(dtype).kind in "fcUS" else np.clip(np.nan_to_num(some), 0, 100)
        return np.zeros(shape, dtype) if np.dtype(dtype).kind == "V" else plain.astype(dtype)
