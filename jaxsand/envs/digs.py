"""Goals that a bucket can meet: a pit here and a heap there, dug by the simulator."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.envs.excavate import Bed, Excavate
from jaxsand.envs.heights import Heights
from jaxsand.envs.library import RandomStrokes, Starts, glyph_square, played, pool_from, surfaces
from jaxsand.envs.multi import LevelGoals, RoughGoals
from jaxsand.envs.zones import Zones
from jaxsand.goals import metrics
from jaxsand.interaction.bucket import bucket_of
from jaxsand.interaction.load import as_load
from jaxsand.scene.scene import Scene

_TRIES = 16


@dataclass(frozen=True)
class RandomDigs:
    """Tells `make` to use goals that random digs leave: each scoops a pit, and heaps all of it up elsewhere.

    Args:
      goals: how many goals.
      fewest, most: how many digs make a goal.
      shortest: the least length of a scoop, as a share of the side of the square in which glyphs lie, up to a half.
      apart: the least distance from a scoop's way to its heap, likewise, up to a half; where no place is so far off, less.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> plans = js.env.RandomDigs(goals=2, fewest=3, most=3).plans(np.random.default_rng(0), js.env.Heights())
      >>> len(plans), plans[0].shape
      (2, (3, 9))
    """

    goals: int = 256
    fewest: int = 1
    most: int = 3
    shortest: float = 0.15
    apart: float = 0.3

    def plans(self, rng: np.random.Generator, heights: Heights) -> list[np.ndarray]:
        """Draws the digs [n, 9] for each goal, x and y in the unit square, z in depths of the bucket; all is poured."""
        whole = all(isinstance(n, int) for n in (self.goals, self.fewest, self.most))
        if not (
            whole
            and self.goals >= 1
            and 1 <= self.fewest <= self.most
            and 0 <= self.shortest <= 0.5
            and 0 <= self.apart <= 0.5
        ):
            raise ValueError(
                f"goals: got {self}; give one goal or more, 1 <= fewest <= most, and shortest and apart from 0 to 0.5"
            )
        strokes = RandomStrokes(self.goals, self.fewest, self.most, self.shortest).plans(rng)
        ways = heights.drawn(rng, strokes)
        return [np.concatenate([way, self._heaps(rng, way), np.ones((len(way), 1))], axis=1) for way in ways]

    def _heaps(self, rng: np.random.Generator, way: np.ndarray) -> np.ndarray:
        """A place [n, 2] for each heap."""
        places = rng.random((_TRIES, len(way), 2))
        start, run = way[:, :2], way[:, 3:5] - way[:, :2]
        share = np.clip(((places - start) * run).sum(2) / np.maximum((run**2).sum(1), 1e-12), 0, 1)
        away = np.hypot(*np.moveaxis(places - start - share[..., None] * run, 2, 0))
        first = np.where((away >= self.apart).any(0), np.argmax(away >= self.apart, 0), np.argmax(away, 0))
        return places[first, np.arange(len(way))]


def dug(env: Excavate, scene: Scene, goals: RandomDigs, starts: Starts, seed: int, zones: Zones) -> LevelGoals | RoughGoals:
    """Makes the pool of goals that random digs leave, dug as the environment digs, around its zones."""
    rng = np.random.default_rng(seed)
    plans = [placed(scene, plan) for plan in goals.plans(rng, env.heights)]
    before = surfaces(scene, starts, goals.goals, rng)
    empty = jax.tree.map(lambda x: jnp.zeros(len(plans), x.dtype), as_load(None, before.dtype))
    after, _ = played(lambda bed, digs: _program(env)(scene, bed, digs, zones), (jnp.asarray(before), empty), plans)
    return pool_from(starts, before, np.asarray(after))


def placed(scene: Scene, plan: np.ndarray) -> np.ndarray:
    """The digs [n, 9] (m) of a plan that is given in the unit square and in depths of the bucket."""
    xy, z = [0, 1, 3, 4, 6, 7], [2, 5]
    digs = plan.copy()
    digs[:, xy] = metrics.place(plan[:, xy], glyph_square(scene))
    digs[:, z] *= float(bucket_of(scene).depth)
    return digs


@cache
def _program(env: Excavate) -> Callable[[Scene, Bed, jax.Array, Zones], Bed]:
    def one(scene: Scene, bed: Bed, dig: jax.Array, zones: Zones) -> Bed:
        return env.digs(scene, bed, dig, zones)[0]

    return jax.jit(jax.vmap(one, in_axes=(None, 0, 0, None)))
