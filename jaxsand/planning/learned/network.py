"""The network of the shipped policy: from a goal and the sand as it lies to the strokes that are still to be made.

A U-Net reads both maps and gives three things for every cell: how likely a missing stroke starts there, a query, and a key.
A stroke from cell s ends at cell e with a likelihood in proportion to exp(query(s) . key(e)), so that all pairs of cells are
compared at once. The ends of strokes are easy to see, but which two belong together is seen along the line between them. So
a second, small network reads the U-Net's features along the line, says whether a stroke is missing there, and corrects its
ends, as the second stage of a detector does (Ren et al. 2015).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxsand.planning.learned.square_symmetries import turned, turned_back, turned_strokes, turned_strokes_back

Params = Mapping[str, Any]
"""The parameters of a flax network: arrays in nested dictionaries."""

_STARTS = 32  # peaks of the starts
_ENDS = 12  # peaks of the ends from each
LINES = 96  # of the likeliest pairs of these, along which the network looks
_TRUST = 0.3  # in the likelihoods of ends, beside what is seen along the line
_ALONG = 12  # places that are looked at from end to end
_BEYOND = 1.5  # cells: and one before and one behind
_ASIDE = (-2.0, -1.0, 1.0, 2.0)  # cells to the left: there only the maps are looked at
_FARTHEST = 1.5  # cells: an end is moved by less
_ALIKE = 1.5  # cells: strokes whose numbers differ by less are alike


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scores:
    """What the U-Net says of every cell.

    Attributes:
      start: log-likelihoods [B, H, W] that a missing stroke starts in a cell.
      query: [B, H, W, K], of the cells as starts.
      key: [B, H, W, K], of the cells as ends; see `ends`.
      sight: features [B, V, H, W, C] that the second network reads along lines, in V views, each turned its own way. The
        last three channels are the goal, the sand and their difference.
    """

    start: jax.Array
    query: jax.Array
    key: jax.Array
    sight: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lines:
    """What the second network says of strokes.

    Attributes:
      due: log-odds [B, P] that a stroke is still to be made.
      strokes: [B, P, 4] (cells) with corrected ends.
    """

    due: jax.Array
    strokes: jax.Array


class _Block(nn.Module):
    """Two convolutions beside a shortcut."""

    width: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        y = nn.Conv(self.width, (3, 3))(nn.relu(nn.LayerNorm()(x)))
        y = nn.Conv(self.width, (3, 3), kernel_init=nn.initializers.zeros)(nn.relu(y))
        return x + y


class Eye(nn.Module):
    """The U-Net. It works on blocks of 2 x 2 cells, so that most of its work is done on a quarter of the cells or fewer."""

    widths: tuple[int, int, int]
    blocks: tuple[int, int, int]
    features: int
    sights: int

    @nn.compact
    def __call__(self, goal: jax.Array, current: jax.Array) -> Scores:
        rows, columns = goal.shape[1:]
        y, x = (jnp.linspace(-1, 1, n, dtype=goal.dtype) for n in (rows, columns))
        place = [jnp.broadcast_to(v, goal.shape) for v in (x[None, None, :], y[None, :, None])]
        raw = jnp.stack([goal, current, goal - current], -1)
        x = _folded(jnp.concatenate([raw, jnp.stack(place, -1)], -1), 2)
        x = nn.Conv(self.widths[0], (3, 3))(x)
        aside = []
        for level, (width, blocks) in enumerate(zip(self.widths, self.blocks, strict=True)):
            if level:
                aside.append(x)
                x = nn.Conv(width, (2, 2), (2, 2))(x)
            for _ in range(blocks):
                x = _Block(width)(x)
        for width, blocks, skip in zip(self.widths[1::-1], self.blocks[1::-1], aside[::-1], strict=True):
            x = _unfolded(nn.Dense(4 * width)(x), 2) + nn.Dense(width)(skip)
            for _ in range(blocks):
                x = _Block(width)(x)
        x = nn.relu(nn.LayerNorm()(x))
        x = _unfolded(nn.Dense(4 * (1 + 2 * self.features + self.sights))(x), 2)
        start, query, key, sight = jnp.split(x, [1, 1 + self.features, 1 + 2 * self.features], -1)
        sight = jnp.concatenate([sight, raw], -1)
        return Scores(_log_share(start[..., 0]), query / math.sqrt(self.features), key, sight[:, None])


class _Line(nn.Module):
    """The second network: from features along lines [..., N] to the log-odds, and the moves of both ends ahead and to the
    left.
    """

    @nn.compact
    def __call__(self, seen: jax.Array) -> jax.Array:
        x = nn.relu(nn.Dense(128)(seen))
        return nn.Dense(5)(nn.relu(nn.Dense(64)(x)))


class StrokeNet(nn.Module):
    """Both networks.

    Maps are [B, H, W] in units of the blade's depth, H and W multiples of 8; strokes are in cells, cell centres at whole
    numbers and a half. It was trained on 32 x 32 cells.
    """

    widths: tuple[int, int, int] = (32, 64, 96)
    blocks: tuple[int, int, int] = (1, 2, 2)
    features: int = 16
    sights: int = 12

    def setup(self) -> None:
        """Makes the layers."""
        self.eye = Eye(self.widths, self.blocks, self.features, self.sights)
        self.line = _Line()

    def __call__(self, goal: jax.Array, current: jax.Array, strokes: jax.Array) -> tuple[Scores, Lines]:
        scores = self.eye(goal, current)
        return scores, self.along(scores, strokes)

    def look(self, goal: jax.Array, current: jax.Array) -> Scores:
        """The scores of the U-Net alone."""
        return self.eye(goal, current)

    def along(self, scores: Scores, strokes: jax.Array) -> Lines:
        """What the second network says of strokes [B, P, 4] (cells), averaged over all views."""
        every = in_views(scores, strokes)
        views, side = scores.sight.shape[1], scores.sight.shape[2]
        said = self.line(seen_on_lines(scores.sight, every))
        ahead = _ahead(every)
        left = _left_of(ahead)
        move = _FARTHEST * jnp.tanh(said[..., 1:])
        ends = [every[..., :2] + move[..., :1] * ahead + move[..., 1:2] * left]
        ends.append(every[..., 2:] + move[..., 2:3] * ahead + move[..., 3:] * left)
        right = jnp.concatenate(ends, -1)
        back = jnp.stack([turned_strokes_back(right[:, way], way, side) for way in range(views)])
        return Lines(said[..., 0].mean(1), back.mean(0))


def in_views(scores: Scores, strokes: jax.Array) -> jax.Array:
    """Strokes [B, P, 4] (cells) as each of the V views shows them, [B, V, P, 4]."""
    chex.assert_shape(strokes, (scores.sight.shape[0], None, 4))
    views, side = scores.sight.shape[1], scores.sight.shape[2]
    return jnp.stack([turned_strokes(strokes, way, side) for way in range(views)], 1)


def seen_on_lines(sight: jax.Array, strokes: jax.Array) -> jax.Array:
    """What there is to see of strokes [B, V, P, 4] (cells), [B, V, P, N]: all features along them, the maps beside them.

    Args:
      sight: maps [B, V, H, W, C], as of `Scores`.
      strokes: as `in_views` gives them.
    """
    maps = sight[..., -3:-1]
    seen = [seen_along(sight, strokes), *(seen_along(maps, strokes, aside) for aside in _ASIDE)]
    return jnp.concatenate([x.reshape(*x.shape[:3], -1) for x in seen], -1)


def _ahead(strokes: jax.Array) -> jax.Array:
    """Unit vectors [..., 2] along strokes [..., 4]; 0 where a stroke has no length."""
    way = strokes[..., 2:] - strokes[..., :2]
    return way / jnp.maximum(jnp.sqrt(jnp.sum(way**2, -1, keepdims=True)), 1e-6)


def _left_of(ahead: jax.Array) -> jax.Array:
    """Vectors [..., 2] turned to the left by a quarter turn."""
    return jnp.stack([-ahead[..., 1], ahead[..., 0]], -1)


def seen_along(sight: jax.Array, strokes: jax.Array, aside: float = 0.0) -> jax.Array:
    """Features along strokes, from 1.5 cells before the start to 1.5 cells behind the end, interpolated bilinearly.

    Args:
      sight: maps [B, V, H, W, C].
      strokes: [B, V, P, 4] (cells).
      aside: how far to the left of the strokes (cells).

    Returns:
      [B, V, P, L, C], L places along each stroke.
    """
    ahead = _ahead(strokes)[..., None, :]
    a, b = strokes[..., None, :2], strokes[..., None, 2:]
    part = jnp.linspace(0, 1, _ALONG, dtype=sight.dtype)[None, None, None, :, None]
    points = jnp.concatenate([a - _BEYOND * ahead, a + part * (b - a), b + _BEYOND * ahead], -2)
    points = points + aside * _left_of(ahead)
    batch, views, rows, columns, channels = sight.shape
    at = jnp.stack([jnp.clip(points[..., k] - 0.5, 0, n - 1.001) for k, n in enumerate((columns, rows))], -1)
    low = jnp.floor(at).astype(jnp.int32)
    part = at - low
    flat = sight.reshape(batch, views, rows * columns, channels)
    out = jnp.zeros((*points.shape[:-1], channels), sight.dtype)
    for i in (0, 1):
        for j in (0, 1):
            cell = (low[..., 1] + i) * columns + low[..., 0] + j
            weight = jnp.abs(1 - i - part[..., 1]) * jnp.abs(1 - j - part[..., 0])
            value = jax.vmap(jax.vmap(lambda maps, cell: maps[cell]))(flat, cell)
            out = out + weight[..., None] * value
    return out


def _folded(x: jax.Array, n: int) -> jax.Array:
    """Blocks of n x n cells as one cell with n^2 times as many channels."""
    b, h, w, c = x.shape
    return x.reshape(b, h // n, n, w // n, n, c).transpose(0, 1, 3, 2, 4, 5).reshape(b, h // n, w // n, n * n * c)


def _unfolded(x: jax.Array, n: int) -> jax.Array:
    """The inverse of `_folded`."""
    b, h, w, c = x.shape
    c //= n * n
    return x.reshape(b, h, w, n, n, c).transpose(0, 1, 3, 2, 4, 5).reshape(b, h * n, w * n, c)


def _log_share(score: jax.Array) -> jax.Array:
    """Scores [..., H, W] as logarithms of shares that sum to 1 over the map."""
    return score - jax.nn.logsumexp(score, (-2, -1), keepdims=True)


def spread(points: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Points [..., 2] = x, y (cells) as weights [..., H, W] of the four cells around each; the weights sum to 1."""
    rows, columns = shape
    x = jnp.clip(points[..., 0, None] - 0.5, 0, columns - 1)
    y = jnp.clip(points[..., 1, None] - 0.5, 0, rows - 1)
    across = jnp.maximum(1 - jnp.abs(x - _counted(columns, x)), 0)
    along = jnp.maximum(1 - jnp.abs(y - _counted(rows, y)), 0)
    return along[..., :, None] * across[..., None, :]


def _counted(count: int, like: jax.Array) -> jax.Array:
    """0, 1, ..., count - 1 along the last axis of an array with as many axes as `like`."""
    return jnp.arange(count, dtype=like.dtype).reshape(*[1] * (like.ndim - 1), count)


def ends(scores: Scores, starts: jax.Array) -> jax.Array:
    """Log-likelihoods [B, R, H, W] of the ends of strokes that start at points [B, R, 2] (cells)."""
    shares = spread(starts, (scores.start.shape[1], scores.start.shape[2]))
    query = jnp.einsum("brij,bijk->brk", shares, scores.query)
    return _log_share(jnp.einsum("brk,bijk->brij", query, scores.key))


def symmetric(net: nn.Module, params: Params, goal: jax.Array, current: jax.Array) -> Scores:
    """The U-Net's scores of square maps, averaged (as logarithms) over the eight turns and mirrors of a square.

    Args:
      net: a network whose method `look` gives scores.
      params: its parameters.
      goal, current: maps [B, H, W] in units of the blade's depth.
    """
    ways = range(8)
    views = (jnp.concatenate([turned(maps, way) for way in ways]) for maps in (goal, current))
    every: Any = net.apply(params, *views, method="look")
    every = jax.tree.map(lambda x: x.reshape(len(ways), -1, *x.shape[1:]), every)
    start, query, key = ([turned_back(x[way], way) for way in ways] for x in (every.start, every.query, every.key))
    mean = _log_share(jnp.stack(start).mean(0))
    sight = jnp.moveaxis(every.sight[:, :, 0], 0, 1)
    return Scores(mean, jnp.concatenate(query, -1) / len(ways), jnp.concatenate(key, -1), sight)


Judge = Callable[[Scores, jax.Array], Lines]


def judge(net: StrokeNet, params: Params) -> Judge:
    """The second network as a function of scores and strokes [B, P, 4] (cells)."""

    def along(scores: Scores, strokes: jax.Array) -> Lines:
        lines: Any = net.apply(params, scores, strokes, method="along")
        return lines

    return along


def likeliest(along: Judge, scores: Scores, count: int) -> tuple[jax.Array, jax.Array]:
    """The `count` likeliest strokes, no two alike.

    A stroke's score is

        log sigmoid(due) + 0.3 [log p(start) + log p(end | start)],

    with p summed over blocks of 3 x 3 cells around peaks. A stroke's ends are first the means of the likelihoods in these
    blocks; the second network then corrects them.

    Returns:
      The strokes [B, count, 4] (cells), likeliest first, and their scores [B, count].
    """
    strokes, log_shares = jax.lax.map(_candidates, scores)
    lines = along(scores, strokes)
    return best_of(lines.strokes, jax.nn.log_sigmoid(lines.due) + _TRUST * log_shares, count)


def best_of(strokes: jax.Array, score: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """Of strokes [B, P, 4] (cells) with scores [B, P], the `count` best, no two alike.

    Strokes are alike if none of their numbers differ by 1.5 cells or more.

    Returns:
      The strokes [B, count, 4], best first, and their scores [B, count].
    """

    def pick(strokes: jax.Array, score: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(score: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            best = jnp.argmax(score)
            like = jnp.max(jnp.abs(strokes - strokes[best][None]), -1) < _ALIKE
            return jnp.where(like, score - 1e3, score), (strokes[best], score[best])

        return jax.lax.scan(one, score, None, length=count)[1]

    return jax.vmap(pick)(strokes, score)


def _candidates(scores: Scores) -> tuple[jax.Array, jax.Array]:
    """The 96 likeliest strokes between peaks of one map, [96, 4] (cells), and the logarithms of their likelihoods."""
    begin = jnp.exp(scores.start)
    p, first = _peaks(begin, _STARTS)
    a = jax.vmap(lambda cell: _centre(begin, cell))(first)
    rows, columns = begin.shape
    query = jnp.einsum("pij,ijk->pk", spread(a, (rows, columns)), scores.query)
    end = jnp.exp(_log_share(jnp.einsum("pk,ijk->pij", query, scores.key)))
    q, last = jax.vmap(lambda share: _peaks(share, _ENDS))(end)
    b = jax.vmap(lambda share, cells: jax.vmap(lambda cell: _centre(share, cell))(cells))(end, last)
    strokes = jnp.concatenate([jnp.broadcast_to(a[:, None], b.shape), b], -1)
    both = jnp.log(jnp.maximum(p, 1e-9))[:, None] + jnp.log(jnp.maximum(q, 1e-9))
    log_shares, which = jax.lax.top_k(both.ravel(), LINES)
    return strokes.reshape(-1, 4)[which], log_shares


def _peaks(share: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """The `count` largest local maxima of the sums over blocks of 3 x 3 cells, and their cells."""
    block = jax.lax.reduce_window(share, 0.0, jax.lax.add, (3, 3), (1, 1), "SAME")
    peak = block >= jax.lax.reduce_window(block, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "SAME")
    return jax.lax.top_k(jnp.where(peak, block, 0).ravel(), count)


def _centre(share: jax.Array, cell: jax.Array) -> jax.Array:
    """The mean place x, y (cells) of the shares [H, W] in the block of 3 x 3 cells around a cell."""
    rows, columns = share.shape
    y, x = jnp.meshgrid(jnp.arange(rows), jnp.arange(columns), indexing="ij")
    near = (jnp.abs(y - cell // columns) <= 1) & (jnp.abs(x - cell % columns) <= 1)
    weight = jnp.where(near, share + 1e-12, 0)
    return jnp.stack([jnp.sum(weight * (x + 0.5)), jnp.sum(weight * (y + 0.5))]) / jnp.sum(weight)
