"""Forces of the sand on tools: an optional layer that reads a scene and never changes it.

On a blade: `cutting`. On a wheel: `jaxsand.scene.bearing`. Along a path: `force_trace`. All their names are here.
"""

from jaxsand.scene.bearing import WheelForce, bekker_resistance, bekker_sinkage, wheel_force, wheel_sinkage
from jaxsand.scene.soil import LETE_SAND, WONG_DRY_SAND, Soil
from jaxsand.terramechanics.cutting import BladeForce, Cut, blade_force, cut_ahead, cut_force, failure_angle, wedge_factors
from jaxsand.terramechanics.force_trace import ForceTrace, follow_forces

__all__ = [
    "LETE_SAND",
    "WONG_DRY_SAND",
    "BladeForce",
    "Cut",
    "ForceTrace",
    "Soil",
    "WheelForce",
    "bekker_resistance",
    "bekker_sinkage",
    "blade_force",
    "cut_ahead",
    "cut_force",
    "failure_angle",
    "follow_forces",
    "wedge_factors",
    "wheel_force",
    "wheel_sinkage",
]
