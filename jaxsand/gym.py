"""Gymnasium environments, registered when this is imported. The same as `jaxsand.envs.gymnasium`."""

from jaxsand.envs.gymnasium import (
    EXCAVATE,
    HEIGHTS,
    MULTI,
    SINGLE,
    ExcavateEnv,
    MultiStrokeEnv,
    SandVectorEnv,
    SingleStrokeEnv,
    picture,
)

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
