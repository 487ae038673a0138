"""The examples in the docstrings of public names, and of the loop that all is built on, give what they say."""

import doctest
import inspect
from collections.abc import Iterator

import jax
import pytest

import jaxsand as js
from jaxsand.autodiff.while_loop import repeat_until
from jaxsand.terramechanics import forces

FORCES = {f"forces.{name}": getattr(js.forces, name) for name in forces.__all__}
PUBLIC = {name: getattr(js, name) for name in sorted(js.__all__)} | FORCES
EXAMPLES = {name: obj for name, obj in PUBLIC.items() if inspect.isroutine(obj) or inspect.isclass(obj)}


@pytest.fixture(autouse=True)
def _in_float32() -> Iterator[None]:
    """As users run them."""
    with jax.enable_x64(False):
        yield


def run(name: str, obj: object) -> tuple[int, str]:
    """The number of examples in a docstring, and a report of those that fail."""
    report: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    tests = doctest.DocTestFinder().find(obj, name, globs={})
    for test in tests:
        runner.run(test, out=report.append)
    return sum(len(test.examples) for test in tests), "".join(report)


@pytest.mark.parametrize("name", [*EXAMPLES, "repeat_until"])
def test_the_example_runs(name):
    examples, report = run(name, EXAMPLES.get(name, repeat_until))
    assert examples, f"{name} has no example"
    assert not report, report


def test_a_wrong_example_is_found():
    def wrong():
        """One and one.

        Example:
            >>> 1 + 1
            3
        """

    examples, report = run("wrong", wrong)
    assert examples == 1
    assert "Got:\n    2" in report
