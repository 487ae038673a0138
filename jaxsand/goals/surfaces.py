"""Surfaces of sand to start from: rough ones, and real terrain. They are not at rest yet; settle them."""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from jaxsand.goals import metrics


def rough_surface(rng: np.random.Generator, shape: tuple[int, ...], relief: float, scale: float) -> np.ndarray:
    """Smoothed white noise around height 0 (m).

    Args:
      rng: where the noise comes from.
      shape: [..., H, W]; every map has noise of its own.
      relief: from a map's lowest to its highest point (m).
      scale: standard deviation of the Gaussian that smooths (cells): features are a few times as large.
    """
    noise = gaussian_filter(rng.normal(size=shape), (*[0] * (len(shape) - 2), scale, scale))
    noise -= noise.mean((-2, -1), keepdims=True)
    noise *= relief / np.ptp(noise, axis=(-2, -1), keepdims=True)
    return noise


def terrain() -> np.ndarray:
    """Real terrain: elevations (m) around the Jacksboro fault, 344 x 403 cells, row 0 in the south.

    The digital elevation model that matplotlib ships as a sample (USGS data).
    """
    from matplotlib.cbook import get_sample_data

    data: Any = get_sample_data("jacksboro_fault_dem.npz")
    with data:
        return np.flipud(np.array(data["elevation"], dtype=float))


def terrain_surface(shape: tuple[int, int], relief: float) -> np.ndarray:
    """The terrain at another shape, around height 0, `relief` (m) from its lowest to its highest point."""
    land = metrics.resample(terrain(), shape)
    return (land - np.median(land)) / (land.max() - land.min()) * relief
