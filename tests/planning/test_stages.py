"""The stages of a policy's plan: what gradients find is taken where it is closer, and only there."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxsand.planning.learned import stages

PLAN, POLISHED = np.zeros((2, 4)), np.ones((2, 4))


@pytest.mark.parametrize(("loss", "taken"), [(1.0, True), (2.5, False)])
def test_polish_is_taken_where_it_is_closer(monkeypatch, loss, taken):
    found = SimpleNamespace(strokes=PLAN, losses=[3.0, 2.0], calls=5)
    polished = SimpleNamespace(strokes=POLISHED, losses=[3.0, loss], spent=7)
    monkeypatch.setattr(stages, "look_ahead", lambda *_: found)
    monkeypatch.setattr(stages, "optimise_strokes", lambda *_, **__: polished)
    sand = SimpleNamespace(scene=None, goal=None, start=None, loss_of=lambda _: 4.0)
    planned = stages.plan_by_policy(None, sand, 2, stages.Stages(width=3, polish=100))
    assert (planned.before, planned.after, planned.calls) == (4.0, min(loss, 2.0), 12)
    assert planned.strokes is (POLISHED if taken else PLAN)
