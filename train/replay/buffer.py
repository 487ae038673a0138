"""A replay buffer: a ring of items of one shape, drawn from at random with equal chances."""

from dataclasses import dataclass
from typing import Any

import flashbax
import jax

Items = Any
"""A pytree of arrays; of one item, or of many along a first axis."""


@dataclass(frozen=True)
class Buffer:
    """Keeps the last `capacity` items, of which `batch` are drawn at a time, with replacement. Its state is a pytree."""

    capacity: int
    batch: int

    def init(self, item: Items) -> Any:
        """The empty state; `item` shows the items' shapes and types."""
        return self._ring().init(item)

    def add(self, state: Any, items: Items) -> Any:
        """Adds items [N, ...], N at most the capacity, in place of the oldest."""
        with jax.numpy_rank_promotion("allow"):  # as flashbax is written
            return self._ring().add(state, items)

    def sample(self, state: Any, key: jax.Array) -> Items:
        """Draws items [batch, ...]; the buffer must hold at least one."""
        with jax.numpy_rank_promotion("allow"):
            return self._ring().sample(state, key).experience

    def _ring(self) -> Any:
        return flashbax.make_item_buffer(self.capacity, 1, self.batch, add_batches=True)
