"""How close the push comes to its quasi-static limit, and how fast.

The limit is that of sub-steps going to 0 with the sand fully at rest after each, in float64. It is taken in two ways that
have nothing in common but the blade: by the proximal steps of resting.py, many of them to each short sub-step, and by the
paper's sweeps, each sub-step swept until no slope exceeds repose. What the two, and two lengths of the sub-step, differ by
is the limit's own uncertainty. A blade as wide as its bed has an exact limit: what it cut stands ahead as a triangle at
repose.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsand.bench.tables import Row
from jaxsand.bench.timing import race
from jaxsand.goals.surfaces import rough_surface
from jaxsand.goals.usual import usual_scene
from jaxsand.interaction.batched import act_batch, step_batch, value_and_grad_batch
from jaxsand.interaction.blade_closed_form import SwathPush
from jaxsand.interaction.blade_stepped import push_along, with_near
from jaxsand.interaction.resting import Sand, no_flux
from jaxsand.interaction.simulate import follow, follow_frames, step
from jaxsand.interaction.stencil import net, steps
from jaxsand.interaction.stepped import SteppedPush
from jaxsand.relaxation.flux import Fluxes
from jaxsand.relaxation.ghost_cells import truncate
from jaxsand.relaxation.settling import settle, settle_batch
from jaxsand.scene.grid import Neighbours, links
from jaxsand.scene.progress import Tell, quiet
from jaxsand.scene.scene import Scene, cast, fit, make_scene
from jaxsand.scene.tools import Blade
from jaxsand.scene.window import Window

_ANGLE = math.radians(29)
_STILL = 1e-4  # a slope (a tangent) at which the limit's sand counts as at rest
_WAYS = tuple(
    SteppedPush(1 / a, n)
    for a, n in (
        (2, 4),
        (4, 2),
        (4, 4),
        (8, 1),
        (8, 2),
        (8, 4),
        (8, 8),
        (16, 1),
        (16, 2),
        (16, 4),
        (16, 8),
        (32, 2),
        (32, 4),
        (32, 16),
    )
)
_REFINED = tuple(SteppedPush(1 / a, a) for a in (4, 8, 16, 32))


def random_strokes(batch: int, side: float = 0.32) -> jax.Array:
    """Strokes between points of the middle four fifths of the map (m)."""
    return jax.random.uniform(jax.random.key(0), (batch, 4), jnp.float32, minval=0.1 * side, maxval=0.9 * side)


def surfaces(scene: Scene, batch: int) -> dict[str, np.ndarray]:
    """Maps [B, H, W] (m) at rest to push into: level sand, sand with a trench in it, and rough sand of 10 mm relief."""
    rows, columns = scene.grid.shape
    level = np.zeros((batch, rows, columns))
    dx = float(scene.grid.spacing)
    across = [0.25 * columns * dx, 0.5 * rows * dx, 0.75 * columns * dx, 0.5 * rows * dx]
    trenched = np.asarray(step(scene, level[0], np.array(across)).height)
    rough = rough_surface(np.random.default_rng(0), (batch, rows, columns), 0.01, 3)
    return {
        "level": level,
        "trenched": np.repeat(trenched[None], batch, 0),
        "rough": np.asarray(settle_batch(scene, rough).height),
    }


def push_precision(batch: int = 16, tell: Tell = quiet) -> list[Row]:
    """Random pushes of the default blade on 32 x 32 cells, by sub-step and sweeps, on `surfaces`.

    `error` is the mean distance from the limit over the mean change that the limit makes, after settling; `worst` the same
    of the worst map; `dug_error` and `berm_error` compare the volume below and the height above the start. The rows named
    "limit" say how uncertain that is. `fitted_order` is that of the sub-step s where 1 / s sweeps follow each.
    """
    rows: list[Row] = []
    with jax.enable_x64(True):
        scene = usual_scene()
        strokes = np.tile(np.asarray(random_strokes(batch), float), (3, 1))
        starts = np.concatenate(list(surfaces(scene, batch).values()))
        tell("limit: proximal steps, sub-steps 1/256 and 1/128")
        best, longer = (_batch(scene, starts, strokes, push=SteppedPush(a, 64)) for a in (1 / 256, 1 / 128))
        rows.append({"name": "limit: sub-step 1/128 from 1/256, 64 sweeps", **_apart(longer, best, starts)})
        tell("limit: the paper's sweeps until still, a stroke on each surface")
        some = [0, batch, 2 * batch]
        swept = _relaxed(scene, starts[some], strokes[some], substep=1 / 32)
        steps = _batch(scene, starts[some], strokes[some], push=SteppedPush(1 / 32, 64))
        name = "limit: the paper's sweeps until still from 64 sweeps, sub-step 1/32, a stroke on each surface"
        rows.append({"name": name, **_apart(swept, steps, starts[some])})
    starts32, strokes32 = starts.astype(np.float32), strokes.astype(np.float32)
    errors = []
    ways: list[SteppedPush | SwathPush] = [*_WAYS, *(p for p in _REFINED if p not in _WAYS), SwathPush()]
    for push in ways:
        name = f"sub-step {push.substep:g}, {push.sweeps} sweeps" if isinstance(push, SteppedPush) else "swath"
        tell(f"push: {name}")
        found = _apart(_batch(scene, starts32, strokes32, push=push), best, starts)
        if push in _REFINED:
            errors.append((push.substep, found["error"]))
        rows.append({"name": name, **found})
    sizes, distances = np.log(np.array(errors)).T
    order = float(np.polyfit(sizes, distances, 1)[0])
    return [row | {"fitted_order": order} for row in rows]


def push_speed(batch: int, tell: Tell = quiet) -> list[Row]:
    """Random pushes of the default blade on level sand of 32 x 32 cells: pushes a second, the ways taking turns."""
    scene = usual_scene()
    level, strokes = jnp.zeros((batch, 32, 32), jnp.float32), random_strokes(batch)
    vmapped = jax.jit(jax.vmap(partial(step, scene)))
    few = strokes[:16]
    ways: dict[str, tuple[int, Callable[[], Any]]] = {
        f"step_batch, sub-step {p.substep:g}, {p.sweeps} sweeps": (batch, partial(step_batch, scene, level, strokes, push=p))
        for p in (
            SteppedPush(),
            *(SteppedPush(1 / a, n) for a, n in ((4, 4), (8, 2), (16, 1), (16, 2), (16, 4))),
            SteppedPush.fine(),
        )
    }
    ways["step_batch, swath"] = (batch, partial(step_batch, scene, level, strokes, push=SwathPush()))
    part = max(1, batch // 4)
    ways["value_and_grad_batch"] = (part, partial(value_and_grad_batch, scene, _square, level[:part], strokes[:part]))
    ways["vmap(step)"] = (batch, lambda: vmapped(level, strokes))
    pulled = jax.jit(jax.vmap(jax.grad(lambda h, s: _square(step(scene, h, s).height), argnums=(0, 1))))
    ways["vmap(grad(step))"] = (part, lambda: pulled(level[:part], strokes[:part]))
    ways["step, one map at a time"] = (len(few), lambda: [step(scene, level[0], s) for s in few])
    return [
        {
            "name": name,
            "pushes_per_second": ways[name][0] / timed.best,
            "seconds": timed.best,
            "compile_seconds": timed.compile_seconds,
        }
        for name, timed in race({name: run for name, (_, run) in ways.items()}, tell=tell).items()
    ]


def _square(height: jax.Array) -> jax.Array:
    return jnp.sum(height**2)


def push_against_spacing(tell: Tell = quiet, batch: int = 8) -> list[Row]:
    """The same pushes of a blade of 60 x 30 mm, 20 mm deep, on finer grids, averaged over the cells of the coarsest, against
    the finest; with the fitted order."""
    maps = {}
    for n in (16, 32, 64, 128):
        tell(f"push on {n} cells")
        scene = make_scene((n, n), 0.32 / n, _ANGLE, tool=Blade(width=0.06, thickness=0.03, depth=0.02))
        level = np.zeros((batch, n, n), np.float32)
        h = _batch(scene, level, np.asarray(random_strokes(batch)), push=SteppedPush())
        maps[n] = h.reshape(batch, 16, n // 16, 16, n // 16).mean((2, 4))
    sides = (16, 32, 64)
    errors = [_share(maps[n], maps[128]) for n in sides]
    order = -float(np.polyfit(np.log(sides), np.log(errors), 1)[0])
    return [{"cells": n, "error": e, "fitted_order": order} for n, e in zip(sides, errors, strict=True)]


def push_by_heading(tell: Tell = quiet) -> list[Row]:
    """One stroke of 12 cm from 0 to 45 degrees on isotropic level sand, each the mean of eight sub-cell places: the heap's
    height before the blade is lifted and the volume dug in the end, as shares of their means over the headings."""
    rows = []
    for n, blade in ((32, Blade()), (64, Blade(width=0.06, thickness=0.03, depth=0.02))):
        dx = 0.32 / n
        tell(f"headings of a blade {blade.width / dx:.0f} cells wide")
        scene, level = make_scene((n, n), dx, _ANGLE, neighbours="isotropic", tool=blade), jnp.zeros((n, n), jnp.float32)
        degrees, places = np.linspace(0, 45, 5), np.random.default_rng(0).uniform(-dx / 2, dx / 2, (8, 2))
        ways = 0.06 * np.stack([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))], 1)
        middle = 0.16 + np.broadcast_to(places, (5, 8, 2))
        paths = np.stack([middle - ways[:, None], middle + ways[:, None]], 2).reshape(40, 2, 2).astype(np.float32)
        after, frames = jax.jit(jax.vmap(lambda path, s=scene, h=level: follow_frames(s, h, path)))(paths)
        heap = np.asarray(frames[:, 0]).max((1, 2)).reshape(5, 8).mean(1)
        dug = np.minimum(np.asarray(after.height), 0).sum((1, 2)).reshape(5, 8).mean(1)
        rows += [
            {"cells": float(blade.width / dx), "heading_deg": float(d), "heap": float(a), "dug": float(b)}
            for d, a, b in zip(degrees, heap / heap.mean(), dug / dug.mean(), strict=True)
        ]
    return rows


def push_continuity(many: int = 1024, tell: Tell = quiet) -> list[Row]:
    """How far what a stroke leaves moves with the stroke: the largest change of a height over that of the stroke, as
    quantiles over random strokes in float64."""
    with jax.enable_x64(True):
        scene = usual_scene()
        strokes = np.asarray(random_strokes(many), float)
        moves = np.random.default_rng(0).normal(size=strokes.shape)
        moves /= np.abs(moves).max(1, keepdims=True)
        level, rows = np.zeros((many, 32, 32)), []

        def after(strokes: np.ndarray) -> np.ndarray:
            return np.asarray(act_batch(scene, level, strokes).height)

        tell("continuity: strokes")
        before = after(strokes)
        for cells in (1e-2, 1e-3, 1e-4):
            tell(f"continuity: strokes moved by {cells:g} cells")
            by = cells * 0.01
            change = np.abs(after(strokes + by * moves) - before).max((1, 2)) / by
            quantiles = {f"p{100 * q:g}": float(np.quantile(change, q)) for q in (0.5, 0.9, 0.99)}
            rows.append({"moved_cells": cells, **quantiles, "largest": float(change.max())})
    return rows


def long_path(sides: tuple[int, ...] = (64, 4096), legs: int = 100, tell: Tell = quiet) -> list[Row]:
    """A path of many short legs in the middle of maps of any size, beside one copy of the map."""
    rows = []
    for n in sides:
        tell(f"a path of {legs} legs on {n} x {n} cells")
        scene, level = make_scene((n, n), 0.01, _ANGLE, tool=Blade()), np.zeros((n, n), np.float32)
        steps = np.random.default_rng(0).uniform(-0.02, 0.02, (legs + 1, 2))
        path = (n * 0.005 + np.clip(np.cumsum(steps, 0), -0.2, 0.2)).astype(np.float32)
        ways: dict[str, Callable[[], Any]] = {
            "seconds": partial(follow, scene, level, path),
            "copy_seconds": partial(np.add, level, 1),
        }
        rows.append({"cells": n, "legs": legs} | {name: timed.best for name, timed in race(ways).items()})
    return rows


def in_parts(tell: Tell = quiet) -> list[Row]:
    """How far a path in many legs is from the same path in one, over what that changes: a line of 16 cm askew to the cells
    by the default blade, and half a turn of a blade of 10 cells all but in place."""
    rows = []
    turns = {legs: half_turn(legs) for legs in (1, 4, 16)}
    start, stop = np.array([0.086, 0.129]), np.array([0.234, 0.191])
    lines = {legs: np.linspace(start, stop, legs + 1) for legs in (1, 4, 16, 64)}
    kinds: list[tuple[str, Blade, dict[int, np.ndarray]]] = [
        ("line", Blade(), lines),
        ("half turn", Blade(width=0.1, thickness=0.015, depth=0.0075), turns),
    ]
    every: tuple[Neighbours, ...] = (4, 8, "isotropic")
    for name, blade, paths in kinds:
        for neighbours in every:
            tell(f"{name} in parts, neighbours {neighbours}")
            scene, level = make_scene((32, 32), 0.01, _ANGLE, neighbours, tool=blade), np.zeros((32, 32), np.float32)
            one, *others = (np.asarray(follow(scene, level, path).height) for path in paths.values())
            rows += [
                {
                    "path": name,
                    "neighbours": neighbours,
                    "legs": n,
                    "apart": _share(h, one),
                }
                for n, h in zip(list(paths)[1:], others, strict=True)
            ]
    return rows


def half_turn(parts: int) -> np.ndarray:
    """A path [n, 2] (m) that turns by half a turn in so many parts, all but in place, at (0.16, 0.16)."""
    headings = math.pi * np.arange(parts + 1) / parts
    return 0.16 + 1e-5 * np.concatenate([np.zeros((1, 2)), np.cumsum(np.stack([np.cos(headings), np.sin(headings)], 1), 0)])


def heaps(
    spacings_mm: tuple[float, ...] = (10, 5, 2.5, 1.25),
    push: SteppedPush | None = None,
    tell: Tell = quiet,
    neighbours: Neighbours = 8,
) -> list[Row]:
    """The heap ahead of a blade as wide as its bed, against the triangle: 20 mm thick, 12 mm deep, 16 cm far, 31 degrees.

    `error` is the distance from the triangle's cell means, in the cells wholly ahead of the face, over its volume; `peak`
    and `volume` are shares of the triangle's.
    """
    rows = []
    for dx in spacings_mm:
        tell(f"heap on cells of {dx:g} mm, neighbours {neighbours}")
        rows.append(heap(dx / 1000, SteppedPush() if push is None else push, neighbours=neighbours))
    return rows


def heap(
    dx: float,
    push: SteppedPush,
    *,
    depth: float = 0.012,
    way: float = 0.16,
    angle: float = math.radians(31),
    thickness: float = 0.02,
    neighbours: Neighbours = 8,
) -> Row:
    """One heap (lengths in m): V = depth (way + thickness / 2) to a unit of width, peak sqrt(2 mu V), toe sqrt(2 V / mu)."""
    mu = math.tan(angle)
    volume = depth * (way + thickness / 2)
    peak, toe = math.sqrt(2 * mu * volume), math.sqrt(2 * volume / mu)
    margin = 2 * thickness + math.sqrt(depth * thickness / mu)
    columns = math.ceil((2 * margin + way + 1.3 * toe) / dx)
    scene = make_scene((3, columns), dx, angle, neighbours, tool=Blade(columns * dx, thickness, depth))
    path = np.array([[margin, 1.5 * dx], [margin + way, 1.5 * dx]])
    _, frames = follow_frames(scene, np.zeros((3, columns), np.float32), path, push=push)
    h = np.asarray(frames[-1][1], float)
    edges = np.arange(columns + 1) * dx - (margin + way + thickness / 2)
    inside = np.clip(edges, 0, toe)
    exact = np.diff(inside * peak - mu * inside**2 / 2) / dx
    ahead = edges[:-1] >= -1e-6 * dx
    return {
        "neighbours": neighbours,
        "spacing_mm": 1000 * dx,
        "toe_cells": toe / dx,
        "error": float(np.abs(h - exact)[ahead].sum() * dx / volume),
        "peak": float(h.max() / peak),
        "volume": float(h[ahead].sum() * dx / volume),
    }


def _batch(scene: Scene, starts: np.ndarray, strokes: np.ndarray, *, push: SteppedPush | SwathPush) -> np.ndarray:
    return np.asarray(step_batch(scene, starts, strokes, push=push).height, float)


def _share(x: np.ndarray, y: np.ndarray) -> float:
    """How far x is from y, over the size of y."""
    return float(np.abs(x - y).sum() / np.abs(y).sum())


def _apart(h: np.ndarray, best: np.ndarray, start: np.ndarray) -> dict[str, float]:
    each = np.abs(h - best).sum((1, 2)) / np.abs(best - start).sum((1, 2))
    dug = [np.minimum(x - start, 0).sum((1, 2)) for x in (h, best)]
    berm = [(x - start).max((1, 2)) for x in (h, best)]
    return {
        "error": float(np.abs(h - best).sum() / np.abs(best - start).sum()),
        "worst": float(each.max()),
        "dug_error": _share(*dug),
        "berm_error": _share(*berm),
    }


def _relaxed(scene: Scene, starts: np.ndarray, strokes: np.ndarray, *, substep: float) -> np.ndarray:
    """Pushes whose every sub-step is swept by the paper's scheme until still."""
    maps = jnp.asarray(starts)
    scene = with_near(replace(scene, window=Window((20, 20))))  # outside of which no sand of these pushes moves
    scene, _ = fit(scene, maps[0])
    push = cast(SteppedPush(substep, 8, 0.125), maps.dtype)

    @jax.jit
    def run(maps: jax.Array, paths: jax.Array) -> jax.Array:
        return jax.vmap(lambda h, path: push_along(scene, h, path, push, rest=_swept)[0].height)(maps, paths)

    order = np.argsort(np.hypot(*(strokes[:, 2:] - strokes[:, :2]).T))
    out = np.empty_like(starts)
    for group in np.array_split(order, max(1, len(order) // 16)):
        after = run(maps[group], jnp.asarray(strokes[group]).reshape(-1, 2, 2))
        out[group] = np.asarray(jax.vmap(partial(settle, scene))(after).height)
    return out


def _swept(sand: Sand, rate: jax.Array, sweeps: int, h: jax.Array, guess: Fluxes) -> tuple[jax.Array, Fluxes]:
    """In place of `bring_to_rest`: the paper's sweeps, behind the same gates, until no slope exceeds repose."""
    gates = list(zip(sand.gates, links(sand.neighbours), strict=True))

    def excess(h: jax.Array) -> Iterator[jax.Array]:
        for (gate, (_, _, length)), d in zip(gates, steps(sand.neighbours, sand.surface(h)), strict=True):
            most = sand.drop * length
            yield (d - jnp.clip(d, -most, most)) * (gate / length)

    def moving(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        h, k = carry
        worst = jnp.max(jnp.stack([jnp.max(jnp.abs(e) * (rate > 0)) for e in excess(h / jnp.max(sand.drop))]))
        return (worst > _STILL) & (k < 4000)

    def some(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        h, k = carry
        for _ in range(sweeps):
            h = h + net(sand.neighbours, tuple(truncate(e * rate) for e in excess(h)))
        return h, k + sweeps

    h, _ = lax.while_loop(moving, some, (h, jnp.int32(0)))
    return h, no_flux(sand.neighbours, False, h)
