"""The one race: ways take turns, and compiling is told apart."""

import time

import pytest

from jaxsand.bench.timing import race


@pytest.mark.wide
def test_ways_take_turns_and_the_first_call_is_told_apart():
    calls = []

    def way(name, slow):
        def run():
            time.sleep(slow if name not in calls else 0.001)
            calls.append(name)
            return len(calls)

        return run

    timed = race({"a": way("a", 0.05), "b": way("b", 0.001)}, rounds=2, tell=calls.append)
    told = ["a: first call", "b: first call", "a: round 1 of 2", "b: round 1 of 2", "a: round 2 of 2", "b: round 2 of 2"]
    assert calls == [x for line in told for x in (line, line[0])]
    assert timed["a"].result == 2
    assert len(timed["a"].later) == 2
    assert timed["a"].first >= 0.05
    assert timed["a"].compile_seconds > 0.02
    assert timed["a"].best <= timed["a"].median
