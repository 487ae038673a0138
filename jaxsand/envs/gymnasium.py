"""Gymnasium's interface to the environments: import this module, then use `gymnasium.make` or `gymnasium.make_vec`.

    import gymnasium
    import jaxsand.gym

    env = gymnasium.make("jaxsand/MultiStroke-v0", render_mode="rgb_array")
    envs = gymnasium.make_vec("jaxsand/SingleStroke-v0", num_envs=64)

Options are those of `jaxsand.make`. A vector of environments is one vmapped program. It begins a new episode in the step
that ends the old one (AutoresetMode.SAME_STEP: info["final_obs"] holds the old one's last observation). A single environment
does not begin anew by itself.

Needs the extra `gym`: pip install 'jaxsand[gym]'.
"""

import math
import os
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, ClassVar

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from jaxsand.envs import Box, Heights, MultiStroke, OnMap, OnSand, make
from jaxsand.envs.picture import Core, Obs, picture
from jaxsand.envs.weights import shown_weights
from jaxsand.goals.goal import Goal

SINGLE, MULTI = "jaxsand/SingleStroke-v0", "jaxsand/MultiStroke-v0"
HEIGHTS, EXCAVATE = "jaxsand/MultiStrokeHeights-v0", "jaxsand/Excavate-v0"
_AT_HOME = os.getpid()  # the process that this module was imported in


def _refuse_forks() -> None:
    """Raises RuntimeError in a forked process: JAX's threads are missing there, and its first program would never return."""
    if os.getpid() != _AT_HOME:
        raise RuntimeError(
            "vectorization_mode: got processes that were forked, in which JAX does not run; give make_vec "
            'vector_kwargs={"context": "spawn"}, or vectorization_mode="vector_entry_point", which is one program and faster'
        )


def _begun(state: Any, what: str) -> None:
    """Raises ResetNeeded before the first reset."""
    if state is None:
        raise ResetNeeded(f"cannot {what} before the first reset; call reset()")


def _no_other(options: dict[str, Any] | None, *known: str) -> None:
    """Raises ValueError for an option of `reset` that there is not."""
    if options:
        have = f"give {', '.join(known)}" if known else "it has none"
        raise ValueError(
            f"options: got {', '.join(map(repr, options))}, no option of reset; {have}, or make another environment"
        )


def _chosen(which: np.ndarray, new: Any, old: Any) -> Any:
    """The new array where an environment begins anew, else the old one."""
    return jax.numpy.where(which.reshape(-1, *[1] * (np.ndim(new) - 1)), new, old)


def _known(space: spaces.Space[Any], actions: ArrayLike, shape: tuple[int, ...]) -> None:
    """Raises ValueError for actions of another shape, and for a step that is none of the four."""
    try:
        given = np.asarray(actions)
    except ValueError:
        raise ValueError(f"action: got {actions!r:.60}; give numbers {list(shape)}") from None
    if given.dtype.kind not in "fiu" or given.shape != shape:
        raise ValueError(f"action: got {given.dtype} of shape {list(given.shape)}; give numbers {list(shape)}")
    if isinstance(space, spaces.Discrete) and (given.dtype.kind == "f" or (given < 0).any() or (given >= space.n).any()):
        raise ValueError(f"action: got {actions!r}; give 0 to {space.n - 1}: north, east, south, west")


class _Sand(gymnasium.Env):
    """One environment: `core` and `params` as `jaxsand.make` gives them, and the `state` of the episode."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012
    task: ClassVar[str]
    core: Core

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        _refuse_forks()
        self.render_mode = _renders(render_mode)
        self.core, self.params = make(self.task, **options)
        self.observation_space, self.action_space = _spaces(self.core, self.params)
        self.state: Any = None
        self.shown: Obs = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begins an episode; returns its first observation and the info."""
        super().reset(seed=seed, options=options)
        _no_other(options)
        obs, self.state, about = _alone(self.core)[0](_key(self.np_random), self.params)
        self.shown = _arrays(obs)
        return _view(self.core, self.shown), _arrays(about)

    def step(self, action: ArrayLike) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Takes one action; returns observation, reward, terminated, truncated and info."""
        _begun(self.state, "step")
        _known(self.action_space, action, self.action_space.shape or ())
        # No environment draws anything in a step: any key will do.
        out = _alone(self.core)[1](jax.random.key(0), self.state, np.asarray(action), self.params)
        obs, self.state, reward, terminated, truncated, info = out
        self.shown = _arrays(obs)
        return _view(self.core, self.shown), float(reward), bool(terminated), bool(truncated), _arrays(info)

    def render(self) -> np.ndarray | None:
        """A picture of goal and sand side by side, [height, width, 3] (uint8); None unless render_mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        _begun(self.state, "render")
        return picture(self.core, self.shown)


class SingleStrokeEnv(_Sand):
    """The single stroke as a Gymnasium environment, "jaxsand/SingleStroke-v0".

    Observations are the planes "goal", "current" (what is dug) and "pose" (where the tool stands). Actions 0 to 3 move the
    tool north, east, south and west; info["action_mask"] says which of them lead to a cell of the goal, and info["legal"]
    whether the last one did.

    Args:
      render_mode: "rgb_array" or None.
      **options: those of `jaxsand.make("single-stroke", ...)`.

    Example:
      >>> import jaxsand as js
      >>> env = js.gym.SingleStrokeEnv(limit=20)
      >>> obs, info = env.reset(seed=0)
      >>> obs["goal"].shape, env.action_space
      ((7, 7), Discrete(4))
    """

    task = "single-stroke"


class MultiStrokeEnv(_Sand):
    """Many strokes as a Gymnasium goal environment, "jaxsand/MultiStroke-v0", or "jaxsand/MultiStrokeHeights-v0".

    Observations are maps [H, W] in units of the blade's depth: "observation" and "achieved_goal", both the sand as it lies,
    and "desired_goal". Where goals have weights that are maps, "achieved_goal" and "desired_goal" are three maps [3, H, W],
    heights and the goal's weights above and below: what was achieved, taken for a goal, weighs cells as that goal did. An
    action holds x0, y0, x1, y1 from -1 to 1, from the first to the last cell centre of the map; numbers beyond that push
    from off the map. With `heights=Heights()`, the default of the second name, it holds x0, y0, z0, x1, y1, z1.

    The reward is L_t - L_{t+1}, with L the distance by `measure`, by default sqrt(sum (goal - h)^2), or that of a
    `jaxsand.Goal` by its weights. It depends on the map before the push, which is in info["previous"]. So an algorithm that
    relabels goals must keep the infos (of Stable-Baselines3: replay_buffer_kwargs={"copy_info_dict": True}).

    Args:
      render_mode: "rgb_array" or None.
      **options: those of `jaxsand.make("multi-stroke", ...)`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env = js.gym.MultiStrokeEnv(goals=np.zeros((1, 8, 8)), scene=js.make_scene((8, 8), 0.01, tool=js.Blade()))
      >>> obs, info = env.reset(seed=0)
      >>> obs["desired_goal"].shape, env.action_space.shape
      ((8, 8), (4,))
    """

    task = "multi-stroke"
    core: MultiStroke

    def step(self, action: ArrayLike) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Pushes once; returns observation, reward, terminated, truncated and info."""
        previous = self.shown.get("current")
        obs, _, terminated, truncated, info = super().step(action)
        info["previous"] = previous
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info))
        return obs, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Obs | Sequence[Obs]) -> Any:
        """The reward of a push for any goal, exactly as `step` computes it for the goal that was given.

        Args:
          achieved_goal: the map after the push, [H, W], or [B, H, W] for many; with weights that are maps [3, H, W], or
            [B, 3, H, W] for many. Arrays may be flattened.
          desired_goal: the goal, of the same shape.
          info: the info of the push, or B infos; info["previous"] is the map before the push.

        Returns:
          A number, or [B] for many.

        Raises:
          ValueError: for goals that are no such maps, or an info that does not hold the map before the push.
        """
        single = isinstance(info, dict)
        infos: list[Any] = [info] if single else list(info)
        if not all("previous" in one for one in infos):
            raise ValueError(
                "info: got one without 'previous', the map before the push; keep the infos of `step` "
                "(Stable-Baselines3: replay_buffer_kwargs={'copy_info_dict': True})"
            )
        sand = self.params.scene.grid.shape
        goals = (3, *sand) if shown_weights(self.params.goals.goals) else sand
        before, wanted, after = (
            _reshaped(name, maps, len(infos), shape)
            for name, maps, shape in (
                ("info", np.array([one["previous"] for one in infos]), sand),
                ("desired_goal", desired_goal, goals),
                ("achieved_goal", achieved_goal, goals),
            )
        )
        goal = self._goal(wanted)
        far = [self.core.measure.distance(goal, maps) for maps in (before, after.reshape(len(after), -1, *sand)[:, 0])]
        reward = np.asarray(far[0] - far[1])
        return reward[0] if single else reward

    def _goal(self, maps: np.ndarray) -> Goal | np.ndarray:
        """Goals [B, H, W] of the maps of desired goals, with their own weights, or those that are numbers."""
        given = self.params.goals.goals
        if not isinstance(given, Goal):
            return maps
        if maps.ndim == 4:
            return Goal(maps[:, 0], maps[:, 1], maps[:, 2], given.power)
        return Goal(maps, np.asarray(given.above), np.asarray(given.below), given.power)


class ExcavateEnv(_Sand):
    """Excavation as a Gymnasium environment, "jaxsand/Excavate-v0".

    Observations are the maps "goal" and "current" [H, W] in units of the bucket's depth, "load", what the bucket holds as a
    share of its capacity, and weights "above" and "below" of goals where they are maps. An action holds x0, y0, z0, x1, y1,
    z1 of a scoop, x, y of a dump, and the share that is poured, from -1 to 1; see `jaxsand.env.Excavate`.

    Args:
      render_mode: "rgb_array" or None.
      **options: those of `jaxsand.make("excavate", ...)`.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env = js.gym.ExcavateEnv(goals=np.zeros((1, 32, 32)))
      >>> obs, info = env.reset(seed=0)
      >>> obs["current"].shape, float(obs["load"]), env.action_space.shape
      ((32, 32), 0.0, (9,))
    """

    task = "excavate"


class SandVectorEnv(VectorEnv):
    """Many environments as one vmapped program, for `gymnasium.make_vec`.

    Observations and actions are those of `SingleStrokeEnv`, `MultiStrokeEnv` or `ExcavateEnv`, with a first axis of length
    num_envs.

    Args:
      task: "single-stroke", "multi-stroke" or "excavate".
      num_envs: how many.
      render_mode: "rgb_array" or None.
      **options: those of `jaxsand.make`.

    Example:
      >>> import jaxsand as js
      >>> envs = js.gym.SandVectorEnv("single-stroke", num_envs=3)
      >>> obs, info = envs.reset(seed=0)
      >>> obs["goal"].shape
      (3, 7, 7)
    """

    metadata: dict[str, Any] = _Sand.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, task: str, num_envs: int, render_mode: str | None = None, **options: Any) -> None:
        self.num_envs, self.render_mode = num_envs, _renders(render_mode)
        self.core, self.params = make(task, **options)
        self.single_observation_space, self.single_action_space = _spaces(self.core, self.params)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: Any = None
        self.shown: Obs = {}

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begins an episode in each; with a seed, the i-th begins as a single environment with `seed` + i does. A list holds
        a seed for each.

        Where options["reset_mask"] (booleans [num_envs]) is false an environment goes on as it was.
        """
        seeds = self._seeds(seed)
        which = self._which(options)
        first = next((one for one in seeds if one is not None), None)
        if which.all():
            super().reset(seed=first)
        own = [self.np_random if one is None else np_random(one)[0] for one in seeds]
        begun = _together(self.core)[0](jax.numpy.stack([_key(one) for one in own]), self.params)
        if not which.all():
            obs, state, about = begun
            kept = jax.tree.map(partial(_chosen, which), (obs, state), (self.shown, self.state))
            begun = (*kept, {name: _chosen(which, x, np.zeros_like(x)) for name, x in about.items()})
        obs, self.state, about = begun
        self.shown = _arrays(obs)
        return _view(self.core, self.shown), _masked(_arrays(about), which)

    def _seeds(self, seed: Any) -> list[int | None]:
        if seed is None or isinstance(seed, int | np.integer):
            return [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: got {len(seeds)} for {self.num_envs} environments; give one for each, or one number")
        return [None if one is None else int(one) for one in seeds]

    def _which(self, options: dict[str, Any] | None) -> np.ndarray:
        """Which environments a reset begins anew."""
        rest = dict(options or {})
        which = np.asarray(rest.pop("reset_mask", np.ones(self.num_envs, bool)))
        _no_other(rest, "reset_mask")
        if which.dtype != bool or which.shape != (self.num_envs,) or not which.any():
            raise ValueError(
                f"reset_mask: got {which.dtype} of shape {list(which.shape)}, {int(np.sum(which))} of them true; "
                f"give {self.num_envs} booleans, one or more of them true"
            )
        if not which.all():
            _begun(self.state, "reset a part of the environments")
        return which

    def step(self, actions: ArrayLike) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one action in each, and begins a new episode where one ended."""
        _begun(self.state, "step")
        _known(self.single_action_space, actions, self.action_space.shape or ())
        keys = jax.random.split(_key(self.np_random), self.num_envs)
        out = _together(self.core)[1](keys, self.state, np.asarray(actions), self.params)
        obs, self.state, *rest, info = out
        reward, terminated, truncated = (np.asarray(x) for x in rest)
        info, over = _arrays(info), terminated | truncated
        last = _view(self.core, _arrays(info.pop("final_observation")))
        del info["terminated"], info["truncated"]
        infos = {}
        if "action_mask" in info:  # of the state as it is now
            infos = _masked({"action_mask": info.pop("action_mask")}, np.ones(self.num_envs, bool))
        if isinstance(self.core, MultiStroke):
            info["previous"] = self.shown["current"]
        infos |= _masked(info, ~over)
        if over.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(over):
                final[i] = {name: plane[i] for name, plane in last.items()}
            infos |= {"final_obs": final, "_final_obs": over, "final_info": _masked(info, over), "_final_info": over}
        self.shown = _arrays(obs)
        return _view(self.core, self.shown), reward.astype(float), terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each environment; None unless render_mode is "rgb_array"."""
        if self.render_mode is None:
            return None
        _begun(self.state, "render")
        return tuple(picture(self.core, {name: x[i] for name, x in self.shown.items()}) for i in range(self.num_envs))


def _reshaped(name: str, maps: Any, count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Many maps, or stacks of maps, of a shape, in double precision; raises ValueError if they are not as many."""
    given = np.asarray(maps, float)
    if given.size != count * math.prod(shape):
        one = ", ".join(map(str, shape))
        raise ValueError(
            f"{name}: got shape {list(given.shape)} for {count} infos; give [{one}] with one info, or [B, {one}] with a "
            "list of B infos (each may be flattened)"
        )
    return given.reshape(count, *shape)


def _renders(mode: str | None) -> str | None:
    """The render mode; raises ValueError if it does not exist."""
    if mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode: got {mode!r}; give rgb_array or None")
    return mode


def _spaces(core: Core, params: Any) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
    """Gymnasium's spaces of an environment's observations and actions."""
    shown, action = core.observation_space(params).spaces, core.action_space(params)
    observation = spaces.Dict(_view(core, {name: _box(box) for name, box in shown.items()}))
    return observation, _box(action) if isinstance(action, Box) else spaces.Discrete(action.n)


def _box(box: Box) -> spaces.Box:
    return spaces.Box(float(box.low), float(box.high), box.shape, np.float32)


def _view(core: Core, shown: Obs) -> Obs:
    """The observation under Gymnasium's names, or its boxes: a goal dictionary for many strokes."""
    if not isinstance(core, MultiStroke):
        return dict(shown)
    weights = [shown[side] for side in ("above", "below") if side in shown]
    achieved, desired = (_stacked([shown[name], *weights]) if weights else shown[name] for name in ("current", "goal"))
    return {"observation": shown["current"], "achieved_goal": achieved, "desired_goal": desired}


def _stacked(maps: list[Any]) -> Any:
    """Maps [..., H, W] as one array [..., n, H, W], or the box of such of their boxes."""
    if isinstance(maps[0], spaces.Box):
        low, high = (np.stack([getattr(box, side) for box in maps]) for side in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)
    return np.stack(maps, axis=-3)


def _arrays(tree: Obs) -> Obs:
    return {name: x if isinstance(x, dict) else np.asarray(x) for name, x in tree.items()}


def _masked(info: Obs, which: np.ndarray) -> dict[str, Any]:
    """Infos of all environments, with Gymnasium's mask of those for which they hold."""
    return info | {f"_{name}": which for name in info}


def _key(random: np.random.Generator) -> jax.Array:
    return jax.random.key(int(random.integers(2**31)))


@cache
def _programs(core: Core, step: Callable[..., Any]) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`reset` and a step of one environment, with the mask of actions in the info where it has one."""

    def about(state: Any, params: Any) -> Obs:
        return {"action_mask": core.legal(state, params).astype(np.int8)} if isinstance(core, OnMap | OnSand) else {}

    def begin(key: jax.Array, params: Any) -> tuple[Any, Any, Obs]:
        obs, state = core.reset(key, params)
        return obs, state, about(state, params)

    def go_on(key: jax.Array, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        *out, info = step(core, key, state, action, params)
        return *out, info | about(out[1], params)

    return begin, go_on


@cache
def _alone(core: Core) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The compiled `reset` and step of one environment, which does not begin a new episode."""
    begin, go_on = _programs(core, type(core).step_env)
    return jax.jit(begin), jax.jit(go_on)


@cache
def _together(core: Core) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The compiled `reset` and step of many environments, which begin new episodes."""
    begin, go_on = _programs(core, type(core).step)
    return jax.jit(jax.vmap(begin, (0, None))), jax.jit(jax.vmap(go_on, (0, 0, 0, None)))


_ENTRIES: tuple[tuple[str, type[_Sand], dict[str, Any]], ...] = (
    (SINGLE, SingleStrokeEnv, {}),
    (MULTI, MultiStrokeEnv, {}),
    (HEIGHTS, MultiStrokeEnv, {"heights": Heights()}),
    (EXCAVATE, ExcavateEnv, {}),
)
for _name, _single, _given in _ENTRIES:
    gymnasium.register(_name, entry_point=_single, vector_entry_point=partial(SandVectorEnv, _single.task), kwargs=_given)
