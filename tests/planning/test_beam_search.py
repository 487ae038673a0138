"""Looking ahead: with policies of known worth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from jaxsand.bench.stroke_goals import letters
from jaxsand.planning.around import Around
from jaxsand.planning.learned.beam_search import look_ahead, most_calls, one_after_the_other, put_right
from jaxsand.planning.learned.stages import Stages, plan_by_policy
from jaxsand.planning.stroke_loss import sand_loss
from jaxsand.scene.scene import make_scene


@pytest.fixture(scope="module")
def letter():
    """An F, of three strokes."""
    return letters("F")[0]


@pytest.fixture(scope="module")
def sand(letter):
    return sand_loss(letter.scene, letter.start, letter.goal)


@dataclass(frozen=True)
class Always:
    """Proposes the same strokes, whatever it sees, in this order."""

    strokes: np.ndarray

    def propose(self, scene, goal, current, count):
        some = self.strokes[:count]
        return np.repeat(some[None], len(goal), 0), np.zeros((len(goal), len(some)))


def test_the_policy_alone_makes_its_first_stroke_again_and_again(letter, sand):
    plans, maps = one_after_the_other(Always(letter.strokes), letter.scene, letter.start[None], letter.goal[None], 2)
    assert plans.shape == (1, 2, 4)
    np.testing.assert_array_equal(plans[0, 0], plans[0, 1])
    assert maps.shape == (3, 1, *letter.scene.grid.shape)
    np.testing.assert_allclose(maps[2, 0], sand.maps(plans)[0], atol=1e-7)


def test_many_goals_at_once_are_what_each_is_alone(letter):
    goals = np.stack([letter.goal, letter.goal * 0])
    start = np.zeros_like(goals)
    _, both = one_after_the_other(Always(letter.strokes), letter.scene, start, goals, 1)
    _, one = one_after_the_other(Always(letter.strokes), letter.scene, start[:1], goals[:1], 1)
    np.testing.assert_allclose(both[1, 0], one[1, 0], atol=1e-7)


@pytest.mark.wide
def test_looking_ahead_finds_the_order_and_leaves_out_what_misleads(letter, sand):
    wrong = np.array([[0.05, 0.05, 0.25, 0.06]])
    found = look_ahead(Always(np.concatenate([wrong, letter.strokes[::-1]])), sand, 3, width=4)
    assert len(found.strokes) == 3
    assert found.losses[0] == sand.loss_of(letter.start)
    assert np.all(np.diff(found.losses) < 0)
    np.testing.assert_allclose(found.losses[-1], sand(found.strokes[None])[0], rtol=1e-3, atol=1e-9)
    assert found.losses[-1] < 0.1 * found.losses[0]
    assert found.calls <= most_calls(3, 4) == 3 * 4**2 + 8 * 3**2 + 14 * 3 + 3


@pytest.mark.wide
def test_what_is_a_little_off_is_put_right(letter, sand):
    crooked = letter.strokes + np.array([0.001, -0.0015, -0.0005, 0.001])
    found = look_ahead(Always(crooked), sand, 3, width=3)
    assert found.losses[-1] < 0.1 * sand(crooked[None])[0]


@dataclass(frozen=True)
class Bowl:
    """A loss with parabolas in every number, least at a plan [N, 4]; infinite where its first number exceeds `wall`."""

    least: np.ndarray
    wall: float = np.inf

    def __call__(self, plans):
        steep = 1 + np.arange(self.least.size).reshape(self.least.shape)
        far = (steep * (plans - self.least) ** 2).sum((1, 2))
        return np.where(plans[:, 0, 0] > self.wall, np.inf, far)


def test_what_is_like_a_plan_is_told_as_if_it_were_pushed(letter, sand):
    """Strokes moved, turned, swapped, left out, and added to F's three, of which two do not touch each other."""
    plan = letter.strokes
    turned, swapped = plan.copy(), plan[[1, 0, 2]]
    turned[1] = plan[1, [2, 3, 0, 1]]
    near = Around(sand, plan)
    moved = np.repeat(plan[None], 3, 0) + 0.002 * np.eye(3)[:, :, None]
    for plans in (np.stack([plan, turned, swapped, *moved]), np.stack([plan[1:], plan[:2]]), plan[None, [0, 1, 2, 0]]):
        before = near.calls
        np.testing.assert_allclose(near.left(plans), sand.maps(plans), atol=1.5e-5)  # settling's tolerance, a cell long
        assert near.calls - before <= near.most(plans).sum() < plans.shape[0] * plans.shape[1]
    np.testing.assert_array_equal(
        near.losses, [sand.loss_of(letter.start), *(sand(plan[None, : k + 1])[0] for k in range(3))]
    )


@dataclass
class Near:
    """Tells the losses of plans like one, and counts them."""

    far: Callable[[np.ndarray], np.ndarray]
    calls: int = 0

    def varied(self, plans):
        self.calls += len(plans)
        return self.far(plans)


def test_parabolas_lead_to_the_least_at_once_and_not_beyond_a_wall(letter):
    least = letter.strokes + np.random.default_rng(0).uniform(-0.002, 0.002, letter.strokes.shape)
    bowl = Bowl(least)
    plan, calls = put_right(
        lambda _: Near(bowl), letter.scene, letter.strokes, bowl(letter.strokes[None])[0]
    )  # cells of 10 mm: within the first quarter
    np.testing.assert_allclose(plan, least, atol=1e-8)
    assert calls == 2 * (8 * 3 + 2)
    walled = Bowl(least, wall=letter.strokes[0, 0])
    plan, _ = put_right(lambda _: Near(walled), letter.scene, letter.strokes, walled(letter.strokes[None])[0])
    assert plan[0, 0] <= walled.wall
    assert walled(plan[None])[0] < 0.5 * walled(letter.strokes[None])[0]


def test_where_a_loss_only_falls_ends_go_the_whole_way_but_not_off_the_map(letter):
    scene = make_scene((10, 30), 0.01, tool=letter.scene.tool)
    start = np.array([[0.1, 0.02, 0.29, 0.05]])
    aim = np.array([[0.2, -0.1, 0.4, 0.15]])

    def roof(plans):
        gone = ((plans - start) @ np.sign(aim - start)[0]).sum(1)
        return 1 - gone - gone**2  # the farther, the more a step gains

    plan, _ = put_right(lambda _: Near(roof), scene, start, 1.0)
    np.testing.assert_allclose(plan, [[0.1035, 0.0165, 0.2935, 0.0535]])
    edge, _ = put_right(lambda _: Near(roof), scene, np.array([[0.1, 0.006, 0.294, 0.05]]), 1.0)
    assert edge[0, 1] == pytest.approx(0.005)
    assert edge[0, 2] == pytest.approx(0.295)


@pytest.mark.wide
def test_nothing_is_done_where_nothing_helps(letter):
    done = sand_loss(letter.scene, letter.goal, letter.goal)
    found = look_ahead(Always(letter.strokes), done, 3, width=2)
    assert found.strokes.shape == (0, 4)
    assert found.losses.tolist() == [0.0]
    planned = plan_by_policy(Always(letter.strokes), done, 3, Stages(width=2, polish=100))
    assert len(planned.strokes) == 0
    assert planned.after == planned.before == 0
    assert planned.reason.startswith("the sand lies as the goal has it already")


@pytest.mark.slow
def test_gradients_bring_a_plan_closer_or_leave_it(letter, sand):
    crooked = letter.strokes + 0.004
    alone = plan_by_policy(Always(crooked), sand, 3, Stages(width=3))
    polished = plan_by_policy(Always(crooked), sand, 3, Stages(width=3, polish=300))
    assert alone.after < alone.before
    assert polished.after < 0.5 * alone.after
    np.testing.assert_allclose(polished.after, sand(polished.strokes[None])[0], rtol=1e-3)
    assert polished.calls <= alone.calls + 300
