"""The entrances of the package, each a way to make a case from a random generator."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from . import calls, commands
from .files import FILES
from .spoil import Rng

Entrance = Callable[[Rng, Path], Callable[[], object]]


def file_case(name: str, rng: Rng, folder: Path) -> Callable[[], object]:
    """A spoilt file of a kind, and what reads it; reading leaves nothing beside it."""
    suffix, make, read = FILES[name]
    path = folder / f"x{suffix}"
    path.write_bytes(make(rng))
    return lambda: read(path)


ENTRANCES: dict[str, Entrance] = {
    **{f"read-{name}": partial(file_case, name) for name in FILES},
    "command-jaxsand": partial(commands.case, "jaxsand", False),
    "command-train": partial(commands.case, "train", False),
    "command-heavy": partial(commands.case, "jaxsand", True),
    **{f"call-{name}": partial(calls.case, name) for name in calls.CALLS},
}
LIMITS = {name: 600.0 if name == "command-heavy" else 300.0 for name in ENTRANCES if not name.startswith("read-")}
"""Seconds that a case may take on a busy machine, where they are not 60: only what never ends is a fault."""
