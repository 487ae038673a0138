"""Small environments that tests share, and their programs, compiled once."""

from functools import cache

import jax
import numpy as np

import jaxsand as js
from jaxsand import envs
from jaxsand.envs.pushing import Together
from jaxsand.goals import letters

KEY = jax.random.key(0)
LETTERS = envs.map_pool([letters.letter_map(name)[0] for name in "ALTR"])
QUICK = js.SteppedPush(1.0, 1)
SMALL = js.make_scene((16, 16), 0.01, tool=js.Blade())
SCOOPING = js.make_scene((16, 16), 0.01, tool=js.Bucket(width=0.03, length=0.03, capacity=2e-5))
LINES = {"line": [[0.1, 0.2, 0.9, 0.3]], "cross": [[0.0, 0.5, 1.0, 0.5], [0.5, 0.0, 0.5, 1.0]]}


def one_map(dig, start=None):
    return envs.map_pool([dig], [start])


def small(**options):
    return js.make("multi-stroke", **{"goals": LINES, "scene": SMALL, "push": QUICK, "batching": Together()} | options)


def level(**options):
    """Without strokes that make goals, and so without the program that makes them."""
    return small(**{"goals": np.zeros((1, 16, 16), "float32")} | options)


def rising(**options):
    return level(heights=envs.Heights(), **options)


def digging(**options):
    level = envs.LevelGoals(np.zeros((1, 16, 16), "float32"))
    return js.make("excavate", **{"goals": level, "scene": SCOOPING, "push": QUICK, "batching": Together()} | options)


def walks():
    return js.make("single-stroke", goals=LETTERS, limit=40)


def on_sand():
    return js.make("single-stroke", on=envs.OnSand((3, 3), push=QUICK), goals=one_map(np.ones((3, 3), bool)), limit=40)


@cache
def program(env, name="step_env"):
    """A method of an environment, compiled; equal environments share it."""
    return jax.jit(getattr(env, name))
