"""Height maps in a terminal: two cells of sand to a character, above each other, in colours."""

import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TextIO

import numpy as np

from jaxsand.viz.render import HEIGHTS

_RULED = 6  # lines of the terminal that are left for what is told
_PAUSE = 0.04  # seconds after a map, for the eye


def half_blocks(height: np.ndarray, span: float, columns: int, lines: int) -> list[str]:
    """A map [H, W] (m) as lines of text, its last row on top, at most so many columns and lines.

    Every character is the upper half of a block, in the colour of one cell on that of the cell below it. Heights from -span
    to span (m) take the colours that heights have in all pictures. Where a map does not fit, n x n cells become one, as high
    as the one of them that is farthest from height 0.

    Example:
      >>> import numpy as np
      >>> [line.count("▀") for line in half_blocks(np.zeros((6, 8)), 0.01, 80, 24)]
      [8, 8, 8]
    """
    from matplotlib import colormaps

    rows, across = height.shape
    every = max(1, -(-across // columns), -(-rows // (2 * lines)))
    shown = _largest(np.asarray(height, float), every)[::-1]
    if len(shown) % 2:
        shown = np.concatenate([shown, np.full_like(shown[:1], np.nan)])
    part = np.clip(shown / (2 * max(span, 1e-9)) + 0.5, 0, 1)
    colours = np.where(np.isnan(part)[..., None], 0, colormaps[HEIGHTS](np.nan_to_num(part), bytes=True)[..., :3])
    upper, lower = (_joined(c) for c in (colours[::2], colours[1::2]))
    pairs = [zip(a, b, strict=True) for a, b in zip(upper, lower, strict=True)]
    return ["".join(f"\033[38;2;{a};48;2;{b}m▀" for a, b in line) + "\033[0m" for line in pairs]


def _largest(height: np.ndarray, every: int) -> np.ndarray:
    """Of each block of `every` x `every` cells the height that is farthest from 0."""
    wide = np.pad(height, [(0, -n % every) for n in height.shape], constant_values=np.nan)
    rows, columns = (n // every for n in wide.shape)
    blocks = wide.reshape(rows, every, columns, every).swapaxes(1, 2).reshape(rows, columns, every**2)
    far = np.argmax(np.nan_to_num(np.abs(blocks), nan=-1), axis=-1)
    return np.take_along_axis(blocks, far[..., None], axis=-1)[..., 0]


def _joined(colours: np.ndarray) -> list[list[str]]:
    """Colours [H, W, 3] of 0 to 255 as `r;g;b`."""
    return [[";".join(map(str, cell)) for cell in line] for line in colours.tolist()]


@dataclass
class Live:
    """Draws one map over the other on a terminal.

    Args:
      span: heights from -span to span (m) take the colours.
      out: the terminal.
    """

    span: float
    out: TextIO
    _drawn: int = field(default=0, init=False)

    def __call__(self, height: np.ndarray) -> None:
        """Draws a map [H, W] (m) in the place of the one before."""
        size = shutil.get_terminal_size()
        lines = half_blocks(height, self.span, size.columns, max(1, size.lines - _RULED))
        back = f"\r\033[K\033[{self._drawn}A" if self._drawn else "\r\033[K"
        print(back + "\n".join(lines), file=self.out, flush=True)
        self._drawn = len(lines)
        time.sleep(_PAUSE)


def live(span: float) -> Callable[[np.ndarray], None]:
    """What draws maps on the terminal as they come; what draws nothing where standard error is none, or shows no colours."""
    colours = os.environ.get("TERM") != "dumb" and not os.environ.get("NO_COLOR")
    return Live(span, sys.stderr) if colours and sys.stderr.isatty() else lambda _: None
