"""Checks of single values: messages name the field, the value and the remedy; what is being traced passes."""

from typing import Any

import jax
import numpy as np

from jaxsand.scene.masked import gaps

_LONGEST = 100  # signs of a value in a message


def concrete(value: object) -> np.ndarray | None:
    """The value as a numpy array (NaN for what is no number), or None if it is being traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        array = np.asarray(gaps(value))
    except TypeError:  # a list with a traced value in it
        return None
    except ValueError:
        return np.full((), np.nan)
    return array if array.dtype.kind in "fiub" else np.full((), np.nan)


def positive(name: str, value: object, remedy: str) -> None:
    """Raises ValueError unless it is one finite number above 0; what is being traced passes."""
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array) and array > 0):
        raise ValueError(f"{name}: got {short(value)}; it must be one finite number above 0: {remedy}")


def finite(name: str, value: object, remedy: str) -> None:
    """Raises ValueError unless it is one finite number; what is being traced passes."""
    array = concrete(value)
    if array is not None and not (array.ndim == 0 and np.isfinite(array)):
        raise ValueError(f"{name}: got {short(value)}; it must be one finite number: {remedy}")


def short(value: Any) -> str:
    """A value as messages show it, on a line: a number as it is, of an array its shape, of anything else its beginning."""
    shape: tuple[int, ...] = getattr(value, "shape", ()) if hasattr(value, "dtype") else ()
    if shape:
        return f"an array of shape {list(shape)}"
    said = " ".join(repr(value).split())
    return said if len(said) <= _LONGEST else said[: _LONGEST - 3] + "..."
