"""Settling and pushing where numbers are hard: every row of the suite has to be right."""

import pytest

import jaxsand as js
from jaxsand.bench.stability import stability
from jaxsand.bench.tables import as_table


def wrong(rows):
    return "\n" + "\n".join(as_table([row for row in rows if not row["right"]] or rows[:1], "wrong"))


def usual(case):
    return isinstance(case.scheme, js.SuperTimeStepping) or "far below" in case.name


def telling(case):
    """What has each dtype and outcome, of few programs."""
    names = ("angle", "spike", "offset", "NaN", "far below")
    return usual(case) and case.neighbours == 8 and any(name in case.name for name in names)


@pytest.mark.wide
@pytest.mark.parametrize(("only", "least"), [(telling, 20), pytest.param(usual, 60, marks=pytest.mark.slow)])
def test_hard_numbers(only, least):
    """By the default scheme; another slow test takes the others."""
    rows = stability(64, 20, only=only)
    assert len(rows) > least
    assert all(row["right"] for row in rows), wrong(rows)
    assert {row["dtype"] for row in rows} == {"float16", "float32", "float64"}
    assert {row["outcome"] for row in rows} == {"clean", "not_still", "not_finite"}
    assert all(row["outcome"] != "not_still" for row in rows if row["dtype"] == "float64")


def test_the_judge_is_not_blind():
    """It sees a map that came back too steep, one that lost sand, and one that left its range."""
    from dataclasses import replace

    from jaxsand.bench import stability as suite

    case = next(c for c in suite.cases(8) if c.name == "angle 29 deg")
    for harm in (lambda h: h.at[3, 3].add(1e-3).at[9, 9].add(-1e-3), lambda h: h.at[3, 3].add(-1e-6), lambda h: h * 40):

        class Harmed(suite.SettlingCase):
            def settle(self, height, harm=harm):
                settled = super().settle(height)
                return replace(settled, height=harm(settled.height))

        assert not suite._row(Harmed(**vars(case)), "float64")["right"]
    assert suite._row(case, "float64")["right"]


@pytest.mark.slow
def test_hard_numbers_on_a_large_map_and_over_many_pushes():
    """`jaxsand bench stability` takes 1024 cells a side and 100,000 pushes, in 20 minutes."""
    rows = stability(128, 1_000, only=lambda case: not usual(case) or "column" in case.name)
    assert all(row["right"] for row in rows), wrong(rows)
