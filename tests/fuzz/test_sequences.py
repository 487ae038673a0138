"""Long sequences of every kind of action on random sand, judged after each: a state machine that hypothesis drives and shrinks.

Scenes differ in what is traced (angle, spacing, level, floor, walls), so that a ground's programs are compiled once.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule, run_state_machine_as_test

import jaxsand as js
from jaxsand.envs import LevelGoals

N = 12
FAR = (math.nan, math.inf, -1e30, 3e38)
KNOWN = sum(js.Outcome)
cells = st.floats(-2, N + 2, width=32)  # of the map and a little beyond it
heights = st.floats(-3, 1.5, width=32)  # spacings
points = st.lists(st.tuples(cells, cells, heights), min_size=3, max_size=3)
slope = jax.jit(js.steepest_slope)
dump = jax.jit(js.dump)


@dataclass(frozen=True)
class Ground:
    """What sand lies on and between: the static part of scenes, and which rules there are on it."""

    floor: bool = False
    walls: bool = False
    drains: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    yaw: float | None = None
    bucket_walls: bool = False
    pushes: bool = True
    everything: bool = True
    dtype: str = "float64"

    def most(self) -> float:
        """The share of the sand that rounding may move."""
        return 1e-12 if self.dtype == "float64" else 1e-5


class Sand(RuleBasedStateMachine):
    """A bed of sand, a bucket's load and what has run off."""

    ground = Ground()

    @initialize(
        seed=st.integers(0, 2**16),
        angle=st.floats(0.15, 1.0),
        spacing=st.sampled_from([0.004, 0.01, 0.03]),
        level=st.floats(-1.5, 0.5),
        relief=st.floats(0, 4).map(lambda r: r if r > 1e-20 else 0.0),  # below 1e-38 XLA takes floats for zero
    )
    def begin(self, seed, angle, spacing, level, relief):
        """Rough sand, brought to rest."""
        rng, g = np.random.default_rng(seed), self.ground
        self.dx, self.angle, self.drained, self.load = spacing, angle, 0.0, None
        self.floor = -rng.uniform(1, 3, (N, N)) * spacing if g.floor else np.full((N, N), -np.inf)
        self.solid = (rng.random((N, N)) < 0.08) & g.walls
        grounds = {
            "base": js.Base(jnp.asarray(self.floor, g.dtype)) if g.floor else None,
            "walls": js.Walls(jnp.asarray(self.solid)) if g.walls else None,
            "edge": js.Draining(level * spacing) if g.drains else None,
        }
        blade = js.Blade(3 * spacing, 2 * spacing, spacing, yaw=g.yaw)
        bucket = js.Bucket(
            3 * spacing, 2 * spacing, 4 * spacing**3, spacing, walls=1.5 * spacing if g.bucket_walls else None
        )
        tools = {"blade": blade, "wheel": js.Wheel(4 * spacing, 3 * spacing, spacing, 0.3), "bucket": bucket}
        self.scenes = {
            name: js.make_scene((N, N), spacing, angle, tool=tool, **grounds, **g.options) for name, tool in tools.items()
        }
        rough = np.maximum(rng.uniform(-relief, relief, (N, N)) * spacing, self.floor).astype(g.dtype)
        self.height = jnp.asarray(np.maximum(rough, self.floor.astype(g.dtype)))
        self.total = self.sand()
        self.scale = spacing**2 * float(np.abs(np.where(self.solid, 0, rough)).sum()) + spacing**3
        self.take(js.settle(self.scenes["blade"], self.height))

    def sand(self):
        """The sand (m^3) on the bed, in the bucket and gone over the edge."""
        on_bed = self.dx**2 * np.where(self.solid, 0, np.asarray(self.height, float)).sum()
        held = 0.0 if self.load is None else self.dx**2 * (float(self.load.high) + float(self.load.low))
        return on_bed + held + self.drained

    def take(self, out, load=None):
        """Goes on with what an action left; its outcome is clean and the sand at rest, or is told by name."""
        outcome, before = int(out.outcome), self.height
        assert 0 <= outcome <= KNOWN
        if outcome:
            with pytest.raises(js.OutcomeError, match="; |: "):
                js.check(out)
        self.height, self.drained = out.height, self.drained + float(out.drained)
        self.load = self.load if load is None else load
        if outcome & js.Outcome.NOT_FINITE:
            assert np.array_equal(before, out.height)
        if not outcome & (js.Outcome.NOT_STILL | js.Outcome.NOT_FINITE):
            steepest = float(slope(self.scenes["blade"], self.height))
            assert steepest <= math.tan(self.angle) * (1 + 1e-5) + 1.1e-3

    def path(self, given):
        """The points in metres."""
        return jnp.asarray(np.array(given, float) * self.dx, self.ground.dtype)

    @precondition(lambda self: self.ground.pushes)
    @rule(path=points)
    def push(self, path):
        self.take(js.follow(self.scenes["blade"], self.height, self.path(path)))

    @precondition(lambda self: self.ground.pushes and self.ground.everything)
    @rule(path=points)
    def roll(self, path):
        self.take(js.follow(self.scenes["wheel"], self.height, self.path(path)))

    @precondition(lambda self: self.ground.pushes)
    @rule(path=points, bad=st.sampled_from(FAR), at=st.integers(0, 8))
    def nonsense(self, path, bad, at):
        """A path that is not finite, or lies beyond what floats resolve, leaves all as it was and is told."""
        lost = np.array(path, self.ground.dtype)
        lost[divmod(at, 3)] = bad
        out = js.follow(self.scenes["blade"], self.height, jnp.asarray(lost))
        assert int(out.outcome) & js.Outcome.NOT_FINITE
        self.take(out)

    @rule(path=points)
    def scoop(self, path):
        out = js.scoop(self.scenes["bucket"], self.height, self.path(path), self.load)
        self.take(out, out.load)
        held = float(js.load_volume(self.scenes["bucket"], self.load))
        assert -1e-15 <= held <= 4 * self.dx**3 * (1 + 1e-5)

    @rule(path=points, share=st.floats(0, 2))
    def dump(self, path, share):
        """Pours some of the load, or more than there is."""
        if self.load is None:
            self.load = js.Load(jnp.zeros((), self.ground.dtype), jnp.zeros((), self.ground.dtype))
        asked = share * max(float(js.load_volume(self.scenes["bucket"], self.load)), 0.0)
        before = self.load.high + self.load.low
        eager = js.dump(self.scenes["bucket"], self.height, self.path(path)[:2], self.load, amount=asked)
        if self.ground.everything and not self.ground.bucket_walls:  # the size of its load is no number under jit
            jitted = dump(self.scenes["bucket"], self.height, self.path(path)[:2], self.load, amount=asked)
            assert np.abs(eager.height - jitted.height).max() <= self.ground.most() * self.dx
        self.take(eager, eager.load)
        poured = self.dx**2 * float(before - self.load.high - self.load.low)
        assert -self.ground.most() * self.scale <= poured <= self.dx**2 * float(before) * (1 + 1e-6)
        if not int(eager.outcome):
            assert abs(poured - asked) <= 10 * self.ground.most() * self.scale

    @rule(x=cells, y=cells, volume=st.floats(0, 5), down=st.booleans())
    def pour(self, x, y, volume, down):
        """Puts sand down, or takes some away."""
        act, before = (js.deposit if down else js.remove), self.height
        where = jnp.asarray([x * self.dx, y * self.dx], self.ground.dtype)
        out = act(self.scenes["blade"], self.height, where, volume * self.dx**3)
        moved = self.dx**2 * (np.asarray(out.height, float) - np.asarray(before, float))[~self.solid].sum() + float(
            out.drained
        )
        assert (
            0 <= moved * (1 if down else -1) + self.ground.most() * self.scale <= volume * self.dx**3 * 1.00001 + self.scale
        )
        if not int(out.outcome) & js.Outcome.NOT_POURED:
            assert abs(abs(moved) - volume * self.dx**3) <= self.ground.most() * (self.scale + volume * self.dx**3)
        self.total += moved
        self.scale += volume * self.dx**3
        self.take(out)

    @rule()
    def rest(self):
        """What is still stays as it is."""
        out = js.settle(self.scenes["blade"], self.height)
        if not int(out.outcome) and int(out.sweeps) == 0:
            assert np.array_equal(out.height, self.height)
        self.take(out)

    @precondition(lambda self: self.ground.pushes and self.ground.everything)
    @rule(paths=st.lists(points, min_size=2, max_size=2))
    def batch(self, paths):
        """Two strokes that rise or sink, of a batch and one by one: the path's repeated end changes nothing."""
        ways = [self.path(path)[:2] for path in paths]
        both = js.step_batch(self.scenes["blade"], jnp.stack([self.height] * 2), jnp.stack(ways).reshape(2, 6))
        for k, way in enumerate(ways):
            one = js.follow(self.scenes["blade"], self.height, jnp.concatenate([way, way[1:]]))
            assert int(one.outcome) == int(both.outcome[k])
            most = 1e-7 if self.ground.dtype == "float64" else 1e-2  # rounding may end settling a sweep sooner
            assert np.abs(one.height - both.height[k]).max() <= most * self.dx
        self.take(jax.tree.map(lambda leaf: leaf[0], both))

    @invariant()
    def is_kept(self):
        """Sand is neither made nor lost, is finite, and lies on its floor; what is solid is as it was."""
        if not hasattr(self, "scenes"):
            return
        height = np.asarray(self.height)
        assert np.isfinite(height).all()
        assert np.all((height >= self.floor.astype(height.dtype)) | self.solid)
        assert abs(self.sand() - self.total) <= self.ground.most() * self.scale


class Digging(RuleBasedStateMachine):
    """An environment with the quick push, its rewards and their derivatives."""

    @initialize(seed=st.integers(0, 2**16))
    def begin(self, seed):
        self.env, self.params, reset, self.step = environment()
        self.key = jax.random.key(seed)
        self.obs, self.state = reset(self.key, self.params)
        self.box = self.env.observation_space(self.params)

    @rule(action=st.lists(st.floats(-1.5, 1.5, width=32), min_size=4, max_size=4))
    def act(self, action):
        self.key, key = jax.random.split(self.key)
        before, action = self.state, jnp.asarray(action, jnp.float32)
        (reward, rest), slope = self.step(key, before, action, self.params)
        self.obs, self.state, terminated, truncated, info = rest
        assert np.isfinite(slope).all()
        assert self.box.contains(self.obs)
        assert self.box.contains(info["final_observation"])
        assert np.isfinite(reward)
        begun = bool(terminated) or bool(truncated)
        assert int(self.state.time) == (0 if begun else int(before.time) + 1)
        moved = float(jnp.sum(self.state.height) - jnp.sum(before.height))
        assert begun or abs(moved) <= 1e-5 * float(jnp.abs(self.state.height).sum() + 1e-3)


def environment():
    """A small environment; its reset, and its step with its reward's derivative by the action, compiled."""
    scene = js.make_scene((N, N), 0.01, tool=js.Blade(0.03, 0.015, 0.006))
    goal = jnp.zeros((1, N, N), jnp.float32).at[0, 4:8, 4:8].set(-0.004)
    env, params = js.make(
        "multi-stroke", goals=LevelGoals(goal), scene=scene, push=js.SwathPush(), settle=js.Sweeps(4), limit=4
    )

    def rewarded(key, state, action, params):
        obs, state, reward, *rest = env.step(key, state, action, params)
        return reward, (obs, state, *rest)

    if not BUILT:
        BUILT.append(jax.jit(env.reset))
        BUILT.append(jax.jit(jax.value_and_grad(rewarded, argnums=2, has_aux=True)))
    return env, params, *BUILT


BUILT: list[Any] = []


def played(machine, examples, steps):
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=examples,
            stateful_step_count=steps,
            derandomize=True,
            deadline=None,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


def on(ground):
    return type("SandOnGround", (Sand,), {"ground": ground})


ALL = Ground(floor=True, walls=True, drains=True)
FEW = Ground(floor=True, walls=True, drains=True, everything=False)
SLOW = {
    "all": (ALL, 50),
    "plain": (Ground(), 25),
    "float32": (Ground(floor=True, walls=True, dtype="float32", bucket_walls=True), 30),
    "isotropic": (Ground(floor=True, options={"neighbours": "isotropic", "window": js.Window((10, 10))}), 20),
    "at an angle": (Ground(drains=True, options={"neighbours": 4}, yaw=0.5), 20),
}


def test_sequences_on_sand_with_a_floor_walls_and_a_draining_edge():
    """With a blade and a bucket; a wheel, batches and pouring under `jit`, which are more programs, are among the slow ones."""
    played(on(FEW), 14, 12)


def test_sequences_of_an_environment():
    played(Digging, 10, 12)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_long_sequences(name):
    ground, examples = SLOW[name]
    played(on(ground), examples, 50)


@pytest.mark.slow
def test_long_sequences_of_an_environment():
    played(Digging, 60, 50)
