"""Searches side by side: what they ask of the simulator at a time is computed in one batch.

A push of sixteen maps takes little longer than one of a single map. A search pushes a few maps at a time, and
looks at them before it goes on; so many searches, each for a goal of its own, go on together. Every search runs in a thread.
What it asks of the simulator waits until all others that have not ended have asked as well. Then the kind of call that most
of them wait for is made, and the others wait until more have come to the same. So the batches do not depend on which thread
is faster; nor do the results, unless a search looks at a clock.
"""

import threading
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from dataclasses import dataclass, field
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxsand.autodiff.while_loop import Tree
from jaxsand.scene.scene import Scene

Found = TypeVar("Found")
_SEARCHES = 64  # side by side at most
_MAPS = 4096  # in a batch at most, but for a single search that asks for more


@dataclass
class _Question:
    """What a search asks: what a function returns for a scene and arrays; and the answer, once it is there."""

    function: Callable[..., Tree]
    scene: Scene
    arrays: tuple[np.ndarray, ...]
    answer: Tree = None
    answered: bool = False

    @property
    def kind(self) -> Hashable:
        """Equal for questions that one batch may answer."""
        leaves, shape = jax.tree.flatten(self.scene)
        numbers = tuple((x.dtype.str, x.shape, x.tobytes()) for x in map(np.asarray, leaves))
        return self.function, shape, numbers, tuple((x.dtype.str, x.shape[1:]) for x in self.arrays)


class _StoppedError(Exception):
    """Another search has failed."""


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
            self.changed.wait_for(lambda: question.answered or self.error is not None)
            if self.error is not None:
                raise _StoppedError
            return question.answer

    def leave(self) -> None:
        """A search has ended; it is not waited for any longer."""
        with self.changed:
            self.running -= 1
            self._answer_if_complete()

    def stop(self, error: BaseException) -> None:
        """Ends all searches at their next question; the first error is kept."""
        if self.error is None and not isinstance(error, _StoppedError):
            self.error = error  # seen without the lock too, which a batch that is being computed holds
        with self.changed:
            self.changed.notify_all()

    def _answer_if_complete(self) -> None:
        if self.error is not None or not self.asked or len(self.asked) < self.running:
            return
        kinds: dict[Hashable, list[int]] = {}
        for who, question in sorted(self.asked.items()):
            kinds.setdefault(question.kind, []).append(who)
        most = max(kinds.values(), key=len)
        maps = np.cumsum([len(self.asked[who].arrays[0]) for who in most])
        try:
            _answer([self.asked.pop(who) for who in most[: max(1, int((maps <= _MAPS).sum()))]])
        except BaseException as error:
            self.error = self.error or error
        self.changed.notify_all()


_PLACE: ContextVar[tuple[_Crowd, int] | None] = ContextVar("place", default=None)


def side_by_side(searches: Sequence[Callable[[], Found]]) -> list[Found]:
    """What each of the searches returns; their calls of `in_one_batch` are answered together, of up to 64 at a time.

    A search sees the caller's context variables, and of JAX's settings for a thread `jax_enable_x64` alone.

    Raises:
      Exception: what the first search that failed has raised; the others then end at their next call.
    """
    if len(searches) < 2:
        return [search() for search in searches]
    parts = [searches[k : k + _SEARCHES] for k in range(0, len(searches), _SEARCHES)]
    return [found for part in parts for found in _together(part)]


def _together(searches: Sequence[Callable[[], Found]]) -> list[Found]:
    crowd = _Crowd(len(searches))
    x64 = jnp.result_type(float) == jnp.float64  # which may hold for this thread alone

    def run(who: int, search: Callable[[], Found]) -> Found:
        _PLACE.set((crowd, who))
        try:
            with jax.enable_x64(x64):
                return search()
        except BaseException as error:
            crowd.stop(error)
            raise
        finally:
            crowd.leave()

    with ThreadPoolExecutor(len(searches)) as pool:  # a thread for each, as all wait for each other
        try:
            ends = [pool.submit(copy_context().run, run, who, search) for who, search in enumerate(searches)]
            return [end.result() for end in ends]
        except BaseException as error:
            crowd.stop(error)
    raise crowd.error or _StoppedError


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
        question.answered = True
