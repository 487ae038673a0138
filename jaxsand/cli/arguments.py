"""How command lines read their arguments, and how they say what is wrong with them."""

import argparse
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

WIDEST = 64
_LAST_SEED = 2**31 - 1  # what every generator takes


class Parser(argparse.ArgumentParser):
    """Mistakes become one line `error: field: what; remedy` and exit code 2."""

    def error(self, message: str) -> NoReturn:
        """Ends the program, and says what is wrong with the arguments."""
        field, what = "arguments", message
        if message.startswith("argument "):
            field, _, what = message.removeprefix("argument ").partition(": ")
            field = field.split("/")[-1].removeprefix("--")
        raise SystemExit(fail(f"{field}: {what}; see {self.prog} --help"))


def number(text: str) -> float:
    """A number, from the command line."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no number") from None


def repose(text: str) -> float:
    """An angle of repose in degrees."""
    degrees = number(text)
    if not 0 < degrees < 90:
        raise argparse.ArgumentTypeError(f"got {text!r}; give degrees above 0 and below 90, such as 29")
    return degrees


def path_name(text: str) -> Path:
    """The name of a file or folder, not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError("got an empty name")
    return Path(text)


def neighbours(text: str) -> int | str:
    """A whole number, or a word, as `neighbours` of `make_scene`."""
    return int(text) if text.isdecimal() else text


def count(text: str) -> int:
    """A whole number of at least 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no whole number of at least 1")
    return int(text)


def width(text: str) -> int:
    """Of a look-ahead, which pushes its square at every stroke; putting N strokes right takes 16 N^2 pushes more."""
    if not text.isdecimal() or not 1 <= int(text) <= WIDEST:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no whole number from 1 to {WIDEST}")
    return int(text)


def seed(text: str) -> int:
    """A whole number from 0 on that seeds a generator."""
    if not text.isdecimal() or int(text) > _LAST_SEED:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no whole number from 0 to {_LAST_SEED}")
    return int(text)


def ended(work: Callable[[], None]) -> int:
    """The exit code of a command: 0, or what its mistakes, the keyboard and closed pipes end it with."""
    try:
        work()
        sys.stdout.flush()
    except KeyboardInterrupt as error:
        print(str(error) or "stopped", file=sys.stderr)
        return 130
    except Exception as error:
        mistake = _mistake(error)
        if isinstance(error, OSError) and error.filename is None:  # what is printed cannot be: it need not be at the end
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 1
        if mistake is None:
            raise
        return fail(mistake)
    return 0


def _mistake(error: Exception) -> str | None:
    """What an error says to a user; None for what is a fault of the program's own."""
    match error:
        case ValueError():
            return str(error)
        case OSError():
            file = "the output" if error.filename is None else f"{error.filename!s:.200}"
            return f"file: cannot use {file} ({error.strerror}); choose another, or make room"
        case RuntimeError() if type(error).__name__ == "OutcomeError":
            return f"outcome: {error}"
        case RuntimeError() | MemoryError() if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            return "memory: there is not enough; ask for less: a smaller map or batch, or fewer strokes"
    return None


def fail(message: str) -> int:
    """Prints what went wrong as one line, and returns the exit code 2."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return 2


def draw_without_a_screen() -> None:
    """Has matplotlib write files, whatever the user's notebooks ask for."""
    os.environ["MPLBACKEND"] = "agg"


def keep_compiled_programs() -> None:
    """Lets JAX keep compiled programs in the user's cache, so that a second run starts fast."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxsand"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(cache, os.W_OK):
        return
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
