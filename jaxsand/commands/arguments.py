"""How command lines read their arguments, and how they say what is wrong with them."""

import argparse
import os
import sys
from pathlib import Path
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """Mistakes become one line `error: field: what; remedy` and exit code 2."""

    def error(self, message: str) -> NoReturn:
        field, what = "arguments", message
        if message.startswith("argument "):
            field, _, what = message.removeprefix("argument ").partition(": ")
            field = field.split("/")[-1].removeprefix("--")
        raise SystemExit(fail(f"{field}: {what}; see {self.prog} --help"))


def number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no number") from None


def path_name(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("got an empty name")
    return Path(text)


def neighbours(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no whole number of at least 1")
    return int(text)


def seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"got {text!r}, which is no whole number of at least 0")
    return int(text)


def fail(message: str) -> int:
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return 2


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
