"""Where goals lie on a map, and how near sand comes to them. The same as `jaxsand.goals.metrics`."""

from jaxsand.goals.metrics import *  # noqa: F403
