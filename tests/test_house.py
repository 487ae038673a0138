"""The house's own rules: what may be imported where, and what its public names say."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import jaxsand

PACKAGE = Path(jaxsand.__file__).parent

HEAVY = {
    "matplotlib": {"viz.render", "viz.trenches", "viz.strokes", "viz.side", "goals.surfaces"},
    "PIL": {"viz.render", "viz.loads", "goals.letters"},
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
    assert seen == {name: f"jaxsand.{home}" for name, home in jaxsand._HOMES.items()}
    assert jaxsand.__version__[0].isdigit()


def test_no_module_hides_a_public_function():
    assert not {path.stem for path in PACKAGE.iterdir()} & set(jaxsand.__all__)


def test_public_functions_say_what_they_do():
    for name in jaxsand.__all__:
        assert getattr(jaxsand, name).__doc__, name


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
