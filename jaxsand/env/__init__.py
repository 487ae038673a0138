"""Environments for learners: a goal and the sand are shown, an action moves the tool.

The state of an episode is apart from the parameters, whose leaves may be vmapped; see `episode.Environment`.
"""

from typing import Any

from jaxsand.env.maps import MapPool, Walks, map_pool, pool_of
from jaxsand.env.onmap import MapParams, MapState, OnMap
from jaxsand.env.spaces import Box, Dict, Discrete

__all__ = ["Box", "Dict", "Discrete", "MapParams", "MapPool", "MapState", "OnMap", "Walks", "make", "map_pool", "pool_of"]


def make(name: str, **options: Any) -> tuple[OnMap, MapParams]:
    """An environment and its parameters."""
    if name != "single-stroke":
        raise ValueError(f"name: got {name!r}; give single-stroke")
    return OnMap(options.pop("shape", (7, 7))), MapParams(**options)
