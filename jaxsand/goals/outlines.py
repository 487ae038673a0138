"""Which cells of a grid lie within outlines given in metres; a cell lies where its centre does. Host side, numpy only.

A centre on an outline counts to one side alone, up to rounding: shapes that share an edge neither overlap nor leave a gap.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np

from jaxsand.scene.grid import Grid, places

_ROUNDING = 1e-9  # cells: what lies closer to an outline lies on it

Mask = np.ndarray
"""Booleans [H, W]."""


def inside(corners: np.ndarray, grid: Grid) -> Mask:
    """The cells within a polygon of corners [n, 2] = x, y (m), where rays from them cross its sides an odd number of times.

    Centres on a left or lower side are inside, those on a right or upper one are not.
    """
    rows, columns = grid.shape
    crossed = np.zeros((rows, columns + 1), int)
    centres = np.asarray(corners, float) / float(grid.spacing) - 0.5  # in cells, from the centre of cell [0, 0]
    for (x0, y0), (x1, y1) in pairwise([*centres, centres[0]]):
        first, last = (_first(y, rows) for y in sorted((y0, y1)))
        if first < last:
            row = np.arange(first, last)
            share = np.clip((row - y0) / (y1 - y0), 0, 1)  # a row that lies on an end, up to rounding, may be just beyond it
            crossed[row, _first(x0 + share * (x1 - x0), columns)] += 1
    return crossed.cumsum(1)[:, :columns] % 2 == 1


def ring(centre: tuple[float, float], inner: float, radius: float, grid: Grid) -> Mask:
    """The cells from `inner` up to, but not at, `radius` (m) from a centre (m)."""
    spacing = float(grid.spacing)
    x, y = places(grid.shape, spacing)
    distance = np.hypot(x - centre[0], y - centre[1]) + _ROUNDING * spacing
    return (inner <= distance) & (distance < radius)


def near(strokes: np.ndarray, reach: float, grid: Grid) -> Mask:
    """The cells at most `reach` (m) from one of the strokes [n, 4] = x0, y0, x1, y1 (m)."""
    rows, columns = grid.shape
    found = np.zeros(grid.shape, bool)
    centres, far = np.asarray(strokes, float) / float(grid.spacing) - 0.5, reach / float(grid.spacing) + _ROUNDING
    for x0, y0, x1, y1 in centres:
        (low, high), (left, right) = (
            (_first(min(ends) - far, n), _first(max(ends) + far, n - 1) + 1)
            for ends, n in (((y0, y1), rows), ((x0, x1), columns))
        )
        y, x = np.arange(low, high)[:, None], np.arange(left, right)
        run, rise = x1 - x0, y1 - y0
        along = np.clip(((x - x0) * run + (y - y0) * rise) / ((run**2 + rise**2) or 1.0), 0, 1)
        found[low:high, left:right] |= np.hypot(x - x0 - along * run, y - y0 - along * rise) <= far
    return found


def strip(ends: np.ndarray, width: float) -> np.ndarray:
    """The corners [4, 2] (m) of a rectangle `width` (m) wide between the middles [2, 2] of two of its sides."""
    run = ends[1] - ends[0]
    length = math.hypot(*run)
    side = np.array([-run[1], run[0]]) * (width / 2 / length if length else 0.0)
    return np.array([ends[0] - side, ends[1] - side, ends[1] + side, ends[0] + side])


def _first(place: Any, cells: int) -> Any:
    """The first cell, of those in a row, at or behind a place (cells); their number if there is none."""
    return np.clip(np.ceil(place - _ROUNDING), 0, cells).astype(int)
