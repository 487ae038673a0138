"""Files that are whole, or not there: written beside, then put in place."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NAME = 40  # signs of a file's name that the name beside it has


@contextmanager
def written(path: Path, field: str = "out") -> Iterator[Path]:
    """A file beside `path` to write to, which takes its place when all went well.

    Raises:
      ValueError: with the field's name, if it cannot be written; what was there stays.
    """
    if "\0" in str(path):
        raise ValueError(f"{field}: got a name that holds a NUL; choose another name")
    beside = path.with_name(f".{path.name[:_NAME]}.{os.getpid()}")
    try:
        yield beside
        beside.replace(path)
    except OSError as error:
        raise ValueError(f"{field}: cannot write {path} ({reason(error)}); make room, or choose another folder") from None
    finally:
        with suppress(OSError):
            beside.unlink()


def reason(error: BaseException) -> str:
    """What an error says, in a few words on a line."""
    said = getattr(error, "strerror", None) or str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    return " ".join(said.split())[:80] or type(error).__name__
