"""jaxsand: robots that shape sand, simulated in JAX.

A height map settles to its angle of repose after each action of a tool. Names are resolved on first use, so that importing
the package does not wait for JAX.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "AsNeeded": "window",
    "Blade": "tool",
    "Blurred": "optimise",
    "Calibration": "fitting",
    "Closed": "walls",
    "DRY_SAND": "material",
    "Draining": "walls",
    "Grid": "grid",
    "Grousers": "tool",
    "Lattice": "sandplan",
    "Material": "material",
    "Multilevel": "schemes",
    "NoTool": "tool",
    "OneGrid": "finer",
    "Open": "walls",
    "Optimised": "optimise",
    "Outcome": "rules",
    "OutcomeError": "sim",
    "Pairwise": "schemes",
    "Plan": "planner",
    "Pose": "tool",
    "Pushed": "legs",
    "Relaxation": "schemes",
    "SandPlan": "sandplan",
    "Scene": "scene",
    "Section": "sections",
    "Settled": "settling",
    "Shaped": "sim",
    "Smooth": "tool",
    "SplitPush": "split",
    "SteppedPush": "push",
    "Steps": "sandplan",
    "SuperTimeStepping": "schemes",
    "SwathPush": "swath",
    "Sweeps": "rules",
    "Trial": "calibration",
    "TwoGrids": "finer",
    "UntilStill": "rules",
    "Verdict": "fitting",
    "Walls": "walls",
    "Wheel": "tool",
    "Whole": "window",
    "Window": "window",
    "act": "sim",
    "calibrate": "calibration",
    "calibrate_sections": "sections",
    "check": "sim",
    "follow": "sim",
    "follow_frames": "sim",
    "make": "env",
    "make_scene": "scene",
    "optimise_strokes": "optimise",
    "plan": "planner",
    "plan_sand": "sandplan",
    "rollout": "sim",
    "settle": "settling",
    "settle_batch": "settling",
    "steepest_slope": "settling",
    "step": "sim",
    "step_batch": "pusher",
    "value_and_grad_batch": "pusher",
    "volume": "scene",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxsand' has no attribute {name!r}")
    return getattr(import_module(f"jaxsand.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, *globals()]
