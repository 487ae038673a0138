"""Files of a run: states as files of plain arrays, learners as JSON.

A checkpoint is one file, so that a single rename puts it in place as a whole, which a folder's checkpoint (Orbax) cannot
promise, and it needs no import. It is written beside the old one, flushed to the disk, then renamed, so that a kill leaves
the old one.
"""

import importlib
import json
import os
from collections.abc import Collection
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeGuard, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.goals.untrusted import read_arrays
from jaxsand.goals.writing import reason

State = Any
"""A pytree of arrays (typed keys too): parameters, optimiser, buffer, environments, key, counters; everything."""

_ABOUT, _STATE = "about", "state/"
_OURS = ("train", "jaxsand")
_OTHER = "use its own learner"
_LONGEST = 200  # signs of a class's name
_PLAIN: dict[Any, tuple[type, ...]] = {bool: (bool,), int: (int,), float: (int, float), str: (str,)}


@dataclass(frozen=True)
class At:
    """Where a run is.

    Attributes:
      chunk: chunks done.
      seconds: of work.
      score: the best so far.
      rows: bytes of metrics written.
    """

    chunk: int = 0
    seconds: float = 0.0
    score: float = -np.inf
    rows: int = 0


def save(path: Path, state: State, at: At) -> None:
    """Writes a checkpoint in place of the old one, as a whole or not at all.

    Raises:
      ValueError: if it cannot be written; the old one stays.
    """
    arrays: dict[str, Any] = {name: np.asarray(_plain(leaf)) for name, leaf in _named(state).items()}
    arrays[_ABOUT] = np.array(json.dumps(asdict(at)))
    beside = path.with_name(path.name + ".part")
    try:
        with beside.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        beside.unlink(missing_ok=True)


def load(path: Path, like: State) -> tuple[State, At]:
    """Reads a state of the same structure as `like`, and where the run was.

    Raises:
      ValueError: if the file cannot be read, or holds something else.
    """
    leaves = _named(like)
    at, arrays = _read(path)
    other = [name for name in sorted(leaves.keys() | arrays.keys()) if _kind(arrays.get(name)) != _kind(leaves.get(name))]
    if other:
        advice = {name: _advice(arrays.get(name), leaves.get(name)) for name in other}
        name = next((name for name in other if advice[name] == _OTHER), other[0])
        have, want = _kind(arrays.get(name)), _kind(leaves.get(name))
        raise ValueError(f"run: {path} holds {have} as {name.removeprefix(_STATE)}, this learner {want}; {advice[name]}")
    filled = [_like(leaf, arrays[name]) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(like), filled), at


def where(path: Path) -> At:
    """Where the run was when it wrote this file; see `load`."""
    return _read(path, (_ABOUT,))[0]


def _read(path: Path, names: Collection[str] | None = None) -> tuple[At, dict[str, np.ndarray]]:
    """What a checkpoint says of where the run was, and its arrays; raises ValueError with advice if it cannot be read."""
    if not path.exists():
        raise ValueError(f"run: there is no {path}; train first, or check the name")
    try:
        arrays = read_arrays(path, names)
        about = json.loads(str(arrays.pop(_ABOUT, None)))
        at = At(**about)
        if not all(isinstance(getattr(at, f.name), int if f.type is int else int | float) for f in fields(At)):
            raise ValueError(f"{_ABOUT} holds {about!r:.60}")
    except (ValueError, TypeError, RecursionError) as error:
        other = "best.npz" if path.name == "last.npz" else "last.npz"
        raise ValueError(
            f"run: cannot read {path} ({reason(error)}); put a copy of {other} in its place, or train anew"
        ) from None
    return at, arrays


def unwritable(path: Path, error: OSError) -> ValueError:
    """The error for a file of a run that cannot be written."""
    return ValueError(
        f"out: cannot write {path} ({error.strerror}); make room or choose another folder: what is there stays good"
    )


def described(thing: object) -> Any:
    """A learner, or a part of it, as JSON data: frozen dataclasses of numbers, texts, tuples and other such dataclasses."""
    if is_dataclass(thing):
        own = {f.name: described(getattr(thing, f.name)) for f in fields(thing) if f.init}
        return {"is": f"{type(thing).__module__}:{type(thing).__qualname__}"} | own
    if isinstance(thing, tuple):
        return [described(x) for x in thing]
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    raise ValueError(f"learner: got {thing!r} in its fields; give numbers, texts, tuples and dataclasses of them")


def restored(data: Any) -> Any:
    """The inverse of `described`.

    Raises:
      ValueError: if the data name something that is no dataclass of `train` or `jaxsand`, or that has other fields.
    """
    if isinstance(data, list):
        return tuple(restored(x) for x in data)
    if not isinstance(data, dict):
        return data
    if len(str(data.get("is"))) > _LONGEST:
        raise ValueError(f"config: got {data['is']!r:.60}, which is no part of {' or '.join(_OURS)}; use a run's own file")
    module, _, name = str(data.get("is")).partition(":")
    if module.partition(".")[0] not in _OURS:
        raise ValueError(f"config: got {data.get('is')!r}, which is no part of {' or '.join(_OURS)}; use a run's own file")
    try:
        kind = getattr(importlib.import_module(module), name)
        if not (isinstance(kind, type) and is_dataclass(kind)):
            raise TypeError("it is no dataclass")
        made = {field: restored(x) for field, x in data.items() if field != "is"}
        for field, hint in get_type_hints(kind).items():
            if hint in _PLAIN and field in made and type(made[field]) not in _PLAIN[hint]:
                raise TypeError(f"{field} is {made[field]!r:.40}")
        return kind(**made)
    except ModuleNotFoundError as error:
        raise ValueError(f"config: {data['is']} needs {error.name}; run pip install 'jaxsand[train]'") from None
    except (ImportError, AttributeError, TypeError) as error:
        raise ValueError(
            f"config: cannot make {data['is']} ({error!s:.200}); use the version that the run was made with"
        ) from None


def _named(state: State) -> dict[str, Any]:
    """The leaves of a state by their path."""
    paths = jax.tree_util.tree_flatten_with_path(state)[0]
    return {_STATE + jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in paths}


def _is_key(leaf: object) -> TypeGuard[jax.Array]:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> Any:
    """A leaf as an array: a JAX key as its numbers."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _like(leaf: object, array: np.ndarray) -> jax.Array | np.ndarray:
    """An array of a file as a leaf of the kind of `leaf`."""
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    return jnp.asarray(array) if isinstance(leaf, jax.Array) else array


def _kind(leaf: jax.Array | np.ndarray | None) -> str:
    """Dtype and shape, for messages."""
    if leaf is None:
        return "nothing"
    array = _plain(leaf)
    return f"{np.dtype(array.dtype).name}{list(array.shape)}"


def _advice(array: np.ndarray | None, leaf: jax.Array | np.ndarray | None) -> str:
    """What makes a learner's leaf what a file holds: JAX's settings, where the two differ in nothing else."""
    if array is None or leaf is None:
        return _OTHER
    if _is_key(leaf):
        return "set jax_default_prng_impl as it was when the run was made"
    have, want = np.dtype(array.dtype), np.dtype(leaf.dtype)
    if have.kind == want.kind and {have.itemsize, want.itemsize} == {4, 8} and array.shape == leaf.shape:
        return f"the run was made with JAX_ENABLE_X64={int(have.itemsize == 8)}, so set it"
    return _OTHER
