"""jaxsand: robots that shape sand, simulated in JAX.

`make_scene` describes the sand and the tool, `settle` lets a height map flow to its angle of repose, `step` pushes the tool
along a straight stroke and lets the sand settle, and `follow` pushes along a path. All are pure functions of arrays, to be
transformed by `jax.jit`, `jax.vmap` and `jax.grad`.

Lengths are metres and angles radians. Cell [i, j] of a height map is centred at x = (j + 1/2) dx, y = (i + 1/2) dx, dx the
spacing. Names are imported on first use, so that `import jaxsand` does not wait for JAX.
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxsand import env as env
    from jaxsand import forces as forces
    from jaxsand import gym as gym
    from jaxsand import task as task
    from jaxsand import tasks as tasks
    from jaxsand import trench as trench
    from jaxsand.envs import make as make
    from jaxsand.goals.drawing import read_drawing as read_drawing
    from jaxsand.goals.feasible import AtBest as AtBest
    from jaxsand.goals.feasible import at_best as at_best
    from jaxsand.goals.files import HeightMap as HeightMap
    from jaxsand.goals.files import hfield_size as hfield_size
    from jaxsand.goals.files import read_map as read_map
    from jaxsand.goals.files import write_map as write_map
    from jaxsand.goals.goal import Goal as Goal
    from jaxsand.interaction._path import Pushed as Pushed
    from jaxsand.interaction.batched import step_batch as step_batch
    from jaxsand.interaction.batched import value_and_grad_batch as value_and_grad_batch
    from jaxsand.interaction.blade_closed_form import SwathPush as SwathPush
    from jaxsand.interaction.bucket import Loaded as Loaded
    from jaxsand.interaction.bucket import dump as dump
    from jaxsand.interaction.bucket import load_volume as load_volume
    from jaxsand.interaction.bucket import scoop as scoop
    from jaxsand.interaction.load import Heaped as Heaped
    from jaxsand.interaction.load import Load as Load
    from jaxsand.interaction.outcome import OutcomeError as OutcomeError
    from jaxsand.interaction.outcome import check as check
    from jaxsand.interaction.pouring import deposit as deposit
    from jaxsand.interaction.pouring import remove as remove
    from jaxsand.interaction.rule import PushRule as PushRule
    from jaxsand.interaction.simulate import Shaped as Shaped
    from jaxsand.interaction.simulate import act as act
    from jaxsand.interaction.simulate import follow as follow
    from jaxsand.interaction.simulate import follow_frames as follow_frames
    from jaxsand.interaction.simulate import rollout as rollout
    from jaxsand.interaction.simulate import step as step
    from jaxsand.interaction.stepped import SteppedPush as SteppedPush
    from jaxsand.interaction.wheel_closed_form import SplitPush as SplitPush
    from jaxsand.planning.binary import Plan as Plan
    from jaxsand.planning.binary import plan as plan
    from jaxsand.planning.gradient import Blurred as Blurred
    from jaxsand.planning.gradient import Optimised as Optimised
    from jaxsand.planning.gradient import optimise_strokes as optimise_strokes
    from jaxsand.planning.pipeline import ShapeResult as ShapeResult
    from jaxsand.planning.pipeline import film as film
    from jaxsand.planning.search import SandPlan as SandPlan
    from jaxsand.planning.search import plan_sand as plan_sand
    from jaxsand.planning.search import plan_sand_batch as plan_sand_batch
    from jaxsand.planning.search.actions import Flat as Flat
    from jaxsand.planning.search.actions import Lattice as Lattice
    from jaxsand.planning.search.actions import Rising as Rising
    from jaxsand.planning.search.actions import Steps as Steps
    from jaxsand.relaxation.schemes import Multilevel as Multilevel
    from jaxsand.relaxation.schemes import Pairwise as Pairwise
    from jaxsand.relaxation.schemes import Relaxation as Relaxation
    from jaxsand.relaxation.schemes import SuperTimeStepping as SuperTimeStepping
    from jaxsand.relaxation.settling import Settled as Settled
    from jaxsand.relaxation.settling import settle as settle
    from jaxsand.relaxation.settling import settle_batch as settle_batch
    from jaxsand.relaxation.settling import steepest_slope as steepest_slope
    from jaxsand.relaxation.stopping import Outcome as Outcome
    from jaxsand.relaxation.stopping import Sweeps as Sweeps
    from jaxsand.relaxation.stopping import UntilStill as UntilStill
    from jaxsand.scene.boundaries import Base as Base
    from jaxsand.scene.boundaries import Closed as Closed
    from jaxsand.scene.boundaries import Deep as Deep
    from jaxsand.scene.boundaries import Draining as Draining
    from jaxsand.scene.boundaries import Open as Open
    from jaxsand.scene.boundaries import Walls as Walls
    from jaxsand.scene.footprint import Pose as Pose
    from jaxsand.scene.grid import Grid as Grid
    from jaxsand.scene.material import DRY_SAND as DRY_SAND
    from jaxsand.scene.material import Material as Material
    from jaxsand.scene.scene import Scene as Scene
    from jaxsand.scene.scene import make_scene as make_scene
    from jaxsand.scene.scene import volume as volume
    from jaxsand.scene.tools import Blade as Blade
    from jaxsand.scene.tools import Bucket as Bucket
    from jaxsand.scene.tools import Grousers as Grousers
    from jaxsand.scene.tools import NoTool as NoTool
    from jaxsand.scene.tools import Smooth as Smooth
    from jaxsand.scene.tools import Tool as Tool
    from jaxsand.scene.tools import Wheel as Wheel
    from jaxsand.scene.window import AsNeeded as AsNeeded
    from jaxsand.scene.window import Whole as Whole
    from jaxsand.scene.window import Window as Window
    from jaxsand.terramechanics._least_squares import Calibration as Calibration
    from jaxsand.terramechanics._least_squares import Verdict as Verdict
    from jaxsand.terramechanics.calibration import Trial as Trial
    from jaxsand.terramechanics.calibration import calibrate as calibrate
    from jaxsand.terramechanics.finer import OneGrid as OneGrid
    from jaxsand.terramechanics.finer import TwoGrids as TwoGrids
    from jaxsand.terramechanics.sections import Section as Section
    from jaxsand.terramechanics.sections import calibrate_sections as calibrate_sections
    from jaxsand.viz.plot import plot as plot
    from jaxsand.viz.viewer import Page as Page
    from jaxsand.viz.viewer import Panel as Panel
    from jaxsand.viz.viewer import view as view

    __version__: str

_HOMES = {
    "AsNeeded": "scene.window",
    "AtBest": "goals.feasible",
    "Base": "scene.boundaries",
    "Blade": "scene.tools",
    "Blurred": "planning.gradient",
    "Bucket": "scene.tools",
    "Calibration": "terramechanics._least_squares",
    "Closed": "scene.boundaries",
    "DRY_SAND": "scene.material",
    "Deep": "scene.boundaries",
    "Draining": "scene.boundaries",
    "Flat": "planning.search.actions",
    "Goal": "goals.goal",
    "Grid": "scene.grid",
    "Grousers": "scene.tools",
    "Heaped": "interaction.load",
    "HeightMap": "goals.files",
    "Lattice": "planning.search.actions",
    "Load": "interaction.load",
    "Loaded": "interaction.bucket",
    "Material": "scene.material",
    "Multilevel": "relaxation.schemes",
    "NoTool": "scene.tools",
    "OneGrid": "terramechanics.finer",
    "Open": "scene.boundaries",
    "Optimised": "planning.gradient",
    "Outcome": "relaxation.stopping",
    "OutcomeError": "interaction.outcome",
    "Page": "viz.viewer",
    "Pairwise": "relaxation.schemes",
    "Panel": "viz.viewer",
    "Plan": "planning.binary",
    "Pose": "scene.footprint",
    "PushRule": "interaction.rule",
    "Pushed": "interaction._path",
    "Relaxation": "relaxation.schemes",
    "Rising": "planning.search.actions",
    "SandPlan": "planning.search",
    "Scene": "scene.scene",
    "Section": "terramechanics.sections",
    "Settled": "relaxation.settling",
    "ShapeResult": "planning.pipeline",
    "Shaped": "interaction.simulate",
    "Smooth": "scene.tools",
    "SplitPush": "interaction.wheel_closed_form",
    "SteppedPush": "interaction.stepped",
    "Steps": "planning.search.actions",
    "SuperTimeStepping": "relaxation.schemes",
    "SwathPush": "interaction.blade_closed_form",
    "Sweeps": "relaxation.stopping",
    "Tool": "scene.tools",
    "Trial": "terramechanics.calibration",
    "TwoGrids": "terramechanics.finer",
    "UntilStill": "relaxation.stopping",
    "Verdict": "terramechanics._least_squares",
    "Walls": "scene.boundaries",
    "Wheel": "scene.tools",
    "Whole": "scene.window",
    "Window": "scene.window",
    "act": "interaction.simulate",
    "at_best": "goals.feasible",
    "calibrate": "terramechanics.calibration",
    "calibrate_sections": "terramechanics.sections",
    "check": "interaction.outcome",
    "deposit": "interaction.pouring",
    "dump": "interaction.bucket",
    "film": "planning.pipeline",
    "follow": "interaction.simulate",
    "follow_frames": "interaction.simulate",
    "hfield_size": "goals.files",
    "load_volume": "interaction.bucket",
    "make": "envs",
    "make_scene": "scene.scene",
    "optimise_strokes": "planning.gradient",
    "plan": "planning.binary",
    "plan_sand": "planning.search",
    "plan_sand_batch": "planning.search",
    "plot": "viz.plot",
    "read_drawing": "goals.drawing",
    "read_map": "goals.files",
    "remove": "interaction.pouring",
    "rollout": "interaction.simulate",
    "scoop": "interaction.bucket",
    "settle": "relaxation.settling",
    "settle_batch": "relaxation.settling",
    "steepest_slope": "relaxation.settling",
    "step": "interaction.simulate",
    "step_batch": "interaction.batched",
    "value_and_grad_batch": "interaction.batched",
    "view": "viz.viewer",
    "volume": "scene.scene",
    "write_map": "goals.files",
}
__all__ = [*_HOMES]
_OTHER_NAMES = ("env", "forces", "gym", "task", "tasks", "trench")  # modules


if not TYPE_CHECKING:  # a type checker that saw this would let every misspelt name pass

    def __getattr__(name: str) -> Any:
        """The public object of this name, imported now."""
        if name == "__version__":
            return metadata.version("jaxsand")
        if name in _OTHER_NAMES:
            return import_module(f"jaxsand.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module 'jaxsand' has no attribute {name!r}")
        return getattr(import_module(f"jaxsand.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, *globals()]
