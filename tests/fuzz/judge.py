"""What every case is held to: it succeeds or raises a ValueError in one line, warns of nothing, and ends in time."""

import contextlib
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Literal

NAMED = re.compile(r"^\S.{0,400}?: \S")  # what is wrong, and how


class HangError(BaseException):
    """A case took too long; no `except Exception` stops it."""


class BrokenError(AssertionError):
    """A case did what no input may make it do."""


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raises HangError where the work takes longer; a thread other than the main one cannot be stopped, and is not."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(*_: object) -> None:
        raise HangError(f"not done after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def judged(run: Callable[[], object], seconds: float = 10.0, warned: Literal["error", "ignore"] = "error") -> str:
    """Runs a case; returns "ok" or what it said was wrong.

    Raises:
      BrokenError: for any other exception, a warning, a message that is not one line or names nothing, and a hang.
    """
    try:
        with warnings.catch_warnings(), within(seconds):
            warnings.simplefilter(warned)
            run()
    except ValueError as error:
        said = str(error)
        if type(error) is not ValueError:
            raise BrokenError(f"{type(error).__name__}: {said:.300}") from error
        if len(said.splitlines()) != 1 or len(said) > 1000 or not NAMED.match(said):
            raise BrokenError(f"a message that is no line, or names nothing: {said[:300]!r}") from error
        return said
    except (Exception, HangError) as error:
        raise BrokenError(f"{type(error).__name__}: {error!s:.300}") from error
    return "ok"
