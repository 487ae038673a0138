"""Surfaces of sand to start from: rough ones, and real terrain, which are not at rest before they are `rested`."""

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from jaxsand.goals import metrics
from jaxsand.interaction.outcome import check
from jaxsand.relaxation.settling import settle, settle_batch
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.grid import places
from jaxsand.scene.scene import Scene

__all__ = ["places", "rested", "rough_surface", "terrain", "terrain_surface"]


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


def rested(scene: Scene, surface: np.ndarray) -> np.ndarray:
    """A surface, or a batch of them, [..., H, W] (m), after it has settled, in float32.

    Raises:
      OutcomeError: if the sand does not come to rest.
    """
    run = settle if surface.ndim == 2 else settle_batch
    settled = run(scene, surface.astype(np.float32), stop=UntilStill(bound=200_000))
    check(settled)
    return np.asarray(settled.height)
