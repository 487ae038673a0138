"""The closed form of a wheel's trench. The same as `jaxsand.terramechanics.wheel_trench`."""

from jaxsand.terramechanics.wheel_trench import *  # noqa: F403
