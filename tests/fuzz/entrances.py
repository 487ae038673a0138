"""The entrances of the package, each a way to make a case from a random generator."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from .files import FILES
from .spoil import Rng

Entrance = Callable[[Rng, Path], Callable[[], object]]


def file_case(name: str, rng: Rng, folder: Path) -> Callable[[], object]:
    """A spoilt file of a kind, and what reads it; reading leaves nothing beside it."""
    suffix, make, read = FILES[name]
    path = folder / f"x{suffix}"
    path.write_bytes(make(rng))
    return lambda: read(path)


ENTRANCES: dict[str, Entrance] = {f"read-{name}": partial(file_case, name) for name in FILES}
