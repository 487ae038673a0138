"""The policy's network, how strokes are read off it, and its file."""

import subprocess
import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsand.planning.learned.network import (
    Lines,
    Scores,
    StrokeNet,
    ends,
    likeliest,
    seen_along,
    spread,
    symmetric,
)
from jaxsand.planning.learned.policy import Policy, load_policy, save_policy
from jaxsand.planning.learned.square_symmetries import turned, turned_back, turned_strokes, turned_strokes_back
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Blade

NET = StrokeNet((8, 8, 8), (1, 1, 1))
SIDE = 32
NPY = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n" + bytes(8)


look = jax.jit(partial(NET.apply, method="look"))
along = jax.jit(partial(NET.apply, method="along"))
of_all_views = jax.jit(partial(symmetric, NET))


def maps(seed, count=2):
    return jnp.asarray(np.random.default_rng(seed).standard_normal((count, SIDE, SIDE)), jnp.float32)


@pytest.fixture(scope="module")
def params():
    variables = jax.jit(NET.init)(jax.random.key(0), maps(0), maps(1), jnp.zeros((2, 1, 4), jnp.float32))
    return jax.tree.map(lambda p: p + 0.1 * np.sin(np.arange(p.size, dtype=p.dtype)).reshape(p.shape), variables)


@pytest.mark.wide
def test_starts_and_ends_are_shares_of_one(params):
    scores = look(params, maps(0), maps(1))
    np.testing.assert_allclose(jnp.exp(scores.start).sum((1, 2)), 1, rtol=1e-5)
    points = jnp.array([[[3.2, 4.9]], [[31.9, 0.0]]], jnp.float32)
    np.testing.assert_allclose(jnp.exp(ends(scores, points)).sum((2, 3)), 1, rtol=1e-5)


def test_points_are_spread_over_the_cells_around_them():
    share = spread(jnp.array([2.75, 1.5]), (4, 5))
    np.testing.assert_allclose(share.sum(), 1)
    np.testing.assert_allclose(share[1, 2], 0.75)
    np.testing.assert_allclose(share[1, 3], 0.25)


def test_lines_see_what_lies_on_them():
    y, x = jnp.meshgrid(jnp.arange(SIDE) + 0.5, jnp.arange(SIDE) + 0.5, indexing="ij")
    sight, stroke = jnp.stack([x, y], -1)[None, None], jnp.array([[[[4.0, 8.0, 20.0, 24.0]]]])
    seen = seen_along(sight, stroke)[0, 0, 0]
    np.testing.assert_allclose(seen[1], [4, 8], atol=1e-5)
    np.testing.assert_allclose(seen[-2], [20, 24], atol=1e-5)
    np.testing.assert_allclose(seen[0], [4 - 1.5 / np.sqrt(2), 8 - 1.5 / np.sqrt(2)], atol=1e-5)
    np.testing.assert_allclose(np.diff(seen[1:-1, 0]), 16 / 11, atol=1e-5)
    left = seen_along(sight, stroke, np.sqrt(2))[0, 0, 0]
    np.testing.assert_allclose(left - seen, np.tile([-1, 1], (len(seen), 1)), atol=1e-5)


@pytest.mark.parametrize("way", range(8))
def test_strokes_turn_with_their_maps(way):
    stroke = jnp.array([3.5, 8.5, 20.5, 25.5])
    x0, y0, x1, y1 = turned_strokes(stroke, way, SIDE)
    ends = jnp.zeros((1, SIDE, SIDE)).at[0, 8, 3].set(1).at[0, 25, 20].set(2)
    there = turned(ends, way)[0]
    assert (there[int(y0), int(x0)], there[int(y1), int(x1)]) == (1, 2)
    np.testing.assert_array_equal(turned_back(there[None], way), ends)
    np.testing.assert_allclose(turned_strokes_back(jnp.stack([x0, y0, x1, y1]), way, SIDE), stroke)


def test_what_is_symmetric_turns_with_its_maps(params):
    goal, current = maps(0), maps(1)
    strokes = jnp.array([[[4.0, 8.0, 20.0, 24.0], [9.0, 3.0, 11.0, 30.0]]] * 2, jnp.float32)
    one = of_all_views(params, goal, current)
    lines = along(params, one, strokes)
    assert np.abs(lines.strokes - strokes).max() > 0.01
    for way in (1, 2, 4, 7):
        other = of_all_views(params, turned(goal, way), turned(current, way))
        np.testing.assert_allclose(other.start, turned(one.start, way), atol=1e-4)
        seen = along(params, other, turned_strokes(strokes, way, SIDE))
        np.testing.assert_allclose(seen.due, lines.due, atol=1e-4)
        np.testing.assert_allclose(seen.strokes, turned_strokes(lines.strokes, way, SIDE), atol=1e-4)


def test_the_likeliest_strokes_are_read_between_the_peaks():
    wanted = np.array([[5.5, 6.5, 20.5, 6.5], [8.5, 25.5, 8.5, 12.5]])
    start, query, key = np.full((SIDE, SIDE), -20.0), np.zeros((SIDE, SIDE, 2)), np.zeros((SIDE, SIDE, 2))
    for k, (x0, y0, x1, y1) in enumerate(wanted - 0.5):
        start[int(y0), int(x0)] = -k
        query[int(y0), int(x0), k] = 20
        key[int(y1), int(x1), k] = 1
    scores = Scores(*(jnp.asarray(x, jnp.float32)[None] for x in (start, query, key, np.zeros((1, SIDE, SIDE, 1)))))

    def alike(_, strokes):
        return Lines(jnp.zeros(strokes.shape[:2], strokes.dtype), strokes)

    strokes, score = likeliest(alike, scores, 2)
    np.testing.assert_allclose(strokes[0], wanted, atol=0.1)
    assert score[0, 0] > score[0, 1]

    def second_only(_, strokes):
        return jnp.where(jnp.abs(strokes[..., 0] - 8.5) < 1, 20.0, -20.0).astype(strokes.dtype)

    found, _ = likeliest(lambda *a: replace(alike(*a), due=second_only(*a)), scores, 1)
    np.testing.assert_allclose(found[0, 0], wanted[1], atol=0.1)
    moved, _ = likeliest(lambda *a: replace(alike(*a), strokes=a[1] + 0.25), scores, 2)
    np.testing.assert_allclose(moved[0], wanted + 0.25, atol=0.1)


@pytest.mark.parametrize("shape", [(32, 32), (20, 32), (40, 70), (1, 5)])
def test_proposals_lie_on_maps_of_any_shape(params, shape):
    scene = make_scene(shape, 0.01, tool=Blade())
    rng = np.random.default_rng(0)
    goal, current = (1e-3 * rng.standard_normal((3, *shape)) for _ in range(2))
    strokes, scores = Policy(NET, params).propose(scene, goal, current, 4)
    assert strokes.shape == (3, 4, 4)
    assert np.all(np.diff(scores, axis=1) <= 0)
    assert np.all(strokes > 0)
    assert np.all(strokes < 0.01 * np.array([*shape[::-1]] * 2))
    alone, _ = Policy(NET, params).propose(scene, goal[1:2], current[1:2], 4)
    np.testing.assert_allclose(alone[0], strokes[1], atol=1e-4)


def test_proposals_go_with_the_depth_of_the_blade(params):
    rng = np.random.default_rng(0)
    goal = 1e-3 * rng.standard_normal((1, SIDE, SIDE))
    shallow, deep = (make_scene((SIDE, SIDE), 0.01, tool=Blade(depth=d)) for d in (0.004, 0.008))
    one = Policy(NET, params).propose(shallow, goal, 0 * goal, 2)[0]
    np.testing.assert_allclose(Policy(NET, params).propose(deep, 2 * goal, 0 * goal, 2)[0], one, atol=1e-5)


def test_a_scene_that_is_not_dug_is_refused(params):
    policy, goal = Policy(NET, params), np.zeros((1, SIDE, SIDE))
    with pytest.raises(ValueError, match=r"scene\.tool: got NoTool; give make_scene"):
        policy.propose(make_scene((SIDE, SIDE), 0.01), goal, goal)
    with pytest.raises(ValueError, match=r"scene\.tool\.depth: got"):
        policy.propose(make_scene((SIDE, SIDE), 0.01, tool=Blade(depth=-0.001)), goal, goal)


def test_a_policy_comes_back_from_its_file_in_half_precision(params, tmp_path):
    save_policy(Policy(NET, params), tmp_path / "policy.npz", seed=3)
    again = load_policy(tmp_path / "policy.npz")
    assert again.net == NET
    for a, b in zip(jax.tree.leaves(params), jax.tree.leaves(again.params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_parameters_of_another_network_are_refused(params, tmp_path):
    others = jax.tree.map(lambda p: p[..., :-1], params)
    save_policy(Policy(NET, others), tmp_path / "policy.npz")
    with pytest.raises(ValueError, match=r"policy: .*policy\.npz holds no parameters of this version's network; reinstall"):
        load_policy(tmp_path / "policy.npz")


@pytest.mark.parametrize("content", [b"", b"no policy", b"PK\x03\x04 cut off", NPY, None])
def test_a_file_that_is_no_policy_is_refused(content, tmp_path):
    path = tmp_path / "policy.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"policy: cannot read .*policy\.npz .*; reinstall jaxsand .*checkout"):
        load_policy(path)


ELSEWHERE = """
import sys
sys.modules |= {"jaxsand": None, "flax": None}
import numpy as np
from jax import export
with open("policy.jax", "rb") as file:
    propose = export.deserialize(bytearray(file.read())).call
goal, sand = np.load("maps.npy")
np.savez("proposed.npz", *propose(goal, sand, np.float32(0.02), np.float32(0.01)))
"""


def test_a_policy_runs_without_jaxsand_and_flax(params, tmp_path):
    policy, scene = Policy(NET, params), make_scene((SIDE, SIDE), 0.01, tool=Blade(0.02, 0.01, 0.02))
    goal, current = np.asarray(maps(4, 3)) / 100, np.asarray(maps(5, 3)) / 100
    np.save(tmp_path / "maps.npy", np.stack([goal, current]))
    policy.export(tmp_path / "policy.jax", count=5)
    done = subprocess.run([sys.executable, "-c", ELSEWHERE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "proposed.npz") as there:
        strokes, scores = there["arr_0"], there["arr_1"]
    here = policy.propose(scene, goal, current, count=5)
    np.testing.assert_allclose(strokes, here[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(scores, here[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [0, 97, 1.5, True])
def test_a_policy_is_not_exported_for_so_many_strokes(params, tmp_path, count):
    with pytest.raises(ValueError, match=r"count: got .*; give a whole number from 1 to 96"):
        Policy(NET, params).export(tmp_path / "policy.jax", count)
    assert not list(tmp_path.iterdir())
