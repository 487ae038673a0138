"""jaxsand: robots that shape sand, simulated in JAX.

A height map settles to its angle of repose after each action of a tool. Names are resolved on first use, so that importing
the package does not wait for JAX.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "AsNeeded": "scene.window",
    "Blade": "scene.tools",
    "Blurred": "planning.gradient",
    "Calibration": "terramechanics._least_squares",
    "Closed": "scene.boundaries",
    "DRY_SAND": "scene.material",
    "Draining": "scene.boundaries",
    "Grid": "scene.grid",
    "Grousers": "scene.tools",
    "Lattice": "planning.search",
    "Material": "scene.material",
    "Multilevel": "relaxation.schemes",
    "NoTool": "scene.tools",
    "OneGrid": "terramechanics.finer",
    "Open": "scene.boundaries",
    "Optimised": "planning.gradient",
    "Outcome": "relaxation.stopping",
    "OutcomeError": "interaction.simulate",
    "Pairwise": "relaxation.schemes",
    "Plan": "planning.binary",
    "Pose": "scene.tools",
    "Pushed": "interaction._path",
    "Relaxation": "relaxation.schemes",
    "SandPlan": "planning.search",
    "Scene": "scene.scene",
    "Section": "terramechanics.sections",
    "Settled": "relaxation.settling",
    "Shaped": "interaction.simulate",
    "Smooth": "scene.tools",
    "SplitPush": "interaction.wheel_closed_form",
    "SteppedPush": "interaction.blade_stepped",
    "Steps": "planning.search",
    "SuperTimeStepping": "relaxation.schemes",
    "SwathPush": "interaction.blade_closed_form",
    "Sweeps": "relaxation.stopping",
    "Trial": "terramechanics.calibration",
    "TwoGrids": "terramechanics.finer",
    "UntilStill": "relaxation.stopping",
    "Verdict": "terramechanics._least_squares",
    "Walls": "scene.boundaries",
    "Wheel": "scene.tools",
    "Whole": "scene.window",
    "Window": "scene.window",
    "act": "interaction.simulate",
    "calibrate": "terramechanics.calibration",
    "calibrate_sections": "terramechanics.sections",
    "check": "interaction.simulate",
    "follow": "interaction.simulate",
    "follow_frames": "interaction.simulate",
    "make": "envs",
    "make_scene": "scene.scene",
    "optimise_strokes": "planning.gradient",
    "plan": "planning.binary",
    "plan_sand": "planning.search",
    "rollout": "interaction.simulate",
    "settle": "relaxation.settling",
    "settle_batch": "relaxation.settling",
    "steepest_slope": "relaxation.settling",
    "step": "interaction.simulate",
    "step_batch": "interaction.batched",
    "value_and_grad_batch": "interaction.batched",
    "volume": "scene.scene",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxsand' has no attribute {name!r}")
    return getattr(import_module(f"jaxsand.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, *globals()]
