"""Throws random and spoilt input at every entrance of the package.

    python -m tests.fuzz [NAME ...] [--cases N] [--seed K] [--first I] [--list]

Case I of an entrance is the same in every run with the same seed, so `NAME --first I --cases 1` repeats one. Exits with 1 if
a case raised something else than a ValueError of one line, warned, took too long or left something behind.
"""

import argparse
import collections
import contextlib
import faulthandler
import sys
import tempfile
import time
import traceback
import zlib
from pathlib import Path

import numpy as np

from .entrances import ENTRANCES, LIMITS
from .judge import BrokenError, judged


def one(name: str, number: int, folder: Path, seed: int = 0) -> str:
    """Runs a case of an entrance in an empty folder; returns "ok" or what was said to be wrong. BrokenError if it is broken."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
    warned = "ignore" if name.startswith("call-") else "error"  # numpy's of numbers that a caller gave
    return judged(ENTRANCES[name](rng, folder), LIMITS.get(name, 60.0), warned)


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="entrances; by default all")
    parser.add_argument("--cases", type=int, default=1000, metavar="N", help="of each entrance (1000)")
    parser.add_argument("--seed", type=int, default=0, metavar="K")
    parser.add_argument("--first", type=int, default=0, metavar="I", help="the first case (0)")
    parser.add_argument("--list", action="store_true", help="list the entrances")
    options = parser.parse_args()
    if unknown := [name for name in options.names if name not in ENTRANCES]:
        parser.error(f"no such entrance: {', '.join(unknown)}; --list shows all")
    if options.list:
        print(*ENTRANCES, sep="\n")
        return 0
    broken = sum(_entrance(name, options) for name in options.names or ENTRANCES)
    print(f"{broken} cases broke something")
    return int(broken > 0)


def _entrance(name: str, options: argparse.Namespace) -> int:
    """Runs the cases of one entrance; returns how many broke something, and prints the first of each kind."""
    began, kinds, good = time.monotonic(), collections.Counter[str](), 0
    for number in range(options.first, options.first + options.cases):
        faulthandler.dump_traceback_later(300, exit=True)
        try:
            with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
                good += one(name, number, Path(folder), options.seed) == "ok"
        except BrokenError as error:
            place = traceback.extract_tb((error.__cause__ or error).__traceback__)
            ours = [
                f"{Path(f.filename).name}:{f.lineno}" for f in place if "jaxsand" in f.filename or "train/" in f.filename
            ]
            kind = f"{' '.join(str(error).rpartition(']: ')[2].split()[:3])} at {ours[-1] if ours else '?'}"
            kinds[kind] += 1
            if kinds[kind] == 1:
                print(f"  {name} case {number}: {error!s:.400}  [{' < '.join(ours[:-4:-1])}]", flush=True)
    faulthandler.cancel_dump_traceback_later()
    seconds = time.monotonic() - began
    print(f"{name}: {options.cases} cases, {good} taken, {kinds.total()} broken, {seconds:.1f} s", flush=True)
    return kinds.total()


if __name__ == "__main__":
    sys.exit(main())
