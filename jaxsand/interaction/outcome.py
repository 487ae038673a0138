"""Turns what a result says of itself into an error with advice."""

import numpy as np

from jaxsand.interaction._path import Pushed
from jaxsand.relaxation.settling import Settled
from jaxsand.relaxation.stopping import Outcome
from jaxsand.scene.validation import concrete


class OutcomeError(RuntimeError):
    """The error that `check` raises; its message says what is wrong with a result and what to do.

    Example:
        >>> import jaxsand as js
        >>> issubclass(js.OutcomeError, RuntimeError)
        True
    """


_ADVICE = {
    Outcome.WINDOW_EDGE: (
        "sand moved at the window's edge, or the map was not still before the tool came down: enlarge Window(size) or use "
        "Whole(), and settle to the window's tolerance first"
    ),
    Outcome.NOT_STILL: (
        "the sand is not still ({residual:.2g} in slope above repose after {sweeps} sweeps): raise the stop rule's bound or "
        "tolerance, or, where heights are large against the spacing, subtract their mean or use float64"
    ),
    Outcome.NOT_FINITE: (
        "the map, the stroke or the scene holds a NaN or an infinity, heights overflowed, or a leg leads straight up or "
        "down: look with numpy.isfinite, and give every leg with heights a length"
    ),
    Outcome.NOT_POURED: (
        "less sand was poured or removed than asked for: ask for at most load_volume(scene, load), or what lies on the "
        "base, and pour onto cells with sand"
    ),
    Outcome.BELOW_BASE: (
        "the map lies below the scene's base somewhere, where no sand can be: start from jnp.maximum(height, base)"
    ),
    Outcome.NOT_CARRIED: (
        "the soil does not carry the wheel before it stands in it up to its axle: lighten it, or give a larger wheel or a "
        "firmer soil"
    ),
}


def check(result: Settled | Pushed) -> None:
    """Raises an error with advice if a computation did not end well.

    Call it on results outside `jit`, `vmap` and `grad`: inside, outcomes are not known yet.

    Args:
        result: what `settle`, `step`, `follow`, `rollout`, `act` or their batches returned.

    Raises:
        OutcomeError: the outcome of the result, or of any in a batch, is not 0; see `Outcome`.
        ValueError: the result is being traced, or is none.

    Example:
        >>> import jax.numpy as jnp
        >>> import jaxsand as js
        >>> heap = jnp.zeros((8, 8)).at[4, 4].set(0.03)
        >>> js.check(js.settle(js.make_scene((8, 8), 0.01), heap, stop=js.Sweeps(8)))
        Traceback (most recent call last):
            ...
        jaxsand.interaction.outcome.OutcomeError: the sand is not still (...
    """
    if not isinstance(result, Settled | Pushed):
        raise ValueError(f"result: got {type(result).__name__}; give what settle, step or another push returned")
    outcome = concrete(result.outcome)
    if outcome is None:
        raise ValueError("result: got a traced value; call check outside jit, vmap and grad")
    bad = np.flatnonzero(outcome.ravel())
    if not bad.size:
        return
    first = bad[0]
    code = Outcome(int(outcome.ravel()[first]))
    detail = {}
    if isinstance(result, Settled):
        detail["residual"] = float(np.ravel(result.residual)[first])
        detail["sweeps"] = int(np.broadcast_to(result.sweeps, outcome.shape).ravel()[first])
    where = f"{bad.size} of {outcome.size} maps, first {int(first)}: " if outcome.ndim else ""
    raise OutcomeError(where + "; ".join(advice.format(**detail) for bit, advice in _ADVICE.items() if bit in code))
