"""Piles that are known exactly, and how close the sand comes to them."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.bench.tables import Row
from jaxsand.bench.work_precision import MU, roof
from jaxsand.relaxation.settling import settle
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.boundaries import Draining
from jaxsand.scene.grid import Neighbours
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import make_scene

ANGLE = math.radians(29)


def grow(n: int, deposits: int, neighbours: Neighbours, radius: float, base: np.ndarray | None = None) -> tuple[Any, float]:
    """A pile grown on n x n cells (spacing 1), over one cell and over `base`, from the volume of a cone with a toe of
    `radius` sides: the map and that volume. Computes in float64 where that is enabled."""
    volume = math.pi * MU * (radius * n) ** 3 / 3
    scene = make_scene((n, n), 1.0, ANGLE, neighbours)

    def one(h: jax.Array, _: Any) -> tuple[jax.Array, jax.Array]:
        s = settle(scene, h.at[n // 2, n // 2].add(volume / deposits))
        return s.height, s.outcome

    start = jnp.zeros((n, n)) if base is None else jnp.asarray(base, float)
    h, outcomes = jax.jit(lambda h: jax.lax.scan(one, h, None, length=deposits))(start)
    if np.any(outcomes):
        raise RuntimeError("a pile did not come to rest")
    return np.asarray(h), volume


def cone(n: int, neighbours: Neighbours = "isotropic", deposits: int = 40, radius: float = 0.26) -> tuple[float, np.ndarray]:
    """sum |h - cone| / sum |cone| of a pile grown at a point, and its map: h = max(mu (R - r), 0)."""
    h, volume = grow(n, deposits, neighbours, radius)
    y, x = np.indices((n, n)) - n // 2
    return float(np.abs(h - np.maximum(MU * (radius * n - np.hypot(x, y)), 0)).sum() / volume), h


def slopes(h: np.ndarray, radius: float = 0.26, directions: int = 16) -> np.ndarray:
    """The angles (degrees) of a pile's flank in so many directions, from a quarter to four fifths of its radius."""
    n = h.shape[0]
    r = np.arange(0.25, 0.8, 0.02) * radius * n
    angles = []
    for way in np.arange(directions) * 2 * math.pi / directions:
        y, x = n // 2 + r * math.sin(way), n // 2 + r * math.cos(way)
        i, j = np.floor(y).astype(int), np.floor(x).astype(int)
        v, u = y - i, x - j
        z = (1 - v) * ((1 - u) * h[i, j] + u * h[i, j + 1]) + v * ((1 - u) * h[i + 1, j] + u * h[i + 1, j + 1])
        angles.append(math.degrees(math.atan(-np.polyfit(r, z, 1)[0])))
    return np.array(angles)


def on_a_slope(n: int, deposits: int, steepness: float = 0.5, radius: float = 0.16) -> float:
    """The L1 error of a pile grown on a plane of slope a = `steepness` mu: h = max(plane, plane(source) + c - mu r) with
    V = pi c^3 mu / (3 (mu^2 - a^2)^(3/2)). It takes small deposits: each collapses uphill too."""
    a = steepness * MU
    plane = np.broadcast_to(a * np.arange(n), (n, n))
    h, volume = grow(n, deposits, "isotropic", radius, plane)
    c = (3 * volume * (MU**2 - a**2) ** 1.5 / (math.pi * MU)) ** (1 / 3)
    i = np.arange(n) - n // 2
    exact = np.maximum(plane, plane[0, n // 2] + c - MU * np.hypot(i[:, None], i[None, :]))
    return float(np.abs(h - exact).sum() / volume)


def table(n: int, neighbours: Neighbours = "isotropic") -> float:
    """The L1 error of an overfilled square table of side 1 that drains over its edge: h = mu times the distance to it."""
    scene = make_scene((n, n), 1 / n, ANGLE, neighbours, edge=Draining())
    s = settle(scene, jnp.full((n, n), 0.5), stop=UntilStill(1e-4))
    exact = roof(n) / n
    return float(np.abs(np.asarray(s.height) - exact).sum() / exact.sum())


def piles(tell: Tell = quiet, sizes: int = 4) -> list[Row]:
    """L1 errors against exact piles by the number of cells a side, and the order in which they fall, in float64; for a cone
    also the least and the largest angle of its flank (degrees, repose is 29)."""
    rows: list[Row] = []
    with jax.enable_x64(True):
        ways: tuple[Neighbours, ...] = (4, 8, "isotropic")
        for neighbours in ways:
            for n in (33, 65, 129, 257)[: sizes if neighbours == "isotropic" else min(sizes, 3)]:
                tell(f"cone, {neighbours} neighbours, {n} cells")
                error, h = cone(n, neighbours)
                flank = slopes(h)
                rows.append(
                    {"name": f"cone, {neighbours}", "cells": n, "error": error, "least": flank.min(), "most": flank.max()}
                )
        for n, deposits in ((33, 640), (65, 2560))[:sizes]:
            tell(f"pile on a slope, {n} cells")
            rows.append({"name": "pile on a slope, isotropic", "cells": n, "error": on_a_slope(n, deposits)})
        for n in (24, 48, 96)[:sizes]:
            tell(f"overfilled table, {n} cells")
            rows.append({"name": "overfilled table, isotropic", "cells": n, "error": table(n)})
    for row in rows:
        alike = [r for r in rows if r["name"] == row["name"]]
        if len(alike) > 1:
            cells, errors = (np.log([r[figure] for r in alike]) for figure in ("cells", "error"))
            row["fitted_order"] = -float(np.polyfit(cells, errors, 1)[0])
    return rows
