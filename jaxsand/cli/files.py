"""Files and folders of the command line, and its progress line."""

import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxsand.goals.writing import written

if TYPE_CHECKING:
    import numpy as np

    from jaxsand.scene.progress import Tell


def existing(path: Path, accepted: str = "") -> Path:
    """The path, if there is a file, whose name ends as `accepted` says."""
    if accepted and path.suffix.lower() != accepted:
        raise ValueError(
            f"{path}: {path.suffix or 'no suffix'} is not read; give a {accepted} file: heights [H, W] in metres, first row "
            "at y = 0, saved with numpy.save (from an .asc or .tif, whose first row is on top: after numpy.flipud)"
        )
    try:
        if path.is_dir():
            raise ValueError(f"{path}: is a folder; give a file")
        there = path.is_file()
    except OSError:  # a name that is too long, or in a folder that may not be read
        there = False
    if not there:
        raise ValueError(f"{path!s:.200}: no such file; check the name")
    return path


def plausible(heights: "np.ndarray", most: float, file: str, middle: float = 0.0) -> None:
    """Raises ValueError where a height lies further from the middle than `most` (m), as a value for no data does."""
    import numpy as np

    off = np.abs(np.where(np.isfinite(heights), heights, middle).astype(float) - middle)
    if bad := int((off > most).sum()):
        value, where = f"{float(heights.ravel()[np.argmax(off)]):.6g}", f"{middle:.4g} m" if middle else "level sand"
        raise ValueError(
            f"{file}: got {bad} cells more than {most:.4g} m above or below {where}, such as {value}, "
            f"too much for a map of this size; where that stands for no data, give --no-data {value}, "
            "and heights are in metres"
        )


def read_text(path: Path) -> str:
    """The text of a file."""
    try:
        return existing(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as text ({type(error).__name__}); give rows of # and .") from None


def folder(path: Path) -> Path:
    """The folder, made if need be, once a file could be written in it."""
    probe = path / f".jaxsand-{os.getpid()}"
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"out: cannot write to {path} ({error.strerror}); choose another folder") from None
    return path


def progress() -> "Tell":
    """Tells what goes on, on a terminal's one line; silent when piped."""
    if not sys.stderr.isatty():
        return lambda _: None
    return lambda text: print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def as_json(report: dict[str, Any], **layout: Any) -> str:
    """JSON, with null for numbers that are not finite."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: plain(v) for name, v in value.items()}
        if isinstance(value, list):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(report), allow_nan=False, **layout)


def write_json(path: Path, report: dict[str, Any]) -> None:
    """A file that holds the report, one value a line."""
    with written(path) as beside:
        beside.write_text(as_json(report, indent=1) + "\n", encoding="utf-8")
