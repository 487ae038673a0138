"""The shapes of which drawings are made: which cells each covers, and how high the sand is to stand there."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

import numpy as np

from jaxsand.goals.fields import LENGTH, METRES, POINT, Flag, Number, Pair, Points, Several, Text, read_object, wrong
from jaxsand.goals.letters import letter_strokes, text_strokes
from jaxsand.goals.outlines import Mask, inside, near, ring, strip
from jaxsand.scene.grid import Grid, places

WEIGHT = Number("a weight from 0 to 1e6", 0, 1e6)
"""Of sand above a goal, or below it."""

_HOLES = Several("a list of holes, each a list of corners", Points("the hole's corners [[x, y], ...] in metres", 3), 0, 100)


class Shape(Protocol):
    """What a drawing has at some place.

    Attributes:
      weights: those of sand above the shape and of sand below it.
    """

    @property
    def weights(self) -> tuple[float, float]:
        """The weights of sand above the shape and of sand below it."""

    def check(self, name: str) -> None:
        """ValueError, with the shape's name in the drawing, where its fields do not go together."""

    def covers(self, grid: Grid) -> Mask:
        """The cells whose centres the shape covers."""

    def over(self, beneath: np.ndarray, grid: Grid) -> np.ndarray:
        """The height [H, W] (m) that it has, or would have, in every cell, over what was drawn before."""


@dataclass(frozen=True, kw_only=True)
class _Weighted:
    """A shape with weights of its own."""

    above: Annotated[float, WEIGHT] = 1.0
    below: Annotated[float, WEIGHT] = 1.0

    @property
    def weights(self) -> tuple[float, float]:
        """Those of sand above and of sand below."""
        return self.above, self.below

    def check(self, name: str) -> None:
        """All weights go together."""


@dataclass(frozen=True, kw_only=True)
class _Level(_Weighted):
    """A shape of one height, or free: any height will do there, and what was drawn before stays, for sand to rest on."""

    height: Annotated[float | None, METRES] = None
    free: Annotated[bool, Flag()] = False

    @property
    def weights(self) -> tuple[float, float]:
        """Those of sand above and of sand below, 0 where it is free."""
        return (0.0, 0.0) if self.free else super().weights

    def check(self, name: str) -> None:
        """A free shape has neither a height nor weights, and any other has a height."""
        if self.free and (self.height is not None or super().weights != (1, 1)):
            raise ValueError(f"{name}.free: got true beside a height or weights; leave either out")
        if not self.free and self.height is None:
            raise ValueError(f"{name}.height: is missing; give {METRES.what}, or free: true where any height will do")

    def over(self, beneath: np.ndarray, grid: Grid) -> np.ndarray:
        """The height, or that of what was drawn before."""
        return beneath if self.height is None else np.full(grid.shape, self.height)


@dataclass(frozen=True, kw_only=True)
class Rectangle(_Level):
    """A rectangle about a centre, its length turned from the direction of x towards that of y."""

    centre: Annotated[tuple[float, float], POINT]
    size: Annotated[tuple[float, float], Pair("length and width in metres, [length, width]", LENGTH)]
    turned_deg: Annotated[float, Number("degrees from -360 to 360", -360, 360)] = 0.0

    def covers(self, grid: Grid) -> Mask:
        """The cells within it."""
        angle, half = math.radians(self.turned_deg), self.size[0] / 2
        along = np.array([[-1.0], [1.0]]) * (half * math.cos(angle), half * math.sin(angle))
        return inside(strip(np.array(self.centre) + along, self.size[1]), grid)


@dataclass(frozen=True, kw_only=True)
class Polygon(_Level):
    """A polygon, less other polygons; where its sides cross, what they enclose twice is outside."""

    points: Annotated[np.ndarray, Points("the corners as a list [[x, y], ...] in metres", 3)]
    holes: Annotated[tuple[np.ndarray, ...], _HOLES] = ()

    def covers(self, grid: Grid) -> Mask:
        """The cells within it and in none of its holes."""
        found = inside(self.points, grid)
        for hole in self.holes:
            found &= ~inside(hole, grid)
        return found


@dataclass(frozen=True, kw_only=True)
class Disc(_Level):
    """A disc, or a ring where an inner radius is given."""

    centre: Annotated[tuple[float, float], POINT]
    radius: Annotated[float, LENGTH]
    inner: Annotated[float, Number("metres, 0 or more and less than the radius", 0)] = 0.0

    def check(self, name: str) -> None:
        """A ring has a width."""
        super().check(name)
        if self.inner >= self.radius:
            raise ValueError(f"{name}.inner: got {self.inner:g}, the radius is {self.radius:g}; give less than the radius")

    def covers(self, grid: Grid) -> Mask:
        """The cells from the inner radius up to the outer one."""
        return ring(self.centre, self.inner, self.radius, grid)


@dataclass(frozen=True, kw_only=True)
class Path(_Level):
    """A line through points, as wide as a trench, with round ends and corners."""

    points: Annotated[np.ndarray, Points("two points or more as a list [[x, y], ...] in metres", 2)]
    width: Annotated[float, LENGTH]

    def covers(self, grid: Grid) -> Mask:
        """The cells at most half the width from the line."""
        return near(np.concatenate([self.points[:-1], self.points[1:]], 1), self.width / 2, grid)


@dataclass(frozen=True, kw_only=True)
class Lettering(_Level):
    """A text in strokes: a single capital letter by the project's own, all else by Hershey's (the extra `letters`)."""

    text: Annotated[str, Text("letters, digits or signs, at most 100", 100)]
    corner: Annotated[tuple[float, float], POINT]
    size: Annotated[float, LENGTH]
    width: Annotated[float, LENGTH]

    def check(self, name: str) -> None:
        """The text has strokes."""
        super().check(name)
        try:
            _strokes(self.text)
        except ValueError as error:
            raise ValueError(f"{name}.{error}") from None

    def covers(self, grid: Grid) -> Mask:
        """The cells at most half the width from a stroke; they are `size` high from their lower left corner on."""
        return near(np.tile(self.corner, 2) + self.size * _strokes(self.text), self.width / 2, grid)


@dataclass(frozen=True, kw_only=True)
class Ramp(_Weighted):
    """A rectangle between two points, whose height goes from one to another at the same rate all the way."""

    points: Annotated[np.ndarray, Points("the middles of its two ends, [[x0, y0], [x1, y1]]", 2, 2)]
    width: Annotated[float, LENGTH]
    from_: Annotated[float, METRES]
    to: Annotated[float, METRES]

    def check(self, name: str) -> None:
        """It has a length."""
        if np.array_equal(*self.points):
            raise ValueError(f"{name}.points: got {self.points[0].tolist()} twice; give two different points")

    def covers(self, grid: Grid) -> Mask:
        """The cells within the rectangle."""
        return inside(strip(self.points, self.width), grid)

    def over(self, beneath: np.ndarray, grid: Grid) -> np.ndarray:
        """The plane through the ramp."""
        x, y = places(grid.shape, float(grid.spacing))
        run = self.points[1] - self.points[0]
        share = ((x - self.points[0, 0]) * run[0] + (y - self.points[0, 1]) * run[1]) / (run @ run)
        return self.from_ + share * (self.to - self.from_)


KINDS: dict[str, type[Shape]] = {
    "rectangle": Rectangle,
    "polygon": Polygon,
    "disc": Disc,
    "path": Path,
    "text": Lettering,
    "ramp": Ramp,
}
"""The shapes by the names that they have in drawings."""


class OneShape:
    """A shape, by the name of its kind."""

    what = f"an object {{...}} with a kind, one of {', '.join(KINDS)}"

    def read(self, name: str, value: Any) -> Shape:
        """The shape, whose fields go together."""
        kind = value.get("kind") if isinstance(value, dict) else None
        if kind is None:
            raise wrong(name, value, self.what)
        if not isinstance(kind, str) or kind not in KINDS:
            raise wrong(f"{name}.kind", kind, f"one of {', '.join(KINDS)}")
        shape = read_object(KINDS[kind], name, value, ("kind",))
        shape.check(name)
        return shape


def _strokes(text: str) -> np.ndarray:
    """The strokes [n, 4] of a text, which begins at 0, 0 and is 1 high; 1 long if it is a level line."""
    capital = len(text) == 1 and "A" <= text <= "Z"
    strokes = letter_strokes(text) if capital else text_strokes(text)
    points = strokes.reshape(-1, 2)
    long, high = np.ptp(points, axis=0)
    return strokes if not (high or long) else ((points - points.min(0)) / (high or long)).reshape(-1, 4)
