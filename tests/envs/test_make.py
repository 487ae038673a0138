"""What `make` takes: strokes that make their own goal, rough starts, drawn goals; and what it refuses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsand as js
from jaxsand import envs
from jaxsand.envs.pushing import ByLength
from jaxsand.goals import letters, metrics
from jaxsand.relaxation.settling import steepest_slope

from ..conftest import MU
from .cases import KEY, LETTERS, SMALL, one_map, program, small


@pytest.mark.slow
def test_a_glyphs_own_strokes_make_it():
    strokes = letters.letter_strokes("T")
    env, params = js.make("multi-stroke", goals={"T": strokes}, limit=len(strokes))
    _, state = env.reset(KEY, params)
    begun = float(env.distance(state, params))
    step = program(env)
    for stroke in metrics.place(strokes):
        action = env.action(stroke, params)
        assert env.stroke(action, params) == pytest.approx(stroke, abs=1e-7)
        _, state, _, terminated, truncated, info = step(KEY, state, action, params)
        assert int(info["outcome"]) == 0
    assert (bool(terminated), bool(truncated)) == (False, True)
    assert float(env.distance(state, params)) < 1e-3 * begun
    whole = np.zeros((32, 32), np.float32)
    scene = js.make_scene((32, 32), 0.01, tool=js.Blade())
    for stroke in metrics.place(strokes):
        whole = js.step(scene, whole, stroke).height
    assert np.abs(np.asarray(whole) - np.asarray(params.goals.goals[0])).max() < 1e-6  # as the simulator has it


@pytest.mark.wide
def test_rough_starts_are_at_rest_and_their_goals_are_made_from_them():
    env, params = small(starts=envs.Rough(0.03, 2.0))
    keys = jax.random.split(KEY, 8)
    _, states = jax.vmap(env.reset, (0, None))(keys, params)
    assert len(np.unique(np.asarray(states.height).reshape(8, -1), axis=0)) == 2
    for height in np.asarray(params.goals.starts):
        assert float(steepest_slope(SMALL, height)) < MU + 2e-3
        assert np.ptp(height) > 0.005
    goals_, starts = (np.asarray(x) for x in (params.goals.goals, params.goals.starts))
    changed = np.abs(goals_[:, None] - starts[None]).sum((2, 3))
    assert (changed.argmin(1) == [0, 1]).all()
    assert (changed.min(1) > 0.1).all()


def test_every_goal_is_drawn():
    env, params = small(goals=np.float32([0.001, 0.002, 0.003])[:, None, None] * np.ones((3, 16, 16), np.float32))
    _, states = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, 32), params)
    assert len(np.unique(np.asarray(states.goal).reshape(32, -1), axis=0)) == 3


def test_only_what_is_dug_counts_for_drawn_goals():
    drawn = np.zeros((1, 16, 16), np.float32)
    drawn[0, 6:10, 6:10] = -0.0075
    berms = jnp.asarray(drawn[0]).at[2].set(0.004)
    measures = (
        (envs.OnlyDug(), 0.0),
        (envs.WithBerms(), 4 * 0.004 / 0.0075),
        (envs.Weighted(above=0.25), 2 * 0.004 / 0.0075),
        (envs.Weighted(above=0.25, power=1), 4 * 0.004 / 0.0075),
        (envs.Weighted(above=0.0), 0.0),
    )
    for measure, far in measures:
        env, params = small(goals=drawn, measure=measure)
        _, state = env.reset(KEY, params)
        assert float(env.distance(replace(state, height=berms), params)) == pytest.approx(far)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: js.make("sand"), "^name: got 'sand'; give single-stroke, multi-stroke or excavate"),
        (lambda: js.make("multi-stroke", wind=1, goals=np.zeros((1, 32, 32))), "^wind: no option of multi-stroke"),
        (lambda: js.make("single-stroke", wind=1), "^wind: no option of single-stroke"),
        (
            lambda: js.make("multi-stroke", gols=1),
            "^gols: no option of multi-stroke; give some of goals, starts, seed, scene, limit, zones, batching, heights, "
            "measure, push, settle, stop, or see",
        ),
        (
            lambda: js.make("single-stroke", gols=1),
            "^gols: no option of single-stroke; give some of on, scene, goals, step_cost, limit, or see",
        ),
        (lambda: js.make("single-stroke", scene=SMALL), "^scene: has no effect on a binary map"),
        (lambda: js.make("single-stroke", on=envs.OnSand(), scene=SMALL), r"^scene: got \[16, 16\] cells.*\[62, 62\]"),
        (lambda: small(goals=np.zeros((2, 5, 5))), r"^goals: got shape \[5, 5\], the scene has \[16, 16\]"),
        (lambda: small(goals=np.zeros(16)), r"^goals: got shape \[16\]; give a map \[H, W\], or maps \[G, H, W\]"),
        (lambda: small(goals=[np.zeros((16, 16))]), "^goals: got list; give RandomStrokes"),
        (lambda: small(starts="rough"), "^starts: got 'rough'; give Level"),
        (lambda: small(goals={"x": []}), "^goals: .x. has no list of strokes"),
        (lambda: small(goals={"x": [[0, 0, 1, 1], [0]]}), "^goals: .x. has no list of strokes; give numbers"),
        (lambda: small(goals={"x": [[0, 0, 1, 1j]]}), "^goals: .x. has no list of strokes"),
        (lambda: small(goals={"x": [[0, 0, 1, np.inf]]}), "^goals: .x. has .* as stroke 1; give finite numbers"),
        (lambda: small(goals=np.array([[["a"]]])), "^goals: got <U1; give a map"),
        (
            lambda: small(goals=envs.LevelGoals(jnp.zeros((1, 5, 5)))),
            r"^goals: got maps of \[5, 5\], the scene has \[16, 16\]",
        ),
        (
            lambda: small(goals=envs.LevelGoals(jnp.zeros((1, 16, 16))), starts=envs.Level()),
            "^starts: got Level.*leave it out",
        ),
        (lambda: small(push="fast"), r"^push: got 'fast'; give one of SteppedPush\(\.\.\.\), SwathPush"),
        (lambda: small(stop=True), r"^stop: got True; give one of NoStop"),
        (lambda: small(batching=ByLength), r"^batching: got <class.*; give one of Together\(\.\.\.\), ByLength"),
        (lambda: small(settle=0.1), "^settle: got 0.1; give one of UntilStill.*None"),
        (lambda: small(limit=0), "^limit: got 0; give 1 step or more"),
        (lambda: small(limit="a"), "^limit: got 'a'; give 1 step or more"),
        (lambda: small(seed=-1), "^seed: got -1; give a whole number"),
        (lambda: small(scene="x"), "^scene: got 'x'; give make_scene"),
        (lambda: small(scene=js.make_scene((16, 16), 0.01)), "^scene.tool: got NoTool"),
        (lambda: js.make("single-stroke", on="sand"), r"^on: got 'sand'; give one of OnMap\(\.\.\.\), OnSand"),
        (lambda: js.make("single-stroke", goals="letters"), r"^goals: got 'letters'; give one of MapPool"),
        (lambda: js.make("single-stroke", limit=-3), "^limit: got -3"),
        (lambda: ByLength(0), "^chunk: got 0; give a whole number of at least 1"),
        (lambda: small(starts=envs.Rough(np.inf)), "^starts: got Rough"),
        (lambda: small(goals=envs.RandomStrokes(fewest=3, most=2)), "^goals: got RandomStrokes.*fewest <= most"),
        (lambda: small(starts=envs.Rough(-1.0)), "^starts: got Rough"),
        (lambda: one_map(np.eye(2, dtype=bool)), "^map: got 2 pieces"),
        (lambda: envs.map_pool([]), "^maps: got shapes"),
        (lambda: envs.OnMap((2, 2)).reset(KEY, envs.MapParams(LETTERS)), r"^goals.dig: got maps of \[7, 7\]"),
    ],
)
def test_what_cannot_be_made_is_said(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_goals_that_are_ready_hold_no_cells_without_data():
    maps = np.ma.masked_equal(np.where(np.arange(32) == 3, -9999.0, np.zeros((1, 32, 32))), -9999)
    for ready in (envs.LevelGoals(maps), envs.LevelGoals(maps.filled(np.nan))):
        with pytest.raises(ValueError, match="^goals: got 32 cells that are not finite"):
            js.make("multi-stroke", goals=ready)
    with pytest.raises(ValueError, match="^starts: got 32 cells that are not finite"):
        js.make("multi-stroke", goals=envs.RoughGoals(np.zeros((1, 32, 32)), maps))
