"""Faults planted one by one in a copy of the tree, to see whether the tests catch them.

    python -m tests.faults [NAME ...] [--package-only] [--list]

Each `.patch` beside this file is a fault: a line that says what is wrong, then a diff. The tests of the fault's package run
first, then all others; the first failure ends the run. Exits with 1 if a fault was not caught.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PARTS = ("jaxsand", "train", "tests", "notebooks", "README.md", "pyproject.toml")
FAILED = (1, 2)  # exit codes of pytest: a test failed, or could not be collected


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="faults to plant; by default all")
    parser.add_argument("--package-only", action="store_true", help="run the tests of the fault's package alone")
    parser.add_argument("--list", action="store_true", help="list the faults")
    options = parser.parse_args()
    faults = {path.stem: path for path in sorted(HERE.glob("*.patch"))}
    if unknown := [name for name in options.names if name not in faults]:
        parser.error(f"no such fault: {', '.join(unknown)}; --list shows all")
    chosen = options.names or list(faults)
    if options.list:
        print(*(f"{name}: {about(faults[name])}" for name in chosen), sep="\n")
        return 0
    caught = [planted(faults[name], options.package_only) for name in chosen]
    print(f"{sum(caught)} of {len(caught)} caught")
    return int(not all(caught))


def planted(fault: Path, package_only: bool) -> bool:
    """Whether the tests fail on a copy of the tree with the fault in it; says so in a line."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder))
        subprocess.run(["git", "apply", str(fault)], cwd=copy, check=True)
        first = copy / "tests" / package(fault)
        runs = [["tests"]]
        if first.is_dir():
            runs = [[str(first)]] if package_only else [[str(first)], ["tests", f"--ignore={first}"]]
        failed = any(fails(copy, run) for run in runs)
    print(f"{'caught' if failed else 'MISSED'} {fault.stem} ({time.monotonic() - began:.0f} s): {about(fault)}", flush=True)
    return failed


def copied(folder: Path) -> Path:
    """A copy of the tree, in a folder."""
    for part in PARTS:
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / part, folder / part)
    return folder


def fails(copy: Path, arguments: list[str]) -> bool:
    """Whether a test fails; raises if none can be run."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, *FAILED):
        raise RuntimeError(done.stdout + done.stderr)
    return done.returncode in FAILED


def package(fault: Path) -> str:
    """The package that a fault is planted in: the first part of its name."""
    return fault.stem.partition("-")[0]


def about(fault: Path) -> str:
    """What is wrong, in a sentence."""
    return fault.read_text(encoding="utf-8").partition("\n")[0]


if __name__ == "__main__":
    sys.exit(main())
