"""Host arrays with cells of which nothing is known: masked, or NaN. Numpy only.

A function that takes such cells says so, and lets them in by `gaps`; all others refuse masked ones, since what lies under a
mask is no value.
"""

from typing import Any

import numpy as np

BED = "fill them first (cells of a bed that hold no sand are walls: make_scene(..., walls=Walls(solid)))"
DIG = "say of each whether to dig it: dig.filled(False), or True"
POINTS = "give every coordinate, and leave out a stroke or a point of which one is not known"


def gaps(value: Any) -> Any:
    """The value, in floats with NaN ("no data") in the masked cells where it is a masked array, or a list of such."""
    masked = _masked(value)
    if masked is None:
        return _plain(value)
    return np.ma.filled(masked.astype(np.result_type(masked.dtype, np.float32)), np.nan)


def unmasked(name: str, value: Any, remedy: str = BED) -> Any:
    """The value, without the mask of a masked array; a ValueError with the remedy if any cell is masked."""
    masked = _masked(value)
    if masked is not None:
        raise ValueError(f"{name}: got {int(np.ma.getmaskarray(masked).sum())} masked cells; {remedy}")
    return _plain(value)


def _plain(value: Any) -> Any:
    return np.ma.getdata(value) if isinstance(value, np.ma.MaskedArray) else value


def _masked(value: Any) -> np.ma.MaskedArray[Any, Any] | None:
    """The value as a masked array, if it has a cell that is masked."""
    several = isinstance(value, list | tuple) and any(isinstance(one, np.ma.MaskedArray) for one in value)
    if not (several or isinstance(value, np.ma.MaskedArray)):
        return None
    array: np.ma.MaskedArray[Any, Any] = np.ma.array(value)
    return array if np.ma.is_masked(array) else None
