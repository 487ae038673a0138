"""Single strokes over binary maps: the published step counts, brute force, and what is refused."""

import string

import numpy as np
import pytest

import jaxsand as js
from jaxsand.goals import letter_map
from jaxsand.planner import connected_pieces

STEP = {"N": (-1, 0), "E": (0, 1), "S": (1, 0), "W": (0, -1)}


def replay(start, path):
    cells = [start]
    for letter in path:
        cells.append((cells[-1][0] + STEP[letter][0], cells[-1][1] + STEP[letter][1]))
    return cells


def shortest(dig, start):
    """Breadth first over (cell, dug): the true optimum."""
    cells = {tuple(c) for c in np.argwhere(dig)}
    layer, steps = {(start, frozenset([start]))}, 0
    seen = set(layer)
    while not any(dug == cells for _, dug in layer):
        layer = {
            ((r + dr, c + dc), dug | {(r + dr, c + dc)})
            for (r, c), dug in layer
            for dr, dc in STEP.values()
            if (r + dr, c + dc) in cells
        } - seen
        seen |= layer
        steps += 1
    return steps


@pytest.mark.parametrize(("letter", "steps"), [("A", 23), ("S", 27), ("T", 18), ("R", 25)])
def test_published_step_counts(letter, steps):
    found = js.plan(*letter_map(letter))
    assert (found.steps, found.optimal, found.lower_bound) == (steps, True, steps)


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_every_letter_is_dug_by_a_proven_plan(letter):
    dig, start = letter_map(letter)
    found = js.plan(dig, start)
    cells = replay(start, found.path)
    assert tuple(cells) == found.cells
    assert set(cells) == {tuple(c) for c in np.argwhere(dig)}
    assert found.optimal
    free = js.plan(dig)
    assert free.optimal
    assert free.steps <= found.steps
    assert set(replay(free.start, free.path)) == set(cells)


def test_brute_force_agrees():
    rng = np.random.default_rng(0)
    for _ in range(40):
        dig = rng.random((rng.integers(1, 4), rng.integers(1, 5))) < 0.75
        pieces = connected_pieces(dig)
        if not pieces:
            continue
        part = np.zeros_like(dig)
        part[tuple(np.array(sorted(pieces[0])).T)] = True
        cells = sorted(pieces[0])
        start = cells[rng.integers(len(cells))]
        best = {cell: shortest(part, cell) for cell in cells}
        assert js.plan(part, start).steps == best[start]
        assert js.plan(part).steps == min(best.values())


def test_out_of_budget_it_gives_a_walk_and_an_honest_bound():
    rng = np.random.default_rng(1)
    dig = rng.random((12, 12)) < 0.7
    part = np.zeros_like(dig)
    part[tuple(np.array(sorted(connected_pieces(dig)[0])).T)] = True
    found = js.plan(part, bound=50)
    assert set(replay(found.start, found.path)) == {tuple(c) for c in np.argwhere(part)}
    assert part.sum() - 1 <= found.lower_bound <= found.steps
    assert found.expanded == 50
    assert found.optimal == (found.lower_bound == found.steps)


def test_one_cell():
    found = js.plan(np.array([[True]]))
    assert (found.steps, found.path, found.optimal, found.start) == (0, "", True, (0, 0))


@pytest.mark.parametrize(
    ("dig", "start", "message"),
    [
        (np.zeros((3, 3), bool), None, "map: got no cell to dig"),
        (np.eye(3, dtype=bool), None, r"map: got 3 pieces, with cells \(0, 0\), \(1, 1\), \(2, 2\)"),
        (np.ones((2, 2), bool), (5, 5), r"start: got \(5, 5\)"),
        (np.ones((2, 2)), None, "map: got float64"),
        (np.ones(4, bool), None, r"map: got bool of shape \[4\]"),
    ],
)
def test_bad_input(dig, start, message):
    with pytest.raises(ValueError, match=message):
        js.plan(dig, start)
