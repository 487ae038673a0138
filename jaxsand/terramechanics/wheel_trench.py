"""The trench of a towed wheel in closed form, and its exact relaxation.

Pavlov & Johnson, Soil Displacement Terramechanics for Wheel-Based Trenching with a Planetary Rover (ICRA 2019). The form:
notebooks/site/theory/closed-forms.md ("A wheel's trench"). Heights and places are in metres, x to the right across the
direction of travel, 0 at the middle of the cut; angles are in radians.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from jaxsand.relaxation.schemes import SuperTimeStepping
from jaxsand.relaxation.settling import settle_batch
from jaxsand.relaxation.stopping import UntilStill
from jaxsand.scene.scene import make_scene
from jaxsand.scene.validation import short

_TEN = math.radians(10)


@dataclass(frozen=True)
class Pass:
    """One pass of a wheel through level sand.

    Args:
      slip_angle: beta, between the wheel's plane and its direction of travel (rad), 0 to pi/2.
      sinkage: depth of the wheel's lowest point below the level sand (m), 0 to the radius.
      radius: of the wheel (m).
      width: of the wheel (m).
      repose_angle: of the sand (rad).
      spin: the rim's speed over the wheel's, r omega / v: 0 for a wheel towed without turning, 1 / (1 - i) for one driven at
        the slip ratio i. A spinning wheel's grousers carry spin b h_g zeta of the section along and leave it behind the
        wheel.
      grouser_height: h_g (m).
      grouser_fill: zeta, the share of a grouser's height that sand fills.

    Raises:
      ValueError: for a value out of range.

    Source: Pavlov & Johnson, ICRA 2019.

    Example:
      >>> import jaxsand as js
      >>> run = js.trench.Pass(slip_angle=0.0, sinkage=0.01)
      >>> run.swept == run.width
      True
    """

    slip_angle: float
    sinkage: float
    radius: float = 0.048
    width: float = 0.05
    repose_angle: float = math.radians(29)
    spin: float = 0.0
    grouser_height: float = 0.005
    grouser_fill: float = 0.1

    def __post_init__(self) -> None:
        _within("slip_angle", self.slip_angle, 0, math.pi / 2, "rad from 0 to pi/2")
        for name in ("radius", "width"):
            _above(name, getattr(self, name), "metres above 0")
        _above("repose_angle", self.repose_angle, "rad between 0 and pi/2")
        _within("repose_angle", self.repose_angle, 0, math.pi / 2 * (1 - 1e-9), "rad between 0 and pi/2")
        _within("sinkage", self.sinkage, 0, self.radius, "metres from 0 to the wheel's radius")
        for name in ("spin", "grouser_height", "grouser_fill"):
            _within(name, getattr(self, name), 0, sys.float_info.max, "a finite number of 0 or more")

    @property
    def slope(self) -> float:
        """The tangent of the angle of repose."""
        return math.tan(self.repose_angle)

    @property
    def rim(self) -> float:
        """The width p of the cut's floor, which the wheel's rim cuts (m)."""
        return self.width * math.cos(self.slip_angle)

    @property
    def flank(self) -> float:
        """The width of each of the cut's flanks, (w - p) / 2 = s sin(beta) (m)."""
        return math.sqrt(max(2 * self.radius * self.sinkage - self.sinkage**2, 0)) * math.sin(self.slip_angle)

    @property
    def swept(self) -> float:
        """The width w of the cut (m)."""
        return self.rim + 2 * self.flank

    @property
    def carried(self) -> float:
        """The area (m^2) of the section that the grousers leave behind the wheel, at most what the pile that it comes from
        holds.
        """
        asked = self.spin * self.width * self.grouser_height * self.grouser_fill
        left, right = self._displaced()
        return min(asked, right if self.parted else left + right)

    @property
    def parted(self) -> bool:
        """Whether the flanks' sand goes to the left and the floor's to the right."""
        beta, flanks = self.slip_angle, 2 * self._flank_area()
        return not (beta < _TEN or abs(beta - math.pi / 2) < _TEN or flanks <= self.sinkage * self.rim)

    def piles(self) -> tuple[float, float]:
        """The areas (m^2) of the left and the right pile before the sand flows, less what the grousers take."""
        left, right = self._displaced()
        if self.parted:
            return left, right - self.carried
        return left - self.carried / 2, right - self.carried / 2

    def _displaced(self) -> tuple[float, float]:
        """The areas (m^2) of the left and the right pile without grousers."""
        flanks, rim = 2 * self._flank_area(), self.sinkage * self.rim
        return (flanks, rim) if self.parted else ((flanks + rim) / 2, (flanks + rim) / 2)

    def _flank_area(self) -> float:
        return 2 / 3 * self.flank * self.sinkage

    def floor(self) -> float:
        """The depth of the cut's floor (m) once the sand left by the grousers lies level in it."""
        filled = self.carried
        if filled == 0:
            return self.sinkage

        def short(inside: float) -> float:
            return self.sinkage * (self.rim * inside**2 + 4 / 3 * self.flank * inside**3) - filled

        # In the share of a flank that is filled, which is as well resolved at any sinkage.
        inside = float(brentq(short, 0.0, 1.0, xtol=1e-16, rtol=1e-15)) if short(1.0) > 0 else 1.0
        return self.sinkage * (1 - inside**2)


@dataclass(frozen=True)
class Profile:
    """A section across a trench: a chain of straight lines, level sand at height 0 on both sides.

    Calling a profile with places x (m) gives the heights there (m).

    Args:
      x: places [n] (m), rising.
      z: heights [n] (m) at x.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> profile = js.trench.Profile(np.array([-1.0, 0.0, 1.0]), np.array([0.0, -0.5, 0.0]))
      >>> profile.deepest, profile.area()
      (0.5, -0.5)
      >>> profile(np.array([0.5, 3.0])).tolist()
      [-0.25, 0.0]
    """

    x: np.ndarray
    z: np.ndarray

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return np.interp(x, self.x, self.z, left=0.0, right=0.0)

    @property
    def toes(self) -> tuple[float, float]:
        """The first and the last place (m), where the profile meets the level sand."""
        return float(self.x[0]), float(self.x[-1])

    @property
    def deepest(self) -> float:
        """The depth of the deepest point below the level sand (m)."""
        return -float(self.z.min())

    @property
    def peaks(self) -> tuple[float, float]:
        """The heights of the highest points left and right of the deepest (m)."""
        low = int(self.z.argmin())
        return float(self.z[: low + 1].max()), float(self.z[low:].max())

    def area(self) -> float:
        """The area above level less the missing area below it (m^2)."""
        return float(np.trapezoid(self.z, self.x))


def closed_form(run: Pass) -> Profile:
    """The settled section of a wheel's trench in closed form, all faces at repose: toe, peak, foot, foot, peak, toe.

    The section is pointed while that makes it no deeper than the cut's floor. With u = h_L1 + (w + p) t / 2 and v = h_R1 +
    (w - p) t / 2, h_1 the piles' heights before the flow, its depth d then solves -2 d^2 - 2 (u + v) d + u^2 + v^2 = 0, and
    the peaks are (u - d) / 2 and (v - d) / 2; for beta < 10 degrees the deepest point lies in the middle. Otherwise the
    section is flat at the depth h of the cut's floor, and each peak x solves x^2 + 2 h x + h^2 / 2 - h h_1 - h_1^2 / 2 - (w
    - p) h t / 6 = 0. With grousers the same balance holds for a cut that is filled level to the depth of `Pass.floor`.

    Args:
      run: the wheel's pass.

    Returns:
      The settled `Profile`; its area is 0 without grousers.

    Raises:
      ValueError: where the closed form breaks down: a pile would end below the level sand, or the floor would have a
        negative width (where pointed and flat profiles meet; for the source's wheel and sand 2% of all slip angles and
        sinkages).

    Source: Pavlov & Johnson, ICRA 2019; see the head of this module for the symbols.

    Example:
      >>> import math
      >>> import jaxsand as js
      >>> profile = js.trench.closed_form(js.trench.Pass(slip_angle=math.radians(45), sinkage=0.015))
      >>> round(profile.deepest, 4)
      0.015
      >>> abs(profile.area()) < 1e-12
      True
    """
    t, w, p = run.slope, run.swept, run.rim
    left, right = (math.sqrt(2 * t * area) for area in run.piles())
    toes = -w / 2 - left / t, w / 2 + right / t
    middle = 0.0 if run.slip_angle < _TEN else p / 2
    u, v = (middle - toes[0]) * t, (toes[1] - middle) * t
    depth = (u * u + v * v) / (u + v + math.sqrt((u + v) ** 2 + 2 * (u * u + v * v))) if u + v > 0 else 0.0
    if depth <= run.floor():
        peaks = (u - depth) / 2, (v - depth) / 2
    else:
        depth = run.floor()
        peaks = _beside_a_floor(run, depth, left), _beside_a_floor(run, depth, right)
    feet = toes[0] + (2 * peaks[0] + depth) / t, toes[1] - (2 * peaks[1] + depth) / t
    if min(peaks) < -1e-12 or feet[1] - feet[0] < -1e-9:
        raise ValueError(
            f"slip_angle: got {math.degrees(run.slip_angle):.4g} degrees at a sinkage of {run.sinkage * 1e3:.4g} mm, where "
            "the closed form has no profile (its faces would cross, or a pile end below the level sand); use relaxed instead"
        )
    x = [toes[0], toes[0] + peaks[0] / t, feet[0], max(feet), toes[1] - peaks[1] / t, toes[1]]
    return Profile(np.array(x), np.array([0.0, peaks[0], -depth, -depth, peaks[1], 0.0]))


def _beside_a_floor(run: Pass, depth: float, pile: float) -> float:
    """The height (m) of the peak beside a flat floor, such that the area of the pile and of the flank is kept."""
    inside = _inside(run, depth)
    cut = run.flank * run.sinkage * ((1 - inside) - (1 - inside**3) / 3)
    spare = run.slope * (depth * run.flank * (1 - inside) - cut)
    return math.sqrt(depth * depth / 2 + depth * pile + pile * pile / 2 + spare) - depth


def _inside(run: Pass, depth: float) -> float:
    """The share of a flank's width, from the rim's cut, that is deeper than `depth`."""
    return math.sqrt(max(1 - depth / run.sinkage, 0.0)) if run.sinkage else 0.0


def unsettled(run: Pass) -> Profile:
    """The section before the sand flows: the cut, and a pile on each side, steep against it.

    Args:
      run: the wheel's pass.

    Returns:
      A `Profile`; where it jumps, two points have the same x.

    Example:
      >>> import jaxsand as js
      >>> profile = js.trench.unsettled(js.trench.Pass(slip_angle=0.0, sinkage=0.01))
      >>> round(profile.deepest, 4)
      0.01
    """
    t, w = run.slope, run.swept
    left, right = (math.sqrt(2 * t * area) for area in run.piles())
    eta = np.linspace(1, _inside(run, run.floor()), 201)
    # The chords of a parabola lie above it; lowered by as much, they hold its area.
    flank = -run.sinkage * (1 - eta**2 + (eta[1] - eta[0]) ** 2 / 6)
    out = run.rim / 2 + run.flank * eta
    x: list[np.ndarray | list[float]] = [
        [-w / 2 - left / t, -w / 2],
        -out,
        [-out[-1], out[-1]],
        out[::-1],
        [w / 2, w / 2 + right / t],
    ]
    z: list[np.ndarray | list[float]] = [[0, left], flank, [-run.floor(), -run.floor()], flank[::-1], [right, 0]]
    return Profile(np.concatenate(x), np.concatenate(z))


def cell_means(profile: Profile, edges: np.ndarray) -> np.ndarray:
    """The mean heights of a profile in cells, exact also where it jumps.

    Args:
      profile: the section.
      edges: the cells' edges [n + 1] (m), rising.

    Returns:
      The mean heights [n] (m).

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> profile = js.trench.Profile(np.array([-1.0, 0.0, 1.0]), np.array([0.0, -0.5, 0.0]))
      >>> js.trench.cell_means(profile, np.array([-1.0, 0.0, 1.0])).tolist()
      [-0.25, -0.25]
    """
    x, z = profile.x, profile.z
    whole = np.concatenate([[0], np.cumsum(np.diff(x) * (z[1:] + z[:-1]) / 2)])
    k = np.clip(np.searchsorted(x, edges, side="right") - 1, 0, len(x) - 2)
    run = np.clip(edges, x[0], x[-1]) - x[k]
    width = x[k + 1] - x[k]
    slope = np.where(width > 0, (z[k + 1] - z[k]) / np.where(width > 0, width, 1), 0)
    return np.diff(whole[k] + run * (z[k] + slope * run / 2)) / np.diff(edges)


def relaxed(runs: list[Pass], spacing: float = 5e-4) -> list[Profile]:
    """The settled sections of wheel's passes, found by letting the unsettled sections relax in one dimension.

    This is the limit of small steps of the simulator's own settling. It is computed in float64, and its error comes from the
    cells: about tan(angle of repose) spacing / 2 at a corner.

    Args:
      runs: passes in sand of one angle of repose, at least one.
      spacing: of the cells (m).

    Returns:
      A `Profile` for every pass.

    Raises:
      ValueError: for no passes, or passes of different angles of repose.

    Example:
      >>> import jaxsand as js
      >>> run = js.trench.Pass(slip_angle=0.0, sinkage=0.01)
      >>> exact = js.trench.relaxed([run], spacing=4e-3)[0]
      >>> abs(exact.deepest - js.trench.closed_form(run).deepest) < 2e-3
      True
    """
    if len({run.repose_angle for run in runs}) != 1:
        angles = sorted({run.repose_angle for run in runs})
        raise ValueError(f"runs: got repose angles {angles}; give at least one run, all of one angle")
    reach = max(abs(end) for run in runs for end in unsettled(run).toes) * 1.1 + 10 * spacing
    return _relaxed(runs, reach, spacing)


def relaxing(reach: float = 0.2, spacing: float = 1e-3) -> Callable[[Pass], Profile]:
    """A function like `relaxed` for one pass at a time, on the same cells for all passes.

    Args:
      reach: how far the cells go to either side (m).
      spacing: of the cells (m).

    Returns:
      A function from a `Pass` to its settled `Profile`; it raises ValueError for a pass whose piles come within ten cells of
      the reach.

    Example:
      >>> import jaxsand as js
      >>> relax = js.trench.relaxing(reach=0.1, spacing=4e-3)
      >>> relax(js.trench.Pass(slip_angle=0.0, sinkage=0.01)).deepest > 0
      True
    """

    def relax(run: Pass) -> Profile:
        if max(map(abs, unsettled(run).toes)) > reach - 10 * spacing:
            raise ValueError(
                f"reach: got {short(reach)} m, too little for a sinkage of {run.sinkage * 1e3:.4g} mm; give more"
            )
        return _relaxed([run], reach, spacing)[0]

    return relax


def _relaxed(runs: list[Pass], reach: float, spacing: float) -> list[Profile]:
    half = math.ceil(reach / spacing)
    edges = (np.arange(-half, half + 2) - 0.5) * spacing
    start = np.stack([cell_means(unsettled(run), edges) for run in runs])[:, None, :]
    with jax.enable_x64(True):
        scene = make_scene((1, 2 * half + 1), spacing, runs[0].repose_angle, 4)
        stop = UntilStill(1e-6, bound=2_000_000)
        end = settle_batch(scene, jnp.asarray(start, jnp.float64), scheme=SuperTimeStepping(0.05, 1 / 64), stop=stop)
        heights = np.asarray(end.height)[:, 0]
    x = (edges[1:] + edges[:-1]) / 2
    return [trimmed(Profile(x, z), 1e-9 * float(np.abs(z).max())) for z in heights]


def trimmed(profile: Profile, least: float) -> Profile:
    """The part of a profile between its toes.

    Args:
      profile: the section.
      least: heights (m) nearer to 0 count as level.

    Returns:
      The profile from the last level point before the trench to the first one after it; of a level profile, its two ends.

    Example:
      >>> import numpy as np
      >>> import jaxsand as js
      >>> wide = js.trench.Profile(np.arange(5.0), np.array([0.0, 0.0, -1.0, 0.0, 0.0]))
      >>> js.trench.trimmed(wide, 1e-6).x.tolist()
      [1.0, 2.0, 3.0]
    """
    x, z = profile.x, profile.z
    moved = np.flatnonzero(np.abs(z) > least)
    if not moved.size:
        return Profile(x[[0, -1]], z[[0, -1]])
    part = slice(max(moved[0] - 1, 0), moved[-1] + 2)
    return Profile(x[part], z[part])


def _within(name: str, value: float, least: float, most: float, what: str) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name}: got {short(value)}; give {what}")


def _above(name: str, value: float, what: str) -> None:
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"{name}: got {short(value)}; give {what}")
