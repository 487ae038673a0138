"""Searches side by side: what they ask of the simulator at a time is computed in one batch.

A push of sixteen maps takes little longer than one of a single map. A search pushes a few maps at a time, and
looks at them before it goes on; so many searches, each for a goal of its own, go on together. Every search runs in a thread.
What it asks of the simulator waits until all others that have not ended have asked as well; then what most of them ask is
answered, and the few wait until more ask the same. So the batches, and with them the results, do not depend on which thread
is faster.
"""

import threading
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.autodiff.while_loop import Tree
from jaxsand.scene.scene import Scene

Found = TypeVar("Found")


@dataclass
class _Question:
    """What a search asks: what a function returns for a scene and arrays; and the answer, once it is there."""

    function: Callable[..., Tree]
    scene: Scene
    arrays: tuple[np.ndarray, ...]
    answer: Tree = None

    @property
    def kind(self) -> Hashable:
        """Equal for questions that one batch may answer."""
        leaves, shape = jax.tree.flatten(self.scene)
        numbers = tuple((x.dtype.str, x.shape, x.tobytes()) for x in map(np.asarray, leaves))
        return self.function, shape, numbers, tuple((x.dtype.str, x.shape[1:]) for x in self.arrays)


@dataclass
class _Crowd:
    """Searches that have not ended, and what those that wait have asked, by their number; the first error ends all."""

    running: int
    asked: dict[int, _Question] = field(default_factory=dict)
    error: BaseException | None = None
    changed: threading.Condition = field(default_factory=threading.Condition)  # re-entrant

    def ask(self, who: int, question: _Question) -> Tree:
        """The answer to what search `who` asks, once all others have asked too, and not more of them something else."""
        with self.changed:
            self.asked[who] = question
            self._answer_if_complete()
            self.changed.wait_for(lambda: question.answer is not None or self.error is not None)
            if self.error is not None:
                raise self.error
            return question.answer

    def leave(self, error: BaseException | None = None) -> None:
        """A search has ended, perhaps by an error; it is not waited for any longer."""
        with self.changed:
            self.running -= 1
            self.stop(error)
            self._answer_if_complete()

    def stop(self, error: BaseException | None) -> None:
        """Lets all that ask from now on raise the error, unless there was one before."""
        with self.changed:
            self.error = self.error or error
            self.changed.notify_all()

    def _answer_if_complete(self) -> None:
        if self.error is not None or not self.asked or len(self.asked) < self.running:
            return
        kinds: dict[Hashable, list[int]] = {}
        for who, question in sorted(self.asked.items()):
            kinds.setdefault(question.kind, []).append(who)
        try:
            _answer([self.asked.pop(who) for who in max(kinds.values(), key=len)])
        except BaseException as error:
            self.error = error
        self.changed.notify_all()


_PLACE: ContextVar[tuple[_Crowd, int] | None] = ContextVar("place", default=None)


def side_by_side(searches: Sequence[Callable[[], Found]]) -> list[Found]:
    """What each of the searches returns; their calls of `in_one_batch` are answered together.

    Raises:
      Exception: what the first search that failed has raised; the others then end at their next call.
    """
    if len(searches) < 2:
        return [search() for search in searches]
    crowd = _Crowd(len(searches))
    x64 = jnp.result_type(float) == jnp.float64  # which may hold for this thread alone

    def run(who: int, search: Callable[[], Found]) -> Found:
        _PLACE.set((crowd, who))
        try:
            with jax.enable_x64(x64):
                found = search()
        except BaseException as error:
            crowd.leave(error)
            raise
        crowd.leave()
        return found

    with ThreadPoolExecutor(len(searches)) as pool:  # a thread for each, as all wait for each other
        ends = [pool.submit(run, who, search) for who, search in enumerate(searches)]
        try:
            return [end.result() for end in ends]
        except BaseException as error:
            crowd.stop(error)
            raise


def in_one_batch(function: Callable[..., Tree], scene: Scene, *arrays: np.ndarray) -> Tree:
    """`function(scene, *arrays)`, in one batch with what the searches beside this one ask; at once where there are none.

    Args:
      function: one of a scene and of arrays [B, ...] that returns a pytree of arrays [B, ...], every map by itself; the same
        in every call.
      scene: the scene of all maps.
      *arrays: [B, ...].
    """
    place = _PLACE.get()
    if place is None:
        return function(scene, *arrays)
    crowd, who = place
    return crowd.ask(who, _Question(function, scene, arrays))


def _answer(alike: list[_Question]) -> None:
    """Answers questions of one kind by one call."""
    together = map(np.concatenate, zip(*(question.arrays for question in alike), strict=True))
    found = jax.tree.map(np.asarray, alike[0].function(alike[0].scene, *together))
    end = 0
    for question in alike:
        begin, end = end, end + len(question.arrays[0])
        question.answer = jax.tree.map(lambda x, part=slice(begin, end): x[part], found)
