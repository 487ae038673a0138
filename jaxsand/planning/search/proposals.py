"""Strokes with heights that a search may try: drawn from what is wanted and what lies there, or from around others."""

import numpy as np
from scipy.ndimage import map_coordinates

from jaxsand.planning.search.actions import Job, longest_stroke, shares

_AROUND = np.array([3.0, 3.0, 0.5, 3.0, 3.0, 0.5])  # how far these lie: in spacings, heights in the size of what is to do
_PLACES = 17  # on a stroke's way at which the goal is looked at


def propose_heights(job: Job, height: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws random strokes [count, 6] (m) that may bring `height` [H, W] closer to the job's goal.

    A quarter each run from where sand can be had to where it is wanted, from there to anywhere that counts, between places
    that count, and between any. Sand can be had where it lies above the goal, costly or not, and where the goal is free. The
    first are as high as the goal at their ends, or as the sand where the goal is free, and half of them start lower. The
    others follow the straight line that fits the goal best along their way. Two thirds are then moved a little up or down.
    """
    spacing = float(job.scene.grid.spacing)
    todo, free, goal = job.goal.off(height), job.goal.free, np.asarray(job.goal.height)
    anywhere, none = np.full(todo.size, 1 / todo.size), np.zeros(todo.size)
    counts = shares(~free.ravel() * 1.0, anywhere)
    wanted = shares(-todo.ravel(), counts)
    had = shares(
        shares(job.goal.apart(np.asarray(height, float)).ravel(), none) + 0.5 * shares(free.ravel() * 1.0, none), anywhere
    )
    many = count // 4 + 1
    pairs = ((had, wanted), (had, counts), (counts, counts), (anywhere, anywhere))
    cells = np.stack([[rng.choice(todo.size, many, p=share) for share in pair] for pair in pairs], axis=1)
    rows, columns = np.unravel_index(cells.reshape(2, -1), todo.shape)
    ends = np.stack([columns, rows], axis=-1) + rng.normal(0, 2, (2, 4 * many, 2))  # in cells, cell centres whole numbers
    ends = np.clip(ends, 0, np.array(todo.shape[::-1]) - 1)
    size = _size(todo)
    z, z[:, :many] = _along(goal, height, ends), _at(np.where(free, height, goal), ends[:, :many])
    z[0, :many] -= np.where(rng.random(many) < 0.5, rng.exponential(size, many), 0)
    z += rng.normal(0, 0.1 * size, z.shape) * (rng.random(4 * many) < 2 / 3)
    places = (ends + 0.5) * spacing
    drawn = np.concatenate([places[0], z[0, :, None], places[1], z[1, :, None]], axis=1)
    return within(job, rng.permutation(drawn)[:count])


def around(
    job: Job, height: np.ndarray, strokes: np.ndarray, count: int, scale: float, rng: np.random.Generator
) -> np.ndarray:
    """Strokes [count, 6] (m) near some of `strokes` [n, 6] (m): most of their numbers are moved at random.

    They are moved about `scale` times 3 spacings, their heights half of what is to do on the map `height` [H, W].
    """
    units = np.full(6, float(job.scene.grid.spacing))
    units[[2, 5]] = _size(job.goal.off(height))
    size = scale * _AROUND * units * np.exp(rng.normal(0, 0.7, (count, 1)))
    moved = np.where(rng.random((count, 6)) < 0.7, rng.normal(size=(count, 6)) * size, 0)
    return within(job, strokes[rng.integers(0, len(strokes), count)] + moved)


def within(job: Job, strokes: np.ndarray) -> np.ndarray:
    """Strokes [n, 6] (m) with both ends moved onto the map, and of lengths and heights that are allowed."""
    spacing = float(job.scene.grid.spacing)
    low, high = spacing / 2, (np.array(job.scene.grid.shape[::-1]) - 0.5) * spacing
    start, end = np.clip(strokes[:, :2], low, high), np.clip(strokes[:, 3:5], low, high)
    run = end - start
    length = np.hypot(*run.T)[:, None]
    run = np.where(length > 0, run, [1.0, 0.0]) / np.where(length > 0, length, 1)
    length = np.clip(length, job.actions.shortest * spacing, longest_stroke(job.scene, job.actions))
    heights = job.actions.allowed(strokes[:, [2, 5]])
    ends = [np.clip(start + sign * run * length, low, high) for sign in (1, -1)]
    far = [np.hypot(*(end - start).T)[:, None] for end in ends]
    fits = (far[0] >= np.minimum(length, far[1]) * (1 - 1e-9)) | (far[0] >= job.actions.shortest * spacing)
    end = np.where(fits, ends[0], ends[1])  # where the map ends too soon, the other way
    return np.concatenate([start, heights[:, :1], end, heights[:, 1:]], axis=1)


def _along(goal: np.ndarray, height: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Heights [2, n] (m) at the ends [2, n, 2] (cells) of strokes, on the line that fits the goal best on the way between.

    Where a stroke meets fewer than two places that count, they are the sand's.
    """
    share = np.linspace(0, 1, _PLACES)[:, None]
    found = _at(goal, ends[0] + share[..., None] * (ends[1] - ends[0]))
    counts = np.isfinite(found)
    many = np.maximum(counts.sum(0), 1)
    middle, level = (np.where(counts, x, 0).sum(0) / many for x in (share, found))
    apart = np.where(counts, share - middle, 0)
    spread = (apart**2).sum(0)
    slope = (apart * np.where(counts, found - level, 0)).sum(0) / np.where(spread > 0, spread, 1)
    line = level + np.array([[0.0], [1.0]] - middle) * slope
    return np.where(spread > 0, line, _at(height, ends))


def _at(surface: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A surface [H, W] at places [..., 2] (cells: column, row), interpolated; NaN beside cells that are NaN."""
    return map_coordinates(surface, np.moveaxis(places[..., ::-1], -1, 0), order=1, mode="nearest")


def _size(todo: np.ndarray) -> float:
    """The root mean square (m) of what is to do, where there is something."""
    return float(np.sqrt((todo**2).sum() / max(np.count_nonzero(todo), 1)))
