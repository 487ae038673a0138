"""Earth-moving tasks and their measures. The same as `jaxsand.goals.tasks`."""

from jaxsand.goals.tasks import *  # noqa: F403
