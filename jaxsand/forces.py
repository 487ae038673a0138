"""Forces on blades and wheels. The same as `jaxsand.terramechanics.forces`."""

from jaxsand.terramechanics.forces import *  # noqa: F403
