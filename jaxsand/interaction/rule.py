"""How a tool moves the sand: what every push rule offers."""

from typing import Protocol, runtime_checkable

from jaxtyping import Array, Float

from jaxsand.autodiff.while_loop import Tree
from jaxsand.interaction._path import Pushed, Record
from jaxsand.scene.scene import Scene


@runtime_checkable
class PushRule(Protocol):
    """A rule for what a tool does to the sand, for the `push` of `act`, `step`, `follow` and `rollout`.

    A frozen dataclass, registered as a pytree: numbers that one may differentiate by are leaves, others are static. There
    are `SteppedPush`, `SwathPush` and `SplitPush`; the site's guide "A new tool" adds one in a page.

    Example:
        >>> import jaxsand as js
        >>> isinstance(js.SteppedPush(), js.PushRule)
        True
    """

    def check(self, scene: Scene) -> None:
        """Raises ValueError, with a remedy, if the rule does not move the scene's tool, or its numbers are out of range.

        Values that are being traced are not known yet and pass.
        """

    def along(
        self,
        scene: Scene,
        height: Float[Array, "H W"],
        path: Float[Array, "n _"],
        record: Record | None = None,
    ) -> tuple[Pushed, Tree]:
        """Lowers the tool at path[0], moves it along the legs of the path (m) and lifts it; the sand is not settled.

        It must be pure and traceable, and keep the volume: what leaves one cell arrives in others.

        Args:
            scene: the scene; its numbers have the height's dtype.
            height: the map [H, W] (m) before.
            path: the points [n, 2] = x, y (m) that the tool's centre visits, n >= 2; or [n, 3], with the height of its
                lowest point. A rule that keeps its tool at one depth raises ValueError for these.
            record: what to keep of the map after each leg, for animations.

        Returns:
            The map just after the tool was lifted, and what `record` returned after each leg, stacked; () without one.
        """
