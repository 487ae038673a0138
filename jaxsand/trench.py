"""The closed form of a wheel's trench. The same as `jaxsand.terramechanics.wheel_trench`."""

from jaxsand.terramechanics.wheel_trench import (
    Pass,
    Profile,
    cell_means,
    closed_form,
    relaxed,
    relaxing,
    trimmed,
    unsettled,
)

__all__ = [
    "Pass",
    "Profile",
    "cell_means",
    "closed_form",
    "relaxed",
    "relaxing",
    "trimmed",
    "unsettled",
]
