"""Environments for learners. The same as `jaxsand.envs`."""

from jaxsand.envs import *  # noqa: F403
