"""A policy that sees a goal and the sand, and proposes where to push next."""

import json
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jax import export

from jaxsand.goals.untrusted import read_arrays
from jaxsand.goals.writing import reason, written
from jaxsand.planning.learned.network import LINES, Params, StrokeNet, judge, likeliest, symmetric
from jaxsand.scene.scene import Scene, blade_of

SIDE = 32
"""The cells along a side of the maps that the network reads, and was trained on."""

_STRIDE = 16  # between the looks at a larger map
_NOTHING = 1e-30  # the share of what is due in a part of a map where nothing is
_SIZES = (1, 8, 64)  # of batches, so that a few programs serve all
_FILE = "policy.npz"
_WIDEST = 4096  # features of a network
_REMEDY = (
    "reinstall jaxsand for the one that it ships, or train one in a checkout of its repository, which has the learners "
    "(python -m train hindsight)"
)


@dataclass(frozen=True)
class Policy:
    """A network and its parameters; `load_policy()` gives the one that comes with jaxsand.

    It was trained on maps of 32 x 32 cells with blades about two cells wide. A larger map is read part by part, and a
    smaller one is padded with level sand. Training takes a checkout of the repository: `python -m train hindsight`.
    """

    net: StrokeNet
    params: Params

    def propose(self, scene: Scene, goal: np.ndarray, current: np.ndarray, count: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Proposes the likeliest next strokes for a batch of goals.

        Args:
          scene: grid, sand and a `Blade` that digs.
          goal, current: maps [B, H, W] (m).
          count: how many strokes for each.

        Returns:
          The strokes [B, count, 4] (m), likeliest first, and the logarithms of their likelihoods [B, count].

        Raises:
          ValueError: for a scene without a blade, or one that does not dig.
        """
        depth, dx = _depth(scene), float(scene.grid.spacing)
        goal, current = (np.asarray(x, np.float32) / depth for x in (goal, current))
        undone = ((goal - current) ** 2).sum((1, 2))
        found, scores = [], []
        for row, column in _looks(scene.grid.shape):
            a, b = (_part(x, row, column) for x in (goal, current))
            strokes, score = in_batches(partial(_proposed, self.net, self.params, count), a, b, _SIZES)
            share = ((a - b) ** 2).sum((1, 2)) / np.maximum(undone, _NOTHING)
            found.append(strokes + np.array([column, row, column, row], np.float32))
            scores.append(score + np.log(np.maximum(share, _NOTHING))[:, None])
        strokes, score = np.concatenate(found, 1), np.concatenate(scores, 1)
        order = np.argsort(-score, axis=1, kind="stable")[:, :count]
        most = np.array([*scene.grid.shape[::-1]] * 2, np.float32) - 0.5
        strokes = np.clip(np.take_along_axis(strokes, order[..., None], 1), 0.5, np.maximum(most, 0.5))
        return strokes * dx, np.take_along_axis(score, order, 1)

    def export(self, path: str | Path, count: int = 1) -> None:
        """Writes the policy as one function in a file, which JAX runs without jaxsand and flax.

        The function takes goals and maps [B, 32, 32] (m), the blade's depth (m) and the spacing (m), all in float32, and
        returns what `propose` does: strokes [B, count, 4] (m), likeliest first, and the logarithms of their likelihoods
        [B, count]. The depth must be above 0. It serves any B, and is lowered for CPUs, for GPUs by CUDA and for TPUs. To
        read it takes JAX, no older than the one here, and flatbuffers. Later JAX reads such files for six months: keep the
        run's own checkpoint for longer.

        Args:
          path: the file.
          count: how many strokes for each map.

        Raises:
          ValueError: `count` is not from 1 to 96, the file cannot be written, or flatbuffers is not installed
            (`pip install 'jaxsand[export]'`).

        Example:
          >>> from pathlib import Path
          >>> import jax.numpy as jnp
          >>> from jax import export
          >>> from jaxsand.planning.learned.policy import load_policy
          >>> load_policy().export("policy.jax", count=2)  # doctest: +SKIP
          >>> propose = export.deserialize(Path("policy.jax").read_bytes()).call  # doctest: +SKIP
          >>> goal, sand = jnp.zeros((5, 32, 32)).at[:, 10:20, 8:10].set(-0.0075), jnp.zeros((5, 32, 32))  # doctest: +SKIP
          >>> strokes, scores = propose(goal, sand, jnp.float32(0.0075), jnp.float32(0.01))  # doctest: +SKIP
        """
        if find_spec("flatbuffers") is None:
            raise ValueError("export: flatbuffers is not installed; run pip install 'jaxsand[export]'")
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= LINES:
            raise ValueError(f"count: got {count!r}; give a whole number from 1 to {LINES}")

        def propose(
            goal: jax.Array, current: jax.Array, depth: jax.Array, spacing: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            goal, current = goal / depth, current / depth
            strokes, score = _proposed(self.net, self.params, count, goal, current)
            undone = jnp.any(goal != current, axis=(1, 2))
            return jnp.clip(strokes, 0.5, SIDE - 0.5) * spacing, score + jnp.where(undone, 0, math.log(_NOTHING))[:, None]

        maps = jax.ShapeDtypeStruct((*export.symbolic_shape("B"), SIDE, SIDE), jnp.float32)
        number = jax.ShapeDtypeStruct((), jnp.float32)
        function = export.export(jax.jit(propose), platforms=("cpu", "cuda", "tpu"))(maps, maps, number, number)
        with written(Path(path), "path") as file:
            file.write_bytes(function.serialize())


def in_batches(
    read: Callable[[np.ndarray, np.ndarray], tuple[jax.Array, ...]],
    goal: np.ndarray,
    current: np.ndarray,
    sizes: Sequence[int],
) -> tuple[np.ndarray, ...]:
    """Calls `read` on maps [B, ...] in batches of a few `sizes`, filled up with level sand, so that few programs are
    compiled.
    """
    out, first = [], 0
    while first < len(goal):
        left = len(goal) - first
        size = next((n for n in sizes if n >= left), sizes[-1])
        some = slice(first, first + size)
        pad = [(0, max(0, size - left)), (0, 0), (0, 0)]
        got = read(np.pad(goal[some], pad), np.pad(current[some], pad))
        out.append([np.asarray(x)[:left] for x in got])
        first += size
    return tuple(np.concatenate(parts) for parts in zip(*out, strict=True))


@partial(jax.jit, static_argnames=("net", "count"))
def _proposed(
    net: StrokeNet, params: Params, count: int, goal: jax.Array, current: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The `count` likeliest strokes [B, count, 4] (cells) and their scores [B, count]."""
    return likeliest(judge(net, params), symmetric(net, params, goal, current), count)


def save_policy(policy: Policy, path: Path, **about: float | str) -> None:
    """Writes a policy in half precision, with notes `about` it, which are numbers and text."""
    flat = traverse_util.flatten_dict(policy.params, sep="/")
    arrays: dict[str, Any] = {name: np.asarray(x, np.float16) for name, x in flat.items()}
    fields = {name: getattr(policy.net, name) for name in ("widths", "blocks", "features", "sights")}
    with path.open("wb") as file:
        np.savez_compressed(file, about=np.array(json.dumps({"net": fields, **about})), **arrays)


def load_policy(path: Path | None = None) -> Policy:
    """Loads the policy in a file, or the one that comes with jaxsand.

    Raises:
      ValueError: if there is none, or it cannot be read.
    """
    return _shipped() if path is None else _loaded(path)


def about_policy(path: Path | None = None) -> dict[str, Any]:
    """The notes of a policy's maker: the command, the minutes it took, and what it reached on goals of random strokes."""
    with resources.as_file(resources.files("jaxsand").joinpath("data", _FILE)) as own:
        return _read(path or own, ("about",))[0]


@cache
def _shipped() -> Policy:
    with resources.as_file(resources.files("jaxsand").joinpath("data", _FILE)) as path:
        return _loaded(path)


def _loaded(path: Path) -> Policy:
    about, arrays = _read(path)
    net = _net(about.get("net"), len(arrays))
    if net is None or {name: x.shape for name, x in arrays.items()} != _shapes(net):
        raise ValueError(f"policy: {path} holds no parameters of this version's network; {_REMEDY}")
    if other := next((name for name, x in arrays.items() if x.dtype.kind != "f" or not np.isfinite(x).all()), None):
        raise ValueError(f"policy: {path} holds no finite numbers as {other}; {_REMEDY}")
    flat = jax.device_put({name: x.astype(np.float32) for name, x in arrays.items()})  # a program less for every shape
    return Policy(net, traverse_util.unflatten_dict(flat, sep="/"))


def _read(path: Path, names: Collection[str] | None = None) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The notes in a policy's file, and its arrays."""
    try:
        arrays = read_arrays(path, names)
        about = json.loads(str(arrays.pop("about", "null")))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"policy: cannot read {path} ({reason(error)}); {_REMEDY}") from None
    if not isinstance(about, dict):
        raise ValueError(f"policy: {path} says nothing about its network; {_REMEDY}")
    return about, arrays


def _net(fields: object, most: int) -> StrokeNet | None:
    """The network of these fields, if it can be one; each block has more arrays than one, of `most` in all."""

    def good(number: object, low: int, high: int) -> bool:
        return isinstance(number, int) and not isinstance(number, bool) and low <= number <= high

    if not isinstance(fields, dict):
        return None
    widths, blocks = (fields.get(name) for name in ("widths", "blocks"))
    if not all(isinstance(some, list) and len(some) == 3 for some in (widths, blocks)):
        return None
    counts = [fields.get("features"), fields.get("sights"), *(widths or ())]
    if not all(good(n, 1, _WIDEST) for n in counts) or not all(good(n, 0, most) for n in blocks or ()):
        return None
    return StrokeNet(tuple(widths or ()), tuple(blocks or ()), counts[0], counts[1])


def _shapes(net: StrokeNet) -> dict[str, tuple[int, ...]]:
    """The shapes of a network's parameters by name."""
    maps = jax.ShapeDtypeStruct((1, SIDE, SIDE), jnp.float32)
    params = jax.eval_shape(net.init, jax.random.key(0), maps, maps, jax.ShapeDtypeStruct((1, 1, 4), jnp.float32))
    return {name: x.shape for name, x in traverse_util.flatten_dict(params, sep="/").items()}


def _depth(scene: Scene) -> float:
    depth = float(blade_of(scene).depth)
    if not depth > 0:
        raise ValueError(f"scene.tool.depth: got {depth}; the policy needs a blade that digs, such as Blade(depth=0.0075)")
    return depth


def _looks(shape: Sequence[int]) -> list[tuple[int, int]]:
    """The first rows and columns of the parts of a map that are read one by one."""
    firsts = [np.linspace(0, max(n - SIDE, 0), math.ceil(max(n - SIDE, 0) / _STRIDE) + 1).round().astype(int) for n in shape]
    return [(int(r), int(c)) for r in firsts[0] for c in firsts[1]]


def _part(maps: np.ndarray, row: int, column: int) -> np.ndarray:
    """The part of maps that begins at a row and a column, padded with level sand to the network's size."""
    part = maps[:, row : row + SIDE, column : column + SIDE]
    return np.pad(part, [(0, 0), *((0, SIDE - n) for n in part.shape[1:])])
