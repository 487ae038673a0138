"""How long computations report their progress."""

from collections.abc import Callable

Tell = Callable[[str], None]  # called with a few words on what comes next


def quiet(_: str) -> None:
    """Reports nothing."""
