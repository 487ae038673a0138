"""jaxsand: robots that shape sand, simulated in JAX.

A height map settles to its angle of repose after each action of a tool. Names are resolved on first use, so that importing
the package does not wait for JAX.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "AsNeeded": "scene.window",
    "Blade": "scene.tools",
    "Blurred": "optimise",
    "Calibration": "fitting",
    "Closed": "scene.boundaries",
    "DRY_SAND": "scene.material",
    "Draining": "scene.boundaries",
    "Grid": "scene.grid",
    "Grousers": "scene.tools",
    "Lattice": "sandplan",
    "Material": "scene.material",
    "Multilevel": "schemes",
    "NoTool": "scene.tools",
    "OneGrid": "finer",
    "Open": "scene.boundaries",
    "Optimised": "optimise",
    "Outcome": "rules",
    "OutcomeError": "sim",
    "Pairwise": "schemes",
    "Plan": "planner",
    "Pose": "scene.tools",
    "Pushed": "legs",
    "Relaxation": "schemes",
    "SandPlan": "sandplan",
    "Scene": "scene.scene",
    "Section": "sections",
    "Settled": "settling",
    "Shaped": "sim",
    "Smooth": "scene.tools",
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
    "Walls": "scene.boundaries",
    "Wheel": "scene.tools",
    "Whole": "scene.window",
    "Window": "scene.window",
    "act": "sim",
    "calibrate": "calibration",
    "calibrate_sections": "sections",
    "check": "sim",
    "follow": "sim",
    "follow_frames": "sim",
    "make": "env",
    "make_scene": "scene.scene",
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
    "volume": "scene.scene",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxsand' has no attribute {name!r}")
    return getattr(import_module(f"jaxsand.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, *globals()]
