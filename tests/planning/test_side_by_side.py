"""Searches side by side find what each finds alone, in fewer calls of the simulator; and an error ends them all."""

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import jaxsand as js
from jaxsand.planning import side_by_side as side_by_side_module
from jaxsand.planning.side_by_side import in_one_batch, side_by_side

SCENE = js.make_scene((8, 8), 0.01, tool=js.Blade())
WIDER = replace(SCENE, tool=js.Blade(width=0.03))


class Simulator:
    """Adds a number to each map, and keeps the sizes of the batches."""

    def __init__(self):
        self.batches = []

    def add(self, scene, maps, numbers):
        self.batches.append((float(scene.tool.width), len(maps)))
        return {"maps": maps + numbers[:, None, None]}


def search(simulator, scene, calls, size, first):
    """A search that makes so many calls, each with so many maps, and builds upon what it was told."""
    maps = np.full((size, 2, 2), float(first))
    for k in range(calls):
        maps = in_one_batch(simulator.add, scene, maps, np.arange(size) + k * 1.0)["maps"]
    return maps


def test_each_is_answered_as_alone_in_as_few_calls_as_there_can_be():
    alone, crowd = Simulator(), Simulator()
    calls, sizes = (3, 1, 5, 2), (2, 1, 3, 1)
    jobs = [(SCENE, n, size, first) for first, (n, size) in enumerate(zip(calls, sizes, strict=True))]
    expected = [search(alone, *job) for job in jobs]
    found = side_by_side([partial(search, crowd, *job) for job in jobs])
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    assert [n for _, n in crowd.batches] == [7, 6, 5, 3, 3]
    assert len(alone.batches) == sum(calls)


def test_what_differs_in_scene_or_shape_is_answered_apart():
    simulator = Simulator()
    jobs = [(SCENE, 2, 1, 0), (WIDER, 2, 2, 0), (SCENE, 2, 4, 0)]
    side_by_side([partial(search, simulator, *job) for job in jobs])
    assert sorted(simulator.batches) == [(pytest.approx(0.02), 5)] * 2 + [(pytest.approx(0.03), 2)] * 2


def test_the_first_error_ends_all_and_is_raised():
    simulator = Simulator()

    def fails(scene, maps, numbers):
        raise ValueError("depth: got nan; give a number")

    def another():
        for _ in range(1000):
            in_one_batch(simulator.add, SCENE, np.zeros((1, 2, 2)), np.zeros(1))

    with pytest.raises(ValueError, match="depth"):
        side_by_side([another, lambda: in_one_batch(fails, SCENE, np.zeros((1, 2, 2)), np.zeros(1)), another])
    with pytest.raises(ZeroDivisionError):
        side_by_side([another, lambda: 1 / 0, another])


def test_one_search_or_none_asks_at_once():
    simulator = Simulator()
    assert side_by_side([]) == []
    (found,) = side_by_side([partial(search, simulator, SCENE, 2, 1, 5)])
    np.testing.assert_array_equal(found, np.full((1, 2, 2), 6.0))
    assert [n for _, n in simulator.batches] == [1, 1]


def test_what_most_ask_is_answered_first_and_the_few_join_later():
    """One search is a call ahead of two others, which ask something else between; its last call waits for theirs."""
    simulator, lifted = Simulator(), []

    def lift(scene, maps):
        lifted.append(len(maps))
        return maps

    def ahead():
        return search(simulator, SCENE, 2, 1, 0)

    def behind():
        in_one_batch(lift, SCENE, search(simulator, SCENE, 1, 1, 0))
        return search(simulator, SCENE, 1, 1, 0)

    side_by_side([ahead, behind, behind])
    assert [n for _, n in simulator.batches] == [3, 3]
    assert lifted == [2]


def test_a_batch_has_no_more_maps_than_fit(monkeypatch):
    monkeypatch.setattr(side_by_side_module, "_MAPS", 3)
    monkeypatch.setattr(side_by_side_module, "_SEARCHES", 3)
    simulator = Simulator()
    found = side_by_side([partial(search, simulator, SCENE, 2, size, size) for size in (1, 2, 5, 1, 1)])
    assert [len(maps) for maps in found] == [1, 2, 5, 1, 1]
    assert [n for _, n in simulator.batches] == [3, 3, 5, 5, 2, 2]


def test_a_thread_that_cannot_be_started_ends_all(monkeypatch):
    simulator, started, usual = Simulator(), [], threading.Thread.start

    def start(self):
        started.append(self)
        if len(started) > 2:
            raise RuntimeError("can't start new thread")
        usual(self)

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        side_by_side([partial(search, simulator, SCENE, 3, 1, 0)] * 4)
    assert not simulator.batches


def test_nothing_is_an_answer_and_the_callers_context_is_seen():
    asked = []

    def nothing(scene, maps):
        asked.append(len(maps))

    def one():
        return in_one_batch(nothing, SCENE, np.zeros((1, 2, 2))), np.geterr()["over"]

    with np.errstate(over="raise"):
        assert side_by_side([one, one]) == [(None, "raise")] * 2
    assert asked == [2]
