"""Dataclasses read from what JSON holds: each field says what it takes, and a mistake is told by the field's name.

radius: Annotated[float, LENGTH]
"""

import reprlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from numbers import Real
from typing import Any, Protocol, TypeVar, get_type_hints

import numpy as np

T = TypeVar("T")

FAR = 1e4
"""The largest coordinate or height (m), which leaves floats exact to far below a cell."""


class Reader(Protocol):
    """What a field takes: `what` says it in words, `read` checks a value and returns it as the field holds it."""

    @property
    def what(self) -> str:
        """What to give, in words."""

    def read(self, name: str, value: Any) -> Any:
        """The value as it is kept; ValueError with the field's name, the value and the remedy if it is none."""


def read_object(kind: type[T], name: str, value: Any, others: tuple[str, ...] = ()) -> T:
    """An object of a dataclass from a JSON object whose keys are its fields, and perhaps `others`.

    Args:
      kind: the dataclass, whose fields are annotated with readers. A field may end in _ where its key is a word of Python.
      name: of the object, for messages; empty for the outermost.
      value: what JSON holds.
      others: keys that are read elsewhere.

    Raises:
      ValueError: for what is no object, an unknown or a missing key, or a value that its field does not take.
    """
    if not isinstance(value, dict):
        raise wrong(name or "drawing", value, "an object {...} of named fields")
    known = {f.name.rstrip("_"): f for f in fields(kind)}  # type: ignore[arg-type]
    hints = get_type_hints(kind, include_extras=True)
    prefix = f"{name}." if name else ""
    for key in value:
        if key not in known and key not in others:
            raise ValueError(f"{prefix}{_plain(key)}: is no field here; give some of {', '.join((*others, *known))}")
    read = {}
    for key, f in known.items():
        reader: Reader = hints[f.name].__metadata__[0]
        if key in value:
            read[f.name] = reader.read(prefix + key, value[key])
        elif f.default is MISSING:
            raise ValueError(f"{prefix}{key}: is missing; give {reader.what}")
    return kind(**read)


def wrong(name: str, value: Any, what: str) -> ValueError:
    """The mistake that a value is, and what to give in its place."""
    return ValueError(f"{name}: got {_short(value)}; give {what}")


@dataclass(frozen=True)
class Number:
    """A number from `low` to `high`, without `low` itself where it is `positive`."""

    what: str
    low: float = -FAR
    high: float = FAR
    positive: bool = False

    def read(self, name: str, value: Any) -> float:
        """The number as a float."""
        number = isinstance(value, Real) and not isinstance(value, bool)
        if not number or not self.low <= value <= self.high or (self.positive and value == self.low):
            raise wrong(name, value, self.what)
        return float(value)


@dataclass(frozen=True)
class WholeNumber:
    """A whole number from `low` to `high`."""

    what: str
    low: int
    high: int

    def read(self, name: str, value: Any) -> int:
        """The number."""
        if not isinstance(value, int) or isinstance(value, bool) or not self.low <= value <= self.high:
            raise wrong(name, value, self.what)
        return value


@dataclass(frozen=True)
class Pair:
    """Two values of a kind, as a tuple."""

    what: str
    each: Reader

    def read(self, name: str, value: Any) -> tuple[Any, Any]:
        """The two values."""
        if not isinstance(value, list | tuple) or len(value) != 2:
            raise wrong(name, value, self.what)
        return self.each.read(f"{name}[0]", value[0]), self.each.read(f"{name}[1]", value[1])


@dataclass(frozen=True)
class Several:
    """From `least` to `most` values of a kind, as a tuple."""

    what: str
    each: Reader
    least: int
    most: int

    def read(self, name: str, value: Any) -> tuple[Any, ...]:
        """The values."""
        if not isinstance(value, list | tuple):
            raise wrong(name, value, self.what)
        if not self.least <= len(value) <= self.most:
            raise ValueError(f"{name}: got {len(value)} of them; give {self.what}, from {self.least} to {self.most}")
        return tuple(self.each.read(f"{name}[{number}]", one) for number, one in enumerate(value))


@dataclass(frozen=True)
class Points:
    """From `least` to `most` points x, y (m), as an array [n, 2]."""

    what: str
    least: int
    most: int = 10_000

    def read(self, name: str, value: Any) -> np.ndarray:
        """The points."""
        return np.array(Several(self.what, POINT, self.least, self.most).read(name, value))


@dataclass(frozen=True)
class Text:
    """A text of at most `most` signs that is not blank."""

    what: str
    most: int

    def read(self, name: str, value: Any) -> str:
        """The text."""
        if not isinstance(value, str) or not value.strip() or len(value) > self.most:
            raise wrong(name, value, self.what)
        return value


@dataclass(frozen=True)
class Flag:
    """True or false."""

    what: str = "true or false"

    def read(self, name: str, value: Any) -> bool:
        """The flag."""
        if not isinstance(value, bool):
            raise wrong(name, value, self.what)
        return value


@dataclass(frozen=True)
class Object:
    """An object of a dataclass, whose fields are annotated with readers, or a word that stands for one."""

    what: str
    kind: type
    words: Mapping[str, Any] = field(default_factory=dict)

    def read(self, name: str, value: Any) -> Any:
        """The object."""
        if isinstance(value, dict):
            return read_object(self.kind, name, value)
        if not isinstance(value, str) or value not in self.words:
            raise wrong(name, value, self.what)
        return self.words[value]


METRES = Number(f"metres from {-FAR:g} to {FAR:g}")
"""A coordinate or a height."""

LENGTH = Number(f"a length in metres, above 0 and at most {FAR:g}", 0, positive=True)
"""Of a side, a radius or a spacing."""

POINT = Pair("x and y in metres, [x, y]", METRES)
"""A point."""


def _plain(key: Any) -> str:
    return key if isinstance(key, str) and key.isidentifier() and len(key) <= 40 else _short(key)


def _short(value: Any) -> str:
    """The value in a few words, however long or deep it is."""
    return reprlib.repr(value)
