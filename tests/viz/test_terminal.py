"""Sand in a terminal: what is drawn, where, and that nothing is where there is no terminal."""

import io
import re

import numpy as np
import pytest

from jaxsand.viz import terminal
from jaxsand.viz.terminal import Live, half_blocks, live

CELL = re.compile(r"\033\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m▀")


def colours(lines):
    """The colours [2 H, W, 3] of the cells drawn, the top row first."""
    found = np.array([[list(map(int, cell)) for cell in CELL.findall(line)] for line in lines])
    return found.reshape(len(lines), -1, 2, 3).transpose(0, 2, 1, 3).reshape(2 * len(lines), -1, 3)


def test_heaps_are_red_and_trenches_blue_and_the_last_row_is_on_top():
    height = np.zeros((4, 6))
    height[3, 0], height[0, 5] = 0.01, -0.01
    seen = colours(half_blocks(height, 0.01, 80, 24))
    assert seen.shape == (4, 6, 3)
    red, blue = seen[0, 0], seen[3, 5]
    assert red[0] > 150 > red[2]
    assert blue[2] > 120 > blue[0]
    assert len(np.unique(seen[1:3].reshape(-1, 3), axis=0)) == 1


def test_a_map_is_thinned_out_until_it_fits_and_what_is_not_known_is_black():
    lines = half_blocks(np.zeros((64, 100)), 0.01, 40, 10)
    assert len(lines) <= 10
    assert all(line.count("▀") <= 40 for line in lines)
    odd = colours(half_blocks(np.full((3, 2), np.nan), 0.01, 80, 24))
    assert odd.shape == (4, 2, 3)
    assert not odd.any()


def test_a_narrow_trench_stays_where_a_map_is_thinned_out():
    height = np.zeros((100, 100))
    height[:, 51] = -0.01
    seen = colours(half_blocks(height, 0.01, 80, 24))
    assert seen.shape[:2] == (34, 34)  # 3 x 3 cells are one
    assert (seen[:, 17] != seen[:, 0]).any(-1).all()
    assert (seen[:, [16, 18]] == seen[:, [0]]).all()


def test_each_map_is_drawn_over_the_one_before(monkeypatch):
    monkeypatch.setattr(terminal.time, "sleep", lambda _: None)
    monkeypatch.setattr(terminal.shutil, "get_terminal_size", lambda: terminal.shutil.os.terminal_size((80, 24)))
    out = io.StringIO()
    draw = Live(0.01, out)
    for _ in range(3):
        draw(np.zeros((8, 8)))
    assert out.getvalue().count("\033[4A") == 2
    assert out.getvalue().count("▀") == 3 * 4 * 8


@pytest.mark.parametrize("terminal_there", [True, False])
def test_nothing_is_drawn_where_there_is_no_terminal(monkeypatch, terminal_there):
    class Stream(io.StringIO):
        def isatty(self):
            return terminal_there

    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(terminal.sys, "stderr", out := Stream())
    live(0.01)(np.zeros((4, 4)))
    assert bool(out.getvalue()) == terminal_there
