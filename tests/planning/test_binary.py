"""Single strokes over binary maps: the published counts, brute force, an independent solver, and what is refused."""

import string
import time
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, milp

import jaxsand as js
from jaxsand.bench import complexity
from jaxsand.goals.letters import letter_map
from jaxsand.planning.binary import connected_pieces, make_problem, relaxed
from jaxsand.planning.binary.anytime import nearest_first, simple_bound
from jaxsand.planning.binary.board import MOVES, blocks_of
from jaxsand.planning.binary.bound import block_bound
from jaxsand.planning.binary.exact import exact
from jaxsand.planning.binary.improve import improved
from jaxsand.planning.binary.plans import walk_cost
from jaxsand.planning.binary.sweepline import LineSweep, WalkEnds, steps_of

ENGINES = ("astar", "exact", "anytime")


def replay(start, path):
    cells = [start]
    for letter in path:
        cells.append((cells[-1][0] + MOVES[letter][0], cells[-1][1] + MOVES[letter][1]))
    return cells


def shortest(problem):
    """Breadth first over (cell, dug): the true optimum."""
    near = problem.board.near
    everything = (1 << len(near)) - 1
    layer = {(s, 1 << s) for s in problem.starts}
    seen, steps = set(layer), 0
    while not any(dug == everything and problem.end in (None, cell) for cell, dug in layer):
        layer = {(j, dug | 1 << j) for cell, dug in layer for j in near[cell]} - seen
        seen |= layer
        steps += 1
    return steps


def random_map(rng, most, rows=5, columns=5):
    """The largest piece of a random map, of at most so many cells, and those cells."""
    while True:
        dig = rng.random((rng.integers(1, rows + 1), rng.integers(1, columns + 1))) < rng.choice([0.55, 0.7, 0.85])
        pieces = connected_pieces(dig)
        if pieces and len(pieces[0]) <= most:
            part = np.zeros_like(dig)
            cells = sorted(pieces[0])
            part[tuple(np.array(cells).T)] = True
            return part, cells


def solved_by_highs(problem):
    """The fewest steps by integer programming: how often each edge is taken, parities, and a flow that keeps it connected."""
    edges = sorted({(min(i, j), max(i, j)) for i, nears in enumerate(problem.board.near) for j in nears})
    n, m = len(problem.board.cells), len(edges)
    start = problem.starts[0]
    # Unknowns: x [m], half degrees [n], odd [n], flow there and back [2 m].
    count = m + 2 * n + 2 * m
    x, half, odd, flow = 0, m, m + n, m + 2 * n
    rows, low, high = [], [], []

    def row(terms, least, most):
        rows.append(terms)
        low.append(least)
        high.append(most)

    for v in range(n):
        touching = [k for k, e in enumerate(edges) if v in e]
        row([(x + k, 1) for k in touching] + [(half + v, -2), (odd + v, -1)], 0, 0)
        inflow = [(flow + k, 1 if edges[k][1] == v else -1) for k in touching]
        inflow += [(flow + m + k, -1 if edges[k][1] == v else 1) for k in touching]
        if v != start:
            row(inflow, 1, 1)
    for k in range(m):
        row([(flow + k, 1), (x + k, 1 - n)], -np.inf, 0)
        row([(flow + m + k, 1), (x + k, 1 - n)], -np.inf, 0)
    row(
        [(odd + v, 1) for v in range(n) if v != start] + [(odd + start, -1)], 0, 0
    )  # the start is odd, and one other, or none
    row([(odd + v, 1) for v in range(n)], 0, 2)
    matrix = np.zeros((len(rows), count))
    for i, terms in enumerate(rows):
        for column, value in terms:
            matrix[i, column] += value
    whole = np.concatenate([np.ones(m + 2 * n), np.zeros(2 * m)])
    top = np.concatenate([np.full(m, 2), np.full(n, 4), np.ones(n), np.full(2 * m, n)])
    cost = np.concatenate([np.ones(m), np.zeros(count - m)])
    found = milp(cost, constraints=LinearConstraint(matrix, low, high), integrality=whole, bounds=Bounds(0, top))
    assert found.success
    return round(found.fun)


@pytest.mark.parametrize(("letter", "steps"), [("A", 23), ("S", 27), ("T", 18), ("R", 25)])
def test_published_step_counts(letter, steps):
    found = js.plan(*letter_map(letter))
    assert (found.steps, found.optimal, found.lower_bound, found.gap) == (steps, True, steps, 0)


@pytest.mark.wide
@pytest.mark.parametrize(("letter", "alpha"), complexity.PUBLISHED)
def test_the_papers_search_opens_as_many_nodes_as_published(letter, alpha):
    nodes, steps = complexity.PUBLISHED[letter, alpha]
    found = js.plan(*letter_map(letter), engine="paper", weight=7.2 / alpha)
    assert found.steps == steps
    assert found.opened == pytest.approx(nodes, rel=0.15)
    assert found.optimal == (alpha == 7.2)
    if (letter, alpha) == ("T", 3.0):
        assert found.opened == nodes


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_every_letter_is_dug_by_a_proven_plan(letter):
    dig, start = letter_map(letter)
    plans = [js.plan(dig, start, engine=engine) for engine in ENGINES]
    for found in plans:
        cells = replay(start, found.path)
        assert tuple(cells) == found.cells
        assert set(cells) == {tuple(c) for c in np.argwhere(dig)}
        assert found.optimal
        assert found.steps == plans[0].steps
    assert plans[0].expanded <= {"A": 40, "S": 30, "T": 20, "R": 35}.get(letter, 60)
    free = js.plan(dig)
    assert free.optimal
    assert free.steps == js.plan(dig, engine="astar").steps <= plans[0].steps
    assert set(replay(free.start, free.path)) == set(cells)


@pytest.mark.wide
def test_brute_force_agrees():
    rng = np.random.default_rng(0)
    for k in range(1000):
        dig, cells = random_map(rng, 25 if k % 10 == 0 else 16)
        pick = [cells[i] for i in rng.integers(len(cells), size=4)]
        start = (None, pick[0], pick[0], pick[:3])[k % 4]
        end = pick[3] if k % 8 < 3 else None
        best = shortest(make_problem(dig, start, end))
        for engine in ENGINES:
            found = js.plan(dig, start, end=end, engine=engine)
            assert (found.steps, found.optimal, found.lower_bound) == (best, True, best), (dig, start, end, engine)
            assert set(replay(found.start, found.path)) == set(cells)
            assert start is None or found.start == start or found.start in start
            assert end in (None, found.cells[-1])


@pytest.mark.wide
def test_an_integer_programme_agrees():
    rng = np.random.default_rng(1)
    for _ in range(12):
        dig, cells = random_map(rng, 40, 7, 7)
        start = cells[rng.integers(len(cells))]
        best = solved_by_highs(make_problem(dig, start))
        found = js.plan(dig, start)
        assert (found.steps, found.lower_bound, found.optimal) == (best, best, True)


def test_the_bounds_never_exceed_what_is_left():
    rng = np.random.default_rng(2)
    for _ in range(60):
        dig, cells = random_map(rng, 13)
        problem = make_problem(dig)
        board, n = problem.board, len(cells)
        end = int(rng.integers(n)) if rng.random() < 0.4 else None
        bound = block_bound(board, end)
        # Backwards from the end: the steps left of every state.
        left = {(cell, 0): 0 for cell in range(n) if end in (None, cell)}
        layer, steps = list(left), 0
        while layer:
            steps += 1
            before = []
            for cell, undug in layer:
                for j in board.near[cell]:
                    for was in {undug, undug | 1 << cell} if not undug >> cell & 1 else set():
                        if (j, was) not in left and not was >> j & 1:
                            left[j, was] = steps
                            before.append((j, was))
            layer = before
        for (cell, undug), truth in left.items():
            assert bound(cell, undug) <= truth
        everything = (1 << n) - 1
        assert simple_bound(problem) <= min(
            left[s, everything & ~(1 << s)] for s in range(n) if (s, everything & ~(1 << s)) in left
        )


def test_turns_cost_what_they_cost():
    rng = np.random.default_rng(3)
    for _ in range(25):
        dig, cells = random_map(rng, 10, 4, 4)
        problem = make_problem(dig, cells[0], turn_cost=0.75)
        # Dijkstra over (cell, heading, dug), small enough to relax until nothing changes.
        best, queue = (
            {(problem.starts[0], None, 1 << problem.starts[0]): 0.0},
            [(problem.starts[0], None, 1 << problem.starts[0])],
        )
        for state in queue:
            cell, heading, dug = state
            for j in problem.board.near[cell]:
                ahead = tuple(np.subtract(problem.board.cells[j], problem.board.cells[cell]))
                cost = best[state] + 1 + 0.75 * (heading is not None and heading != ahead)
                child = (j, ahead, dug | 1 << j)
                if cost < best.get(child, np.inf):
                    best[child] = cost
                    queue.append(child)
        least = min(cost for (_, _, dug), cost in best.items() if dug == (1 << len(cells)) - 1)
        for engine in ("auto", "anytime"):
            found = js.plan(dig, cells[0], turn_cost=0.75, engine=engine)
            assert (found.cost, found.lower_bound, found.optimal) == (least, least, True)
            numbers = [problem.board.cells.index(c) for c in found.cells]
            assert walk_cost(problem, numbers) == found.cost


def test_large_maps_are_proven():
    for dig, start in (
        complexity.stretched("A", 5),
        complexity.stretched("B", 5),
        complexity.thickened("R", 3),
        complexity.grown(32, 460, 0.0, 1),
        (np.ones((16, 16), bool), (0, 0)),
        (np.ones((15, 15), bool), (0, 1)),
    ):
        found = js.plan(dig, start)
        assert found.optimal
        assert set(replay(found.start, found.path)) == {tuple(c) for c in np.argwhere(dig)}
        assert start in (None, found.start)
    # Odd squares from beside the corner: the other colour has more cells, so one is dug twice.
    assert found.steps == 225


def test_anytime_stops_and_says_how_far_it_may_be_off():
    dig, start = complexity.grown(48, 1200, 0.2, 0)
    began = time.monotonic()
    found = js.plan(dig, start, seconds=1)
    assert time.monotonic() - began < 5  # one step of a sweep more, on a busy machine
    assert set(replay(found.start, found.path)) == {tuple(c) for c in np.argwhere(dig)}
    assert dig.sum() - 1 <= found.lower_bound <= found.steps
    assert found.gap == (found.steps - found.lower_bound) / found.lower_bound
    assert found.optimal == (found.lower_bound == found.steps)


@pytest.mark.wide
def test_out_of_budget_it_gives_a_walk_and_an_honest_bound():
    dig, start = complexity.grown(14, 90, 0.3, 1)
    best = js.plan(dig, start)
    assert best.optimal
    for engine, bound in (("astar", 50), ("paper", 50), ("exact", 2), ("auto", 3)):
        found = js.plan(dig, best.start, engine=engine, bound=bound)
        assert set(replay(found.start, found.path)) == {tuple(c) for c in np.argwhere(dig)}
        assert dig.sum() - 1 <= found.lower_bound <= js.plan(dig, best.start).steps <= found.steps
        assert found.optimal == (found.lower_bound == found.steps)
        assert engine not in ("astar", "paper") or found.expanded == 50
    greedy = js.plan(dig, best.start, engine="astar", weight=3.0, bound=100_000)
    assert greedy.lower_bound <= js.plan(dig, best.start).steps <= greedy.steps


def test_nearest_first_is_a_walk():
    problem = make_problem(*complexity.grown(20, 150, 0.2, 3), end=None)
    walk = nearest_first(problem)
    assert set(walk) == set(range(len(problem.board.cells)))
    assert all(b in problem.board.near[a] for a, b in pairwise(walk))


def test_blocks_share_no_edge_and_meet_in_cut_cells():
    dig, _ = complexity.grown(16, 100, 0.3, 0)
    board = make_problem(dig).board
    blocks = blocks_of(board.near)
    edges = [tuple(sorted(e)) for b in blocks for e in b.edges]
    assert len(edges) == len(set(edges)) == sum(map(len, board.near)) // 2
    assert sum(len(b.cells) - 1 for b in blocks) == len(board.cells) - 1  # a tree of blocks


@pytest.mark.wide
def test_truncated_sweeps_and_bounds_by_degrees_prove_nothing_false(monkeypatch):
    rng = np.random.default_rng(4)
    for k in range(300):
        monkeypatch.setattr(relaxed, "_WIDEST", -1 if k % 2 else 10)
        dig, cells = random_map(rng, 14, 4, 5)
        pick = [cells[i] for i in rng.integers(len(cells), size=2)]
        start, end = (None, pick[0])[k % 3 > 0], (None, pick[1])[k % 5 == 0]
        problem = make_problem(dig, start, end)
        best = shortest(problem)
        assert exact(problem, 0).lower_bound <= best
        for width in (1, 3, 20):
            found = exact(problem, width)
            assert found.lower_bound <= best
            assert found.walk is None or len(found.walk) - 1 >= best
        assert exact(problem, 10**6).lower_bound == best
        walk = improved(problem, nearest_first(problem), lambda: None)
        assert best <= len(walk) - 1 <= len(nearest_first(problem)) - 1
        assert set(walk) == set(range(len(cells)))
        assert walk[0] in problem.starts
        assert problem.end in (None, walk[-1])
        assert all(b in problem.board.near[a] for a, b in pairwise(walk))


@pytest.mark.wide
def test_wide_blocks_are_bounded_by_degrees_honestly():
    for seed in range(3):
        dig = np.ones((11, 12), bool)
        rng = np.random.default_rng(seed)
        dig[tuple(rng.integers(1, 10, (2, 2)))] = False
        start = (0, 0)
        board = make_problem(dig, start).board
        for block in blocks_of(board.near):
            for ends in (WalkEnds(0, True, 1, dict.fromkeys(block.cells[1:], 0)), WalkEnds(0, False, 0, {})):
                if 0 in block.cells and not block.bridge:
                    steps = steps_of(block, board.cells)
                    tour = LineSweep(block, steps, ends, relaxed.rest_of(steps, ends, board.colour, lambda: None)).search(
                        500, lambda: None
                    )
                    assert tour.lower_bound <= tour.cost


@pytest.mark.wide
def test_long_ways_do_not_overflow():
    length = 17_000
    dig = np.zeros((2, 2 * length + 2), bool)
    dig[1] = True
    dig[0, length : length + 2] = True
    found = js.plan(dig)
    assert found.optimal
    # From one end to the other, twice across the block in the middle's far side.
    assert found.steps == 2 * length + 3


@pytest.mark.wide
def test_seconds_hold_on_large_maps():
    for dig, options in (
        (np.ones((150, 150), bool), {}),
        (np.ones((1, 30_000), bool), {}),
        (complexity.grown(50, 1000, 0.0, 1)[0], {"turn_cost": 1}),
        (complexity.grown(80, 2600, 0.2, 1)[0], {}),
    ):
        began = time.monotonic()
        found = js.plan(dig, seconds=1, **options)
        assert time.monotonic() - began < 8  # about; the machine may be busy
        assert found.lower_bound <= found.cost


@pytest.mark.wide
def test_whole_layers_are_an_engine_too():
    dig, start = letter_map("P")
    found = js.plan(dig, start, engine="frontier")
    assert (found.steps, found.optimal, found.engine) == (17, True, "frontier")
    assert set(replay(start, found.path)) == {tuple(c) for c in np.argwhere(dig)}
    dig, start = complexity.thickened("A", 2)
    stopped = js.plan(dig, start, engine="frontier", bound=500)
    assert stopped.expanded == 500
    assert stopped.lower_bound <= js.plan(dig, start).steps <= stopped.steps


def test_one_cell():
    for engine in (*ENGINES, "auto", "paper"):
        found = js.plan(np.array([[True]]), engine=engine)
        assert (found.steps, found.path, found.optimal, found.start, found.gap) == (0, "", True, (0, 0), 0)
    assert js.plan(np.ones((1, 2), bool), turn_cost=1.5).cost == 1


@pytest.mark.parametrize(
    ("dig", "options", "message"),
    [
        (np.zeros((3, 3), bool), {}, "map: got no cell to dig"),
        (np.eye(3, dtype=bool), {}, r"map: got 3 pieces, with cells \(0, 0\), \(1, 1\), \(2, 2\)"),
        (np.ones((2, 2), bool), {"start": (5, 5)}, r"start: got \(5, 5\)"),
        (np.ones((2, 2), bool), {"start": "here"}, "start: got 'here'"),
        (np.ones((2, 2), bool), {"end": (0, 7)}, r"end: got \(0, 7\)"),
        (np.ones((2, 2), bool), {"end": 3}, "end: got 3"),
        (np.ones((2, 2)), {}, "map: got float64"),
        (np.ones(4, bool), {}, r"map: got bool of shape \[4\]"),
        (np.ones((2, 2), bool), {"turn_cost": -1}, "turn_cost: got -1"),
        (np.ones((2, 2), bool), {"turn_cost": 1, "engine": "exact"}, "turn_cost: 'exact' does not know turns"),
        (np.ones((2, 2), bool), {"turn_cost": 1e17}, "turn_cost: got 1e"),
        (np.ones((2, 2), bool), {"turn_cost": "1"}, "turn_cost: got '1'"),
        (np.ones((2, 2), bool), {"end": (0.9, 0.2)}, "end: got"),
        (np.ones((2, 2), bool), {"bound": 2.5}, "bound: got 2.5"),
        (np.ones((2, 2), bool), {"bound": 2, "seconds": 1}, "bound: has no effect with seconds"),
        (np.ones((2, 2), bool), {"seconds": "2"}, "seconds: got '2'"),
        ([[True], [True, False]], {}, "map: got rows of different lengths"),
        (np.ones((2, 2), bool), {"engine": "frontier"}, "start: 'frontier' needs one start"),
        (np.ones((2, 2), bool), {"engine": "magic"}, "engine: got 'magic'"),
        (np.ones((2, 2), bool), {"weight": 2}, "weight: has no effect with engine 'auto'"),
        (np.ones((2, 2), bool), {"weight": 0, "engine": "astar"}, "weight: got 0"),
        (np.ones((2, 2), bool), {"seconds": float("nan")}, "seconds: got nan"),
        (np.ones((60, 60), bool), {"engine": "astar"}, "map: got 3600 cells, too many for astar"),
    ],
)
def test_bad_input(dig, options, message):
    with pytest.raises(ValueError, match=message):
        js.plan(dig, **options)
