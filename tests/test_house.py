"""The house's own rules: floors, sizes, and a README that does what it says."""

import ast
import re
from pathlib import Path

import jaxsand

PACKAGE = Path(jaxsand.__file__).parent
README = Path(__file__).parent.parent / "README.md"

# A file imports only from floors below its own, and never from a neighbour. A folder has a floor, and floors inside.
FLOORS = [
    {"grid", "material", "walls", "window", "tool", "lockstep", "limit", "turns", "slices"},
    {"scene", "loop", "fitting"},
    {"bed", "schemes", "forces", "finer"},
    {"flux", "rules", "adjoint"},
    {"sweep"},
    {"around"},
    {"surge", "displace", "mound"},
    {"march"},
    {"levels", "batch", "legs", "shade"},
    {"settling", "stencil", "overflow"},
    {"resting", "frame"},
    {"rested"},
    {"blade"},
    {"block"},
    {"advance", "wheel"},
    {"turning", "lowering"},
    {"rolling"},
    {"push", "swath", "trench"},
    {"roll", "split"},
    {"sim"},
    {"pusher"},
    {"task", "goals", "planner", "plain", "scans", "calibration", "sections", "strokenet"},
    {"strokeloss", "success", "policy"},
    {"sandplan", "optimise", "lookahead"},
    {"stages"},
    {"shaping", "files", "rut", "strokerivals", "gradcheck"},
    {"env"},
    {
        "workprec",
        "methods",
        "stability",
        "complexity",
        "expansions",
        "sandbench",
        "rutbench",
        "strokegoals",
        "calibbench",
        "gradbench",
        "pushbench",
        "letterbench",
        "gym",
    },
    {"analysis", "piles", "strokebench", "envbench"},
    {"render", "rutfigures", "strokefigures", "benchmark"},
    {"commands"},
    {"__main__"},
]
INSIDE = {
    "planner": [
        {"board", "graph"},
        {"bound", "order", "plans", "relaxed", "frontier"},
        {"astar", "paper", "sweepline"},
        {"exact"},
        {"improve"},
        {"anytime"},
    ],
    "sandplan": [{"actions", "reach"}, {"rollouts", "binary"}, {"strokes", "steps", "tasks"}, {"rivals"}],
    "optimise": [{"account", "sketch"}, {"moves"}],
    "env": [{"spaces", "episode", "maps", "pushing"}, {"onmap", "multi"}, {"onsand", "library"}, {"checks"}],
    "commands": [{"printing", "arguments"}, {"shape", "settle", "plan", "trench", "bench"}],
}
HEAVY = {"matplotlib": {"render", "rutfigures", "strokefigures", "goals"}, "PIL": {"render", "goals"}}


def imports(path):
    """Modules of the package, and others, that a file imports anywhere, but for types alone."""
    own, others = set(), set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    types = {
        n
        for test in ast.walk(tree)
        if isinstance(test, ast.If) and "TYPE_CHECKING" in ast.dump(test.test)
        for n in ast.walk(test)
    }
    for node in ast.walk(tree):
        if node in types:
            continue
        names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [f"jaxsand.{a.name}" for a in node.names] if node.module == "jaxsand" else [node.module]
        for name in names:
            head, _, rest = name.partition(".")
            if head == "jaxsand":
                own.add(rest)
            else:
                others.add(head)
    return own, others


def test_every_file_stands_on_a_floor_and_imports_from_below():
    floor = {name: i for i, names in enumerate(FLOORS) for name in names}
    files = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    assert {path.parts[0].removesuffix(".py") for path in files} == set(floor)
    for folder, floors in INSIDE.items():
        inside = {name: i for i, names in enumerate(floors) for name in names} | {"__init__": len(floors)}
        assert {path.stem for path in files if path.parts[0] == folder} == set(inside)
        floor |= {f"{folder}.{name}": floor[folder] + i / 100 for name, i in inside.items()}
    for path in files:
        name = ".".join(path.with_suffix("").parts)
        own, others = imports(PACKAGE / path)
        for other in own:
            inner = other if other in floor else other.split(".")[0]
            outside = inner.split(".")[0] != path.parts[0]
            assert floor[inner] < (int(floor[name]) if outside else floor[name]), f"{name} imports {other}"
        for heavy, allowed in HEAVY.items():
            assert heavy not in others or name in allowed, f"{name} imports {heavy}"


def test_files_stay_small():
    for path in PACKAGE.rglob("*.py"):
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
