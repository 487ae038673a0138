"""Plans like one that has been pushed, on a stand-in for sand: what is pushed, and what is not."""

from dataclasses import dataclass, field

import numpy as np

from jaxsand.goals.outlines import near
from jaxsand.planning.around import Around
from jaxsand.scene.scene import Scene, make_scene
from jaxsand.scene.tools import Blade

SCENE = make_scene((40, 40), 0.01, tool=Blade(width=0.02, thickness=0.01))
APART = np.array([[0.05, 0.05, 0.1, 0.05], [0.3, 0.3, 0.3, 0.35], [0.05, 0.35, 0.1, 0.35], [0.08, 0.06, 0.08, 0.1]])
"""Strokes of which the first and the last cross."""


@dataclass
class Marked:
    """A stroke adds 1 to what it covers, and then doubles it; of plans only the order of crossing strokes matters."""

    scene: Scene = SCENE
    start: np.ndarray = field(default_factory=lambda: np.zeros((40, 40), np.float32))
    pushed: int = 0

    def after(self, maps, strokes):
        self.pushed += len(strokes)
        covered = np.stack([near(stroke[None], 0.01, self.scene.grid) for stroke in strokes])
        return np.zeros(len(strokes)), np.where(covered, 2 * (maps + 1 + strokes[:, :1, None]), maps).astype(np.float32)

    def costs(self, maps):
        return maps.sum((-2, -1))


def all_pushed(plans):
    sand, maps = Marked(), np.zeros((len(plans), 40, 40), np.float32)
    for k in range(plans.shape[1]):
        maps = sand.after(maps, plans[:, k])[1]
    return maps


def pushes(plans):
    """How many strokes are pushed to tell what the plans leave, after seeing that it is right."""
    sand = Marked()
    around = Around(sand, APART)
    assert around.calls == sand.pushed == len(APART)
    np.testing.assert_array_equal(around.left(plans), all_pushed(plans))
    assert around.calls == sand.pushed
    assert around.calls - len(APART) <= around.most(plans).sum()
    return around.calls - len(APART)


def test_strokes_that_do_not_touch_are_swapped_for_nothing():
    assert pushes(APART[None]) == 0
    assert pushes(APART[None, [1, 0, 2, 3]]) == 0
    assert pushes(APART[None, [2, 0, 3, 1]]) == 0


def test_of_strokes_that_cross_both_are_pushed():
    assert pushes(APART[None, [3, 1, 2, 0]]) == 2
    assert pushes(np.stack([APART[[3, 1, 2, 0]], APART, APART[[1, 0, 2, 3]]])) == 2


def test_a_stroke_that_moves_is_pushed_with_those_that_see_it():
    far, crossed = APART.copy(), APART.copy()
    far[1, 0] += 0.01
    crossed[0, 0] += 0.01
    assert pushes(far[None]) == 1
    assert pushes(crossed[None]) == 2
    assert pushes(np.stack([far, far + 0.01, crossed])) == 1 + 4 + 2


def test_strokes_are_left_out_and_added():
    assert pushes(APART[None, 1:]) == 1
    assert pushes(APART[None, [0, 2, 3]]) == 0
    assert pushes(np.concatenate([APART, APART[:1]])[None]) == 1
    assert pushes(APART[None, :0]) == 0


def test_a_plan_is_pushed_at_most_from_where_it_differs():
    late = APART.copy()
    late[2] += 0.01
    longer = np.concatenate([APART, APART[:1]])
    around = Around(Marked(), APART)
    np.testing.assert_array_equal(around.most(np.stack([APART, late, APART[[1, 0, 2, 3]]])), [0, 2, 4])
    np.testing.assert_array_equal(around.most(longer[None]), [1])
    np.testing.assert_array_equal(around.most(APART[None, :0]), [0])


def test_it_is_told_which_strokes_may_see_what_a_stroke_changes():
    np.testing.assert_array_equal(Around(Marked(), APART).touched, [2, 1, 1, 1])
    assert Around(Marked(), APART[:0]).touched.shape == (0,)


def test_a_plan_whose_maps_are_known_is_not_pushed():
    sand, heights = Marked(), np.insert(APART, [2, 4], -0.01, axis=1)
    maps = np.stack([all_pushed(APART[None, :k])[0] for k in range(5)])
    around = Around(sand, APART, maps)
    assert around.calls == sand.pushed == 0
    np.testing.assert_array_equal(np.concatenate(list(around.along(APART[None]))), maps)
    np.testing.assert_array_equal(Around(sand, heights, maps).touched, around.touched)


def test_beside_a_plan_that_came_to_no_end_all_is_pushed():
    maps = np.stack([all_pushed(APART[None, :k])[0] for k in range(5)])
    maps[2:] = np.nan
    around = Around(Marked(), APART, maps)
    swapped = APART[None, [0, 1, 3, 2]]
    np.testing.assert_array_equal(around.most(swapped), [4])
    around.left(swapped)
    assert around.calls <= 4


def test_losses_are_those_after_each_stroke():
    around = Around(Marked(), APART)
    np.testing.assert_array_equal(around.losses, [all_pushed(APART[None, :k]).sum() for k in range(5)])
    np.testing.assert_array_equal(around.varied(APART[None]), around.losses[-1:])
