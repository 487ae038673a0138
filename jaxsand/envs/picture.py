"""A picture of what an environment shows: goal and sand side by side."""

from typing import Any

import numpy as np

from jaxsand.envs import Excavate, MultiStroke, OnMap, OnSand

_LOW, _LEVEL, _HIGH, _TOOL = (np.array(c, float) for c in ((30, 60, 130), (222, 196, 150), (110, 60, 20), (200, 30, 30)))
_PIXELS = 256  # along a panel of a picture, about

Obs = dict[str, Any]
Core = OnMap | OnSand | MultiStroke | Excavate


def picture(core: Core, shown: Obs) -> np.ndarray:
    """Draws goal and sand side by side: blue is a blade's depth down, brown as far up, red where the tool stands.

    Args:
      core: the environment, as `jaxsand.make` gives it.
      shown: its observation, as numpy arrays.

    Returns:
      [height, width, 3] (uint8).

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> env, params = js.make("single-stroke")
      >>> planes = {name: np.zeros((7, 7)) for name in ("goal", "current", "pose")}
      >>> js.gym.picture(env, planes).shape
      (252, 540, 3)
    """
    on_map = isinstance(core, OnMap)
    panels = [_coloured(-shown[name] if on_map else shown[name]) for name in ("goal", "current")]
    if "pose" in shown:
        share = shown["pose"][..., None] * 0.7
        panels[1] = panels[1] * (1 - share) + _TOOL * share
    rows = panels[0].shape[0]
    gap = np.full((rows, 1, 3), 255.0)
    whole = np.concatenate([panels[0], gap, panels[1]], axis=1)
    if not on_map:
        whole = np.flipud(whole)
    scale = max(1, _PIXELS // rows)
    return np.repeat(np.repeat(whole, scale, 0), scale, 1).round().astype(np.uint8)


def _coloured(height: np.ndarray) -> np.ndarray:
    """Heights in units of the blade's depth as colours [H, W, 3]."""
    part = np.clip(height, -1, 1)[..., None]
    return _LEVEL + np.maximum(-part, 0) * (_LOW - _LEVEL) + np.maximum(part, 0) * (_HIGH - _LEVEL)
