"""The house's own rules: floors, sizes, and a README that does what it says."""

import ast
import re
from pathlib import Path

import jaxsand

PACKAGE = Path(jaxsand.__file__).parent
README = Path(__file__).parent.parent / "README.md"

# A file imports only from floors below its own; on floors 5 and 6 no neighbours either.
FLOORS = [
    {"grid", "material", "walls", "window", "tool", "loop"},
    {"scene"},
    {"bed", "schemes"},
    {"flux", "rules"},
    {"sweep"},
    {"march", "displace"},
    {"levels", "batch", "legs"},
    {"settling"},
    {"push", "swath"},
    {"sim"},
    {"task", "goals", "planner", "plain"},
    {"shaping", "files"},
    {"workprec", "stability"},
    {"analysis", "piles"},
    {"render", "benchmark"},
    {"commands"},
    {"__main__"},
]
HEAVY = {"matplotlib": {"render", "goals"}, "PIL": {"render", "goals"}}


def imports(path):
    """Modules of the package, and others, that a file imports anywhere."""
    own, others = set(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"jaxsand.{a.name}" for a in node.names] if node.module == "jaxsand" else [node.module]
        for name in names:
            head, _, rest = name.partition(".")
            if head == "jaxsand":
                own.add(rest.split(".")[0])
            else:
                others.add(head)
    return own, others


def test_every_file_stands_on_a_floor_and_imports_from_below():
    floor = {name: i for i, names in enumerate(FLOORS) for name in names}
    files = {path.stem: path for path in PACKAGE.glob("*.py") if path.stem != "__init__"}
    assert set(files) == set(floor)
    for name, path in files.items():
        own, others = imports(path)
        for other in own:
            assert floor[other] < floor[name], f"{name} imports {other}"
        for heavy, allowed in HEAVY.items():
            assert heavy not in others or name in allowed, f"{name} imports {heavy}"


def test_files_stay_small():
    for path in PACKAGE.glob("*.py"):
        lines = len(path.read_text(encoding="utf-8").splitlines())
        assert lines <= 300, f"{path.name}: {lines} lines"


def test_no_module_hides_a_public_function():
    assert not {path.stem for path in PACKAGE.glob("*.py")} & set(jaxsand.__all__)


def test_public_functions_say_what_they_do():
    for name in jaxsand.__all__:
        assert getattr(jaxsand, name).__doc__, name


def test_the_readme_runs():
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    assert names["batch"].shape == (64, 32, 32)
    assert float(abs(names["slope"]).max()) > 0
