"""The layered search: published step counts, brute force, honest bounds, exact deduplication."""

import string
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand.bench.expansions import heap_misdug, heap_two_colours
from jaxsand.goals.letters import letter_map
from jaxsand.planning.binary import connected_pieces, frontier
from jaxsand.planning.binary.frontier import layered, misdug, two_colours
from jaxsand.planning.binary.graph import goal_only, grid_near, make_graph, with_margin

SMALL = {"chunk": 512, "slots": 1 << 14}  # one set of programs for all small maps


def random_map(rng, rows, columns):
    dig = rng.random((rng.integers(1, rows + 1), rng.integers(1, columns + 1))) < 0.75
    pieces = connected_pieces(dig)
    if not pieces:
        return random_map(rng, rows, columns)
    part = np.zeros_like(dig)
    part[tuple(np.array(sorted(pieces[0])).T)] = True
    cells = sorted(pieces[0])
    return part, cells[rng.integers(len(cells))]


def bits(words):
    return sum(int(word) << (32 * i) for i, word in enumerate(words))


def reachable(graph, most):
    """f = g + misdug of every state (cell, dug) with f at most `most`: breadth first."""
    goal, f = bits(graph.goal), {}
    layer, g = {(int(graph.start), 1 << int(graph.start))}, 0
    while layer:
        f |= {state: g + (state[1] ^ goal).bit_count() for state in layer}
        g += 1
        layer = {(j, dug | 1 << j) for i, dug in layer for j in graph.near[i].tolist() if j >= 0} - f.keys()
        layer = {(i, dug) for i, dug in layer if g + (dug ^ goal).bit_count() <= most}
    return f


def shortest(graph, state):
    """The fewest steps from a state to the goal: breadth first."""
    goal, layer, steps = bits(graph.goal), {state}, 0
    seen = set(layer)
    while not any(dug == goal for _, dug in layer):
        layer = {(j, dug | 1 << j) for i, dug in layer for j in graph.near[i].tolist() if j >= 0 and goal >> j & 1} - seen
        seen |= layer
        steps += 1
    return steps


def check_walk(graph, found):
    assert found.optimal
    assert found.steps == found.lower_bound == len(found.walk) - 1
    assert found.walk[0] == graph.start
    assert all(b in graph.near[a] for a, b in pairwise(found.walk))
    assert sum(1 << i for i in set(found.walk)) == bits(graph.goal)


@pytest.mark.parametrize(("letter", "steps"), [("A", 23), ("S", 27), ("T", 18), ("R", 25)])
def test_published_step_counts_with_a_margin(letter, steps):
    graph = with_margin(*letter_map(letter))
    found = layered(graph, misdug)
    check_walk(graph, found)
    assert found.steps == steps
    assert 3.5 * found.expanded < found.opened <= 4 * found.expanded


@pytest.mark.parametrize("letter", string.ascii_uppercase)
def test_every_letter_over_its_goal_cells(letter):
    dig, start = letter_map(letter)
    graph = goal_only(dig, start)
    found = layered(graph, two_colours)
    check_walk(graph, found)
    assert found.steps == js.plan(dig, start).steps


@pytest.mark.wide
def test_brute_force_agrees():
    rng = np.random.default_rng(0)
    for _ in range(110):
        dig, start = random_map(rng, 3, 4)
        inside, wide = goal_only(dig, start), with_margin(dig, start)
        best = shortest(inside, (int(inside.start), 1 << int(inside.start)))
        for graph, bound in ((inside, misdug), (inside, two_colours), (wide, misdug), (wide, two_colours)):
            found = layered(graph, bound, **SMALL)
            check_walk(graph, found)
            assert found.steps == best


def test_larger_random_maps_agree_with_the_heap():
    rng = np.random.default_rng(1)
    for _ in range(20):
        dig, start = random_map(rng, 5, 6)
        graph = goal_only(dig, start)
        assert layered(graph, two_colours).steps == heap_two_colours(graph)[0]


@pytest.mark.parametrize("bound", [misdug, two_colours])
def test_bounds_are_admissible_and_consistent(bound):
    rng = np.random.default_rng(2)
    for _ in range(6):
        dig, start = random_map(rng, 3, 4)
        graph = goal_only(dig, start)
        states = list(reachable(graph, 20))
        states = [states[i] for i in rng.permutation(len(states))[:40]]
        steps = [(state, (j, state[1] | 1 << j)) for state in states for j in graph.near[state[0]].tolist() if j >= 0]

        def estimate(chosen, graph=graph):
            cell = jnp.asarray([c for c, _ in chosen], jnp.int32)
            return np.asarray(bound(graph, cell, jnp.asarray([[dug] for _, dug in chosen], jnp.uint32)))

        h = estimate(states)
        remaining = np.array([shortest(graph, state) for state in states])
        assert np.all(h <= remaining)
        assert np.array_equal(h == 0, remaining == 0)
        if steps:
            rise = np.array(1 + estimate([b for _, b in steps]) - estimate([a for a, _ in steps]))
            goal_left = np.array([shortest(graph, a) > 0 for a, _ in steps])
            assert set(rise[goal_left]) <= {0, 1, 2}


def test_no_state_is_dropped_and_hardly_one_expanded_twice():
    graph = with_margin(*letter_map("T"))
    f = np.array(list(reachable(graph, 18).values()))
    found = layered(graph, misdug)
    assert np.sum(f < 18) < found.expanded < 1.005 * np.sum(f <= 18)
    assert heap_misdug(graph)[0] == 18


def test_a_small_memory_of_states_costs_time_only():
    graph = goal_only(*letter_map("R"))
    well, badly = layered(graph, two_colours), layered(graph, two_colours, chunk=512, slots=512)
    check_walk(graph, badly)
    assert badly.steps == well.steps
    assert badly.expanded > well.expanded


def test_stopped_early_its_lower_bound_holds():
    graph = with_margin(*letter_map("S"))
    bounds = []
    for limit in (1, 50, 3000, 60_000):
        found = layered(graph, misdug, limit=limit)
        assert (found.walk, found.steps, found.optimal, found.expanded) == (None, None, False, limit)
        bounds.append(found.lower_bound)
    assert bounds == sorted(bounds)
    assert bounds[0] == bits(graph.goal).bit_count() - 1
    assert bounds[0] < bounds[-1] <= 27
    stopped = layered(graph, misdug, memory=1 << 20)
    assert stopped.walk is None
    assert bounds[0] < stopped.lower_bound <= 27


def test_one_cell():
    graph = goal_only(np.array([[True]]), (0, 0))
    assert layered(graph, two_colours, **SMALL).walk == (0,)


def test_graphs_of_a_size_share_their_programs():
    rng = np.random.default_rng(3)
    layered(goal_only(np.ones((3, 5), bool), (0, 0)), two_colours, **SMALL)
    programs = frontier._expand._cache_size()
    for _ in range(3):
        layered(goal_only(*random_map(rng, 4, 6)), two_colours, **SMALL)
    assert frontier._expand._cache_size() == programs


def test_what_is_refused():
    square = np.ones((2, 2), bool)
    near = grid_near(square)
    with pytest.raises(ValueError, match=r"goal: got cells \[3\] out of reach of start 0"):
        make_graph(near, np.array([True, False, False, True]), 0)
    with pytest.raises(ValueError, match="goal: .*start 1"):
        make_graph(near, np.array([True, False, False, False]), 1)
    triangle = np.array([[1, 2, -1, -1], [0, 2, -1, -1], [0, 1, -1, -1]])
    with pytest.raises(ValueError, match="near: got a cycle of odd length"):
        make_graph(triangle, np.ones(3, bool), 0)
    graph = goal_only(square, (0, 0))
    with pytest.raises(ValueError, match="limit: got 0"):
        layered(graph, two_colours, limit=0)
    with pytest.raises(ValueError, match="chunk, slots: got 100"):
        layered(graph, two_colours, chunk=100)
    with pytest.raises(ValueError, match="bound: got an estimate"):
        layered(graph, lambda graph, cell, dug: 3 * misdug(graph, cell, dug), **SMALL)
