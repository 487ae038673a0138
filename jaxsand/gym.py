"""Gymnasium environments, registered when this is imported. The same as `jaxsand.envs.gymnasium`."""

from jaxsand.envs.gymnasium import *  # noqa: F403
