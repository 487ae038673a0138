"""Gymnasium environments, registered when this is imported. The same as `jaxsand.envs.gymnasium`, with `picture`."""

from jaxsand.envs.gymnasium import (
    EXCAVATE,
    HEIGHTS,
    MULTI,
    SINGLE,
    ExcavateEnv,
    MultiStrokeEnv,
    SandVectorEnv,
    SingleStrokeEnv,
)
from jaxsand.envs.picture import picture

__all__ = [
    "EXCAVATE",
    "HEIGHTS",
    "MULTI",
    "SINGLE",
    "ExcavateEnv",
    "MultiStrokeEnv",
    "SandVectorEnv",
    "SingleStrokeEnv",
    "picture",
]
