"""Rows of a bench that are kept in a file as they come, so that a run that was cut off goes on where it stopped."""

import errno
import json
import os
from pathlib import Path

from jaxsand.bench.tables import Row


def append_row(path: Path, row: Row) -> None:
    """Adds a row to a file, on a line of its own even if the last line was cut off.

    Raises:
      ValueError: if it cannot be written; the rows that are there stay.
    """
    try:
        with path.open("a+b", buffering=0) as file:  # in one piece, beside those of another bench
            file.seek(max(file.seek(0, os.SEEK_END) - 1, 0))
            cut = file.read(1) not in (b"", b"\n")
            data = ("\n" * cut + json.dumps(row) + "\n").encode()
            if file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        raise ValueError(
            f"out: cannot write {path} ({error.strerror}); make room or choose another folder: the rows there stay good"
        ) from None


def known_rows(path: Path, names: set[str]) -> list[Row]:
    """The rows of a file, none if it does not exist; lines that were cut off are left out.

    Raises:
      ValueError: for a line that is no row, or has not all of these names.
    """
    rows = []
    for number, line in enumerate(path.read_bytes().splitlines() if path.is_file() else [], 1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(row, dict) or not names <= set(row):
            raise ValueError(f"out: line {number} of {path} is no row of this bench; take it out, or give another folder")
        rows.append(row)
    return rows
