"""What the wheel's trenches cost: their error against run time over the spacing, and the sweeps until one is still."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import timed
from jaxsand.interaction.simulate import act
from jaxsand.interaction.wheel_closed_form import SplitPush
from jaxsand.relaxation.schemes import Multilevel, Relaxation, Scheme, SuperTimeStepping
from jaxsand.relaxation.settling import settle
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import make_scene
from jaxsand.scene.tools import Wheel
from jaxsand.terramechanics.trench_experiment import FIGURES, RULES, TRENCHES, errors, references, simulate_all
from jaxsand.terramechanics.wheel_trench import trimmed

SPACINGS = (4e-3, 2e-3, 1e-3, 5e-4)
_SOME = tuple(trench for trench in TRENCHES if trench[1] == 15)
_SCHEMES: dict[str, Scheme] = {
    "paper's sweep, k = dx^2/8": Relaxation(),
    "relaxation 1/6.83": Relaxation(1 / 6.83),
    "super-time-stepping": SuperTimeStepping(),
    "super-time-stepping, growth 0.8": SuperTimeStepping(0.8),
    "multilevel": Multilevel(),
}


def against_spacing(tell: Tell = quiet, spacings: int = 4) -> list[Row]:
    """For every rule, reference and spacing the mean figures of the five trenches of 15 mm, and the median seconds of one
    (compiled, on one of the cores). `finest` are the same rule's sections on the finest spacing."""
    known = references(_SOME)
    rows = []
    for rule, push in RULES.items():
        ruts = {spacing: simulate_all(_SOME, spacing, push, tell) for spacing in SPACINGS[:spacings]}
        finest = {trench: rut.profile for trench, rut in ruts[SPACINGS[spacings - 1]].items()}
        for name, of in {**known, "finest": finest}.items():
            for spacing, some in ruts.items():
                if of is finest and spacing == SPACINGS[spacings - 1]:
                    continue
                all_of_them = [errors(some[t].profile, trimmed(of[t], 1e-5)) for t in _SOME]
                figures = {key: float(np.mean([row[key] for row in all_of_them])) for key in FIGURES}
                seconds = float(np.median([some[t].seconds for t in _SOME[1:]]))
                rows.append({"rule": rule, "against": name, "spacing_mm": spacing * 1e3, **figures, "seconds": seconds})
    return rows


def settling(tell: Tell = quiet, turns: int = 5, spacing: float = 2e-3) -> list[Row]:
    """The paper's case of 160 x 160 cells (of 2 mm): a trench before the sand flows (22.5 degrees, 15 mm) is left to settle.

    `error` is the largest distance from the limit of small steps over the largest change of height.
    """
    cells = round(0.32 / spacing)
    wheel = Wheel(sinkage=0.015, slip_angle=math.radians(22.5))
    scene = make_scene((cells, cells), spacing, tool=wheel)
    stroke = np.array([0.06, 0.16, 0.26, 0.16])
    start = act(scene, jnp.zeros((cells, cells), jnp.float32), stroke, push=SplitPush()).height
    bed = make_scene((cells, cells), spacing)
    with jax.enable_x64(True):
        slow = settle(
            bed,
            jnp.asarray(np.asarray(start), jnp.float64),
            scheme=SuperTimeStepping(0.05, 1 / 64),
            stop=UntilStill(1e-5, bound=400_000),
        )
    limit = np.asarray(slow.height)
    largest = np.abs(limit - np.asarray(start, float)).max()
    rows = []
    for name, scheme in _SCHEMES.items():
        for tolerance in (0.1, 0.03, 0.01, 1e-3):
            tell(f"settling {cells} x {cells}, {name}, tolerance {tolerance:g}")
            stop = UntilStill(tolerance)
            took = timed(partial(settle, bed, start, scheme=scheme, stop=stop), turns)
            settled = took.result
            error = float(np.abs(np.asarray(settled.height, float) - limit).max() / largest)
            rows.append(
                {"name": name, "tolerance": tolerance, "sweeps": int(settled.sweeps), "seconds": took.best, "error": error}
            )
    return rows
