"""The push that advances by sub-steps and keeps the sand at rest around the tool: of a blade and of a wheel."""

from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._path import Pushed, Record
from jaxsand.interaction.blade_stepped import push_along
from jaxsand.interaction.wheel_stepped import roll_along
from jaxsand.relaxation.stopping import check_rate, check_whole
from jaxsand.scene.scene import Scene
from jaxsand.scene.tools import Blade, Bucket, NoTool, Wheel
from jaxsand.scene.validation import short


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SteppedPush:
    """The tool advances by small sub-steps, and the sand around it is brought to rest after each: the default push.

    It approximates the quasi-static limit, in which the tool moves so slowly that the sand around it is always at rest, for
    a `Blade` or a `Wheel`. In each sub-step the sand in the newly covered part of cells moves one cell on along the
    normal of the tool's face; then `sweeps` proximal gradient steps bring the sand around the tool to repose. The map
    converges to the limit as `substep` and 1 / `sweeps` go to 0; `jaxsand bench push` measures the error and the cost. The
    last, shorter sub-step of a leg counts in proportion to its length, so that the result is continuous in the stroke.

    Attributes:
        substep: length of a sub-step in spacings, above 0 and at most 1; static. Above 1/2 a thin blade at an angle lets up
            to 5% of what it cuts pass.
        sweeps: number of proximal steps after each sub-step; static.
        rate: step length of these, as the rate of `Relaxation`.

    Source:
        Kim, Pavlov & Johnson, arXiv:1908.02745, section "Tool Interaction", with shares of cells in place of whole cells.

    Example:
        >>> import jaxsand as js
        >>> js.SteppedPush.fine()
        SteppedPush(substep=0.0625, sweeps=8, rate=0.2)
    """

    substep: float = field(default=0.125, metadata={"static": True})
    sweeps: int = field(default=4, metadata={"static": True})
    rate: Float[Array, ""] | float = 0.2

    @classmethod
    def fine(cls) -> "SteppedPush":
        """A push with half the sub-step and twice the sweeps: closer to the limit, at 1.6 times the cost."""
        return cls(1 / 16, 8)

    def check(self, scene: Scene) -> None:
        """Raises ValueError if the scene's tool is neither blade nor wheel, or a number is out of range; see `PushRule`."""
        if not isinstance(scene.tool, NoTool | Blade | Wheel):
            raise ValueError(
                f"push: got SteppedPush for a {type(scene.tool).__name__}; SteppedPush() is for a Blade or a Wheel, "
                + ("call js.scoop and js.dump" if isinstance(scene.tool, Bucket) else "give a PushRule that moves this tool")
            )
        if not (isinstance(self.substep, int | float | np.number) and 0 < self.substep <= 1):
            raise ValueError(f"push.substep: got {short(self.substep)}; give a part of a spacing, above 0 and at most 1")
        check_whole("push.sweeps", self.sweeps, 0)
        check_rate(scene, "push.rate", self.rate)

    def along(self, scene: Scene, height: jax.Array, path: jax.Array, record: Record | None = None) -> tuple[Pushed, Tree]:
        """Moves the scene's tool along the path; see `PushRule`."""
        move = roll_along if isinstance(scene.tool, Wheel) else push_along
        return move(scene, height, path, self, record)
