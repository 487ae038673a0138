"""What all commands share: reading a cell, printing a report."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxsand.cli.files import as_json


def read_cell(text: str | None, field: str = "start") -> tuple[int, int] | None:
    """A cell (row, column), from the command line; None where it is left to the planner."""
    if text is None or (text == "best" and field == "start"):
        return None
    try:
        row, column = (int(part) for part in text.split(","))
    except ValueError:
        best = ", or best" if field == "start" else ""
        raise ValueError(f"{field}: got {text!r}; give row,column such as 3,3{best}") from None
    return row, column


def show(options: argparse.Namespace, report: dict[str, Any], human: Callable[[dict[str, Any]], str]) -> None:
    """Prints a report: as JSON where the options say so, else as `human` words it."""
    print(as_json(report) if options.json else human(report))


def lines(report: dict[str, Any]) -> str:
    """A report as lines `name: value`."""
    return "\n".join(f"{name}: {value}" for name, value in report.items())


def plain_name(name: str) -> str:
    """A name for files, of letters, digits and hyphens alone."""
    stem = Path(name).stem if Path(name).suffix in (".txt", ".png", ".npy", ".json") else name
    return "".join(c if c.isalnum() else "-" for c in stem)[:40]
