"""Reads arrays and JSON from files that others made: no pickles, and no more than a bound, however small the file is.

What is wrong is a ValueError that says so in a few words; callers say which file it is, and what to do.
"""

import json
import zipfile
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile

from jaxsand.goals.writing import reason

MOST_JSON = 2**24
"""Bytes of JSON that are read."""

MOST_CELLS = 2**26
"""Cells of a picture, or of arrays in a file that packs them, such as 8192 x 8192."""

_WAYS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those of numpy.savez and savez_compressed


def read_array(path: Path) -> np.ndarray:
    """The array in a .npy file.

    Raises:
      ValueError: if there is none, or the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            if file.read(6) != b"\x93NUMPY":
                raise ValueError("it does not begin as one")
            file.seek(0)
            array: np.ndarray = np.load(file, allow_pickle=False)
            return array
    except Exception as error:  # a spoilt header may raise anything, from a tokenizer's errors to a lack of memory
        raise ValueError(reason(error)) from None


def read_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays in an .npz file by name: those of `names` that are there, or all.

    Raises:
      ValueError: if the file cannot be read, or would unpack to more than its own size and 8 bytes for `MOST_CELLS` cells.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            if not isinstance(data, NpzFile):
                raise ValueError("it is no .npz file")
            _check_size(data, max(8 * MOST_CELLS, path.stat().st_size))
            found = {name: data[name] for name in data.files if names is None or name in names}
    except Exception as error:  # as above
        raise ValueError(reason(error)) from None
    for name, array in found.items():
        if not isinstance(array, np.ndarray):
            raise ValueError(f"{name:.40} is no array")
    return found


def _check_size(data: NpzFile, most: int) -> None:
    """Raises ValueError if what is packed is too large, or packed in a way that numpy never uses."""
    members = data.zip.infolist()  # type: ignore[union-attr]
    unpacked = sum(member.file_size for member in members)
    if unpacked > most:
        raise ValueError(f"it would unpack to {unpacked / 2**20:.0f} MiB, and at most {most >> 20} are read")
    for member in members:
        if member.compress_type not in _WAYS:
            raise ValueError(f"{member.filename:.40} is packed in a way that numpy does not use")


def read_json(path: Path) -> Any:
    """What a JSON file holds, the keys of each object in it being different.

    Raises:
      ValueError: if it cannot be read, or is larger than `MOST_JSON`.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MOST_JSON + 1)
        if len(text) > MOST_JSON:
            raise ValueError(f"more than {MOST_JSON >> 20} MiB")
        return json.loads(text.decode("utf-8-sig"), object_pairs_hook=_object)
    except RecursionError:
        raise ValueError("it is nested too deep") from None
    except (OSError, ValueError) as error:
        raise ValueError(reason(error)) from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object, whose keys have to differ."""
    found = dict(pairs)
    if len(found) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"{twice!r:.40} is given twice")
    return found
