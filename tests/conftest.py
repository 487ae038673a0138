"""float64 is switched on for the laws and orders; what runs in float32 says so. Shapes never promote by accident."""

import math
from collections.abc import Iterator

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

ANGLE = math.radians(29)
MU = math.tan(ANGLE)


@pytest.fixture(autouse=True, scope="module")
def _programs() -> Iterator[None]:
    """Compiled programs are dropped file by file: all of them at once exceed what a process may map."""
    yield
    jax.clear_caches()


@pytest.fixture(params=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> str:
    return request.param
