"""The same settling in plain numpy and plain C: what jaxsand's speed is measured against, and a check of its answers."""

import ctypes
import math
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np

_FLAGS = (
    "-O3",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-shared",
    "-fPIC",
)
_LINKS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, math.sqrt(2)), (1, -1, math.sqrt(2)))


def settle_numpy(
    height: np.ndarray,
    spacing: float,
    mu: float,
    *,
    rate: float = 0.125,
    tolerance: float = 1e-3,
    interval: int = 8,
    bound: int = 20_000,
) -> tuple[np.ndarray, int]:
    """Settles one map [H, W] with eight neighbours until it is still: the map and the number of sweeps."""
    h = height.copy()
    kind = h.dtype.type
    nmant = np.finfo(h.dtype).nmant
    drop = kind(mu * spacing)
    sweeps = 0
    while sweeps < bound:
        quantum = kind(math.ldexp(1, math.frexp(float(np.abs(h).max()) or 1e-30)[1] - nmant))
        if _worst(h, drop) <= max(tolerance, 2 * float(quantum) / (rate * spacing)) * spacing:
            break
        for _ in range(interval):
            net = np.zeros_like(h)
            for di, dj, length in _LINKS:
                here, there = _ends(h.shape, di, dj)
                d = h[there] - h[here]
                m = drop * kind(length)
                q = np.trunc((d - np.clip(d, -m, m)) * (kind(rate / length) / quantum))
                net[here] += q
                net[there] -= q
            h += net * quantum
            sweeps += 1
    return h, sweeps


def _worst(h: np.ndarray, drop: np.floating) -> float:
    worst = 0.0
    for di, dj, length in _LINKS:
        here, there = _ends(h.shape, di, dj)
        d = np.abs(h[there] - h[here])
        if d.size:
            worst = max(worst, float(d.max() - drop * length) / length)
    return worst


def _ends(shape: tuple[int, ...], di: int, dj: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    rows, columns = shape
    here = (slice(0, rows - di), slice(max(0, -dj), columns - max(0, dj)))
    there = (slice(di, rows), slice(max(0, dj), columns - max(0, -dj)))
    return here, there


def compile_c() -> Callable[..., np.ndarray] | None:
    """`settle_c(maps, spacing, mu, ...)`, which settles float32 maps [n, H, W] in place and returns their sweeps; None
    where no C compiler works."""
    compiler = next((c for c in (os.environ.get("CC"), "cc", "gcc", "clang") if c and shutil.which(c)), None)
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "sweep.so"
        source = resources.files("jaxsand").joinpath("data", "sweep.c")
        with resources.as_file(source) as path:
            done = subprocess.run(
                [compiler, *_FLAGS, str(path), "-o", str(library), "-lm"], capture_output=True, check=False
            )
        if done.returncode:
            return None
        function = ctypes.CDLL(str(library)).settle

    def settle_c(
        maps: np.ndarray,
        spacing: float,
        mu: float,
        *,
        rate: float = 0.125,
        tolerance: float = 1e-3,
        interval: int = 8,
        bound: int = 20_000,
    ) -> np.ndarray:
        if maps.dtype != np.float32 or maps.ndim != 3 or not maps.flags.c_contiguous:
            raise ValueError(f"maps: got {maps.dtype} of shape {list(maps.shape)}; give contiguous float32 [n, H, W]")
        n, h, w = maps.shape
        sweeps = np.zeros(n, np.int32)
        pointer, f = ctypes.c_void_p, ctypes.c_float
        failed = function(
            pointer(maps.ctypes.data), n, h, w, f(spacing), f(mu), f(rate), f(tolerance), interval, bound,
            pointer(sweeps.ctypes.data),
        )  # fmt: skip
        if failed:
            raise MemoryError("no memory for two maps")
        return sweeps

    return settle_c
