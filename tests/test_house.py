"""The house's own rules: what may be imported where, and what its public names say."""

import ast
import inspect
import os
import re
import subprocess
import sys
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import pytest

import jaxsand

PACKAGE = Path(jaxsand.__file__).parent

HEAVY = {
    "matplotlib": {
        "viz.render",
        "viz.trenches",
        "viz.strokes",
        "viz.terminal",
        "viz.history",
        "viz.side",
        "viz.gallery",
        "viz.plot",
        "goals.surfaces",
    },
    "PIL": {"viz.render", "viz.loads", "goals.letters", "goals.files"},
}


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
            names += [f"{node.module}.{a.name}" for a in node.names if a.name.startswith("_")]
        for name in names:
            head, _, rest = name.partition(".")
            if head == "jaxsand":
                own.add(rest)
            else:
                others.add(head)
    return own, others


def test_what_is_heavy_or_private_is_imported_where_it_belongs():
    """Which room may import from which is kept by import-linter; see pyproject.toml."""
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        own, others = imports(path)
        for heavy, allowed in HEAVY.items():
            assert heavy not in others or name in allowed, f"{name} imports {heavy}"
        for other in own:
            room, _, module = other.rpartition(".")
            assert not module.startswith("_") or name.startswith(room), f"{name} imports {other}"


def test_what_type_checkers_see_is_what_is_there():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {a.asname: f"{node.module}" for node in block.body if isinstance(node, ast.ImportFrom) for a in node.names}
    modules = {name for name, home in seen.items() if home == "jaxsand"}
    assert sorted(modules) == sorted(jaxsand._OTHER_NAMES)
    homes = {name: f"jaxsand.{home}" for name, home in jaxsand._HOMES.items()}
    assert seen == homes | dict.fromkeys(modules, "jaxsand")
    assert not any(isinstance(node, ast.FunctionDef) and node.name == "__getattr__" for node in tree.body)
    assert jaxsand.__version__[0].isdigit()


@pytest.mark.slow
def test_misspelt_names_do_not_pass_type_checkers(tmp_path):
    pytest.importorskip("mypy")
    (tmp_path / "user.py").write_text(
        "import jaxsand as js\nreveal_type(js.step)\nreveal_type(js.task.iou)\njs.stpe\njs.task.iuo\njs.settle(0)\n"
    )
    command = [sys.executable, "-m", "mypy", "--config-file=", "--ignore-missing-imports", "--follow-imports=silent"]
    environment = os.environ | {"MYPYPATH": str(PACKAGE.parent)}
    done = subprocess.run(
        [*command, f"--cache-dir={tmp_path / 'cache'}", "user.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    told = {int(line.split(":")[1]): line for line in done.stdout.splitlines() if line.startswith("user.py:")}
    assert "def (scene: jaxsand.scene.scene.Scene" in told[2]
    assert 'Revealed type is "def (' in told[3]
    assert 'has no attribute "stpe"' in told[4]
    assert 'has no attribute "iuo"' in told[5]
    assert 'expected "Scene"' in told[6]


def test_aliases_hold_what_they_say_and_no_more():
    """Nothing that their homes import, such as numpy, is offered under the package's own names."""
    for alias in ("env", "forces", "task", "tasks", "trench", *(["gym"] if find_spec("gymnasium") else [])):
        module = getattr(jaxsand, alias)
        scope = {}
        exec(f"from jaxsand.{alias} import *", scope)
        names = set(scope) - {"__builtins__"}
        home = sys.modules["jaxsand.envs" if alias == "env" else "jaxsand.terramechanics.forces"]
        assert names == set(getattr(module, "__all__", home.__all__)), alias
        for name in names:
            value = getattr(module, name)
            assert not inspect.ismodule(value), f"{alias}.{name}"
            assert getattr(value, "__module__", "jaxsand").startswith(("jaxsand", "builtins")), f"{alias}.{name}"
        assert {name for name in vars(module) if not name.startswith("_")} == names, alias


def test_no_module_hides_a_public_function():
    assert not {path.stem for path in PACKAGE.iterdir()} & set(jaxsand.__all__)


def test_public_functions_say_what_they_do():
    for name in jaxsand.__all__:
        assert getattr(jaxsand, name).__doc__, name


def without_docstrings(node, prefix=""):
    """The functions in a module or class that bear no underscore, and say nothing of what they do."""
    for part in node.body:
        if isinstance(part, ast.ClassDef) and not part.name.startswith("_"):
            yield from without_docstrings(part, f"{prefix}{part.name}.")
        if isinstance(part, ast.FunctionDef) and not part.name.startswith("_") and not ast.get_docstring(part):
            yield from [] if any("overload" in ast.unparse(d) for d in part.decorator_list) else [prefix + part.name]


def test_every_function_that_others_call_says_what_it_does():
    for path in [*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "train").rglob("*.py")]:
        assert not [*without_docstrings(ast.parse(path.read_text(encoding="utf-8")))], path


def test_nothing_tells_to_run_the_learners_without_saying_where_they_are():
    """`pip install jaxsand` has no `train`: who is told to run it must be told that a checkout of the repository has it."""
    told = 0
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and "python -m train" in node.value:
                told += 1
                assert "checkout" in node.value, f"{path}: {node.value}"
    assert told


FORBIDDEN = {"march", "surge"}  # private words for what the field has a name for


def words(tree):
    """The words of every name that a file defines or uses: `batch_of_maps` and `BatchOfMaps` have three."""
    for node in ast.walk(tree):
        for name in (getattr(node, field, None) for field in ("name", "id", "attr", "arg")):
            if isinstance(name, str):
                yield from (word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name))


def test_the_code_uses_the_words_of_the_field():
    for path in PACKAGE.rglob("*.py"):
        used = {word.removesuffix("s") for word in words(ast.parse(path.read_text(encoding="utf-8")))}
        assert not used & FORBIDDEN, f"{path}: {used & FORBIDDEN}"


def test_derivatives_of_loops_are_called_jvp_and_vjp():
    """A push is what a tool does to the sand."""
    for room in ("autodiff", "relaxation", "interaction"):
        for path in (PACKAGE / room).rglob("*.py"):
            defined = {
                n.name for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.FunctionDef)
            }
            assert not defined & {"push", "pull"}, path


def test_a_class_has_a_name_of_its_own():
    homes = defaultdict(list)
    for path in PACKAGE.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(str(path.relative_to(PACKAGE)))
    assert not {name: where for name, where in homes.items() if len(where) > 1}
