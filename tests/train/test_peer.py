"""The peer's goals and figures, at known answers; and that every method there digs."""

import json

import numpy as np
import pytest

from train import peer
from train.peer import PUBLISHED, compare, judged, peer_goals


def test_goals_are_as_described():
    goals = peer_goals(9, 3)
    assert [goal.name for goal in goals[:4]] == ["rectangle 1", "L 1", "polygon 1", "rectangle 2"]
    for goal in goals:
        depth = -float(goal.goal.min())
        low, high = (0.01, 0.03) if goal.name.startswith("polygon") else (0.005, 0.02)
        assert low <= depth <= high
        assert float(goal.scene.tool.depth) == pytest.approx(depth)
        dig = goal.goal < 0
        assert set(np.unique(goal.goal[dig])) == {np.float32(-depth)}
        assert 10 <= dig.sum() <= 140
        assert not dig[0].any()
        assert not dig[:, 0].any()
        assert not dig[-1].any()
        assert not dig[:, -1].any()
    again = peer_goals(9, 3)
    assert all(np.array_equal(a.goal, b.goal) for a, b in zip(goals, again, strict=True))


def test_figures_at_known_answers():
    goal = peer_goals(1, 0)[0]
    depth = -1e3 * float(goal.goal.min())
    share = float((goal.goal < 0).mean())
    done, none, half = (judged(goal, part * goal.goal) for part in (1.0, 0.0, 0.5))
    assert (done["mm"], done["changed_percent"], done["bed_mm"]) == (0, 100, 0)
    assert none == pytest.approx({"mm": depth, "before_mm": depth, "changed_percent": 0, "bed_mm": depth * share}, rel=1e-5)
    assert half == pytest.approx(
        {"mm": depth / 2, "before_mm": depth, "changed_percent": 100, "bed_mm": depth * share / 2}, rel=1e-5
    )


def test_the_command_gives_its_options_and_prints_the_figures(monkeypatch, capsys):
    given = []
    monkeypatch.setattr(peer, "compare", lambda *options: given.append(options[:4]) or PUBLISHED)
    assert peer.main(["--goals", "3", "--strokes", "5", "--pushes", "70", "--seed", "2", "--json"]) == 0
    assert given == [(3, 5, 70, 2)]
    assert json.loads(capsys.readouterr().out) == {"rows": PUBLISHED}
    assert peer.main(["--strokes", "1000"]) == 2
    assert "strokes: got 1000; give at most 100" in capsys.readouterr().err


def test_a_wrong_method_is_named():
    with pytest.raises(ValueError, match="^methods: got 'luck'; give some of 'policy, looking ahead', .*'plan_sand'"):
        compare(1, 1, 1, 0, lambda _: None, ["plan_sand", "luck"])


@pytest.mark.slow
def test_every_method_digs():
    rows = compare(1, 12, 400, 0, lambda _: None)
    assert len(rows) == 4 + len(PUBLISHED)
    for row in rows[:4]:
        assert row["mm"] < 0.7 * row["before_mm"]
        assert 1 <= row["strokes"] <= 12
