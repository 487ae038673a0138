"""The README and the site do what they say: links lead somewhere, code runs, commands are understood, nothing is left out."""

import importlib.util
import inspect
import json
import re
import shlex
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxsand
from jaxsand.cli import parser as cli
from train import __main__ as learners

ROOT = Path(__file__).parent.parent
NOTEBOOKS = ROOT / "notebooks"
SITE = NOTEBOOKS / "site"
README = ROOT / "README.md"
PAGES = sorted(SITE.rglob("*.md"))
BLOCK = re.compile(r"(?:<!-- (slow|torch) -->\n)?^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)

pytestmark = pytest.mark.skipif(not SITE.exists(), reason="no site beside the tests")


def named(path):
    return path.relative_to(ROOT).as_posix()


def blocks(path, language):
    """The code blocks of a page in a language, each with whether it is slow; those that need torch are left out."""
    found = BLOCK.findall(path.read_text(encoding="utf-8"))
    return [(mark == "slow", code) for mark, kind, code in found if kind == language and mark != "torch"]


def runnable(slow):
    """Pages with code that runs among the fast tests, or among the slow ones alone."""
    pages = [path for path in [README, *PAGES] if path.exists()]
    return [p for p in pages if any(not slow or late for late, _ in blocks(p, "python")) and blocks(p, "python")]


@pytest.fixture(scope="module")
def hooks():
    spec = importlib.util.spec_from_file_location("hooks", NOTEBOOKS / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(path, slow):
    """Runs a page's blocks one after the other, as its reader would, but for the slow ones unless `slow`."""
    names = {"__name__": "__main__"}
    with jax.enable_x64(False):
        for late, code in blocks(path, "python"):
            if slow or not late:
                exec(compile(code, named(path), "exec"), names)
    return names


LONG = ("README.md", "environments.md", "landing-pad.md", "pit-and-heap.md", "sampling-trench.md", "tools.md")


def marked(path):
    """A page by its marks: those that compile many programs are for the wide tests; `.ci/run` runs the README's, too."""
    return pytest.param(path, marks=pytest.mark.wide if path.name in LONG else ())


@pytest.mark.parametrize("path", [marked(path) for path in runnable(slow=False)], ids=named)
def test_code_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(path, slow=False)
    if path == README:
        assert names["batch"].shape == (16, 32, 32)
        assert float(abs(names["slope"]).max()) > 0


def test_gradients_go_through_sand_inside_a_torch_model():
    pytest.importorskip("torch")
    (code,) = (code for mark, _, code in BLOCK.findall((SITE / "guides" / "files.md").read_text()) if mark == "torch")
    names: dict[str, Any] = {}
    with jax.enable_x64(False):
        exec(compile(code, "files.md", "exec"), names)
        stroke = jax.numpy.asarray(names["stroke"].detach().numpy())
        slope = jax.grad(lambda s: (names["left"](jax.numpy.zeros((32, 32)), s) ** 2).sum())(stroke)
    np.testing.assert_allclose(names["stroke"].grad, slope, rtol=1e-4)
    assert abs(slope).max() > 0


def test_drawings_are_understood():
    shown = [json.loads(code) for path in [README, *PAGES] for _, code in blocks(path, "json")]
    for drawing in shown:
        sheet = drawing["grid"]
        assert jaxsand.read_drawing(drawing | {"repose": False}, jaxsand.make_scene(sheet["shape"], sheet["spacing"]))
    assert shown


@pytest.mark.pages
@pytest.mark.parametrize("path", runnable(slow=True), ids=named)
def test_slow_code_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(path, slow=True)


def commands(path):
    """What a page's shell blocks and its text tell the reader to type, by words; a command's bare name is only named."""
    lines = [line.split("&&")[-1].strip() for _, code in blocks(path, "sh") for line in code.splitlines()]
    lines += re.findall(r"`((?:jaxsand|python -m train)[ .]\w+ [^`]+)`", path.read_text(encoding="utf-8"))
    return [shlex.split(line.removeprefix(".venv/bin/")) for line in lines]


def test_commands_are_understood():
    understood = 0
    for path in [README, *PAGES]:
        for words in commands(path):
            if words[:1] == ["jaxsand"]:
                parser, arguments = cli._parser(), words[1:]
            elif words[:3] == ["python", "-m", "train"]:
                parser, arguments = learners._parser(), words[3:]
            elif words[:2] == ["python", "-m"] and words[2].startswith("train."):
                assert importlib.util.find_spec(words[2]), f"{named(path)}: no module {words[2]}"
                continue
            else:
                continue
            try:
                parser.parse_args([{"K": "4", "WHAT": "all"}.get(word, word) for word in arguments])
            except SystemExit:
                pytest.fail(f"{named(path)}: {' '.join(words)!r} is no command")
            understood += 1
    assert understood > 30


def anchors(text):
    """The anchors of a page's headings, as mkdocs makes them, and those given by hand."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    made = {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title.replace("`", "")).strip().lower()) for title in titles}
    return made | {f"jaxsand.{name}" for name in re.findall(r"^::: jaxsand\.(\S+)", text, re.MULTILINE)}


def test_links_lead_somewhere(hooks):
    made = {SITE / uri: text for uri, text in hooks.reference_pages().items()}
    texts = {path: path.read_text(encoding="utf-8") for path in [README, *PAGES]} | made
    for path, text in texts.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if target.startswith(("http://", "https://")) or target == "rooms.svg":
                continue
            name, _, anchor = target.partition("#")
            there = (path.parent / name).resolve() if name else path
            assert there in texts or there.exists(), f"{named(path)}: {target} is not there"
            assert not anchor or anchor in anchors(texts[there]), f"{named(path)}: {target} has no such heading"


def test_pages_in_the_menu_exist_and_all_are_in_it(hooks):
    menu = set(re.findall(r"(\S+\.md)$", (NOTEBOOKS / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE))
    written = {path.relative_to(SITE).as_posix() for path in PAGES}
    assert menu == written | set(hooks.reference_pages()) | set(hooks.notebook_pages())


def test_every_public_name_is_in_the_reference(hooks):
    pages = "\n".join(hooks.reference_pages().values())
    assert sorted(re.findall(r"^::: jaxsand\.(\w+)$", pages, re.MULTILINE)) == sorted(
        [*jaxsand.__all__, "envs"]
    )  # envs: the room as a whole


def test_documented_arguments_are_those_of_the_function():
    for name in jaxsand.__all__:
        function = getattr(jaxsand, name)
        if inspect.isfunction(function):
            section = re.search(r"^Args:\n((?:  .*\n|\n)*)", f"{inspect.getdoc(function)}\n", re.MULTILINE)
            indent = re.match(r" *", section[1])[0] if section else ""
            told = re.findall(rf"^{indent}(\w+(?:, \w+)*): ", section[1] if section else "", re.MULTILINE)
            unknown = set(", ".join(told).split(", ")) - {"", *inspect.signature(function).parameters}
            assert not unknown, f"{name}: {unknown}"


def test_a_report_becomes_tables(hooks):
    rows = [{"name": "one | two", "seconds": 0.123456}, {"name": "three", "seconds": 12345.6, "error": None}]
    report = {"command": "jaxsand bench push", "machine": "M", "commit": None, "date": "2026-01-02", "map": [32, 32]}
    page = hooks.report_page(json.loads(json.dumps(report | {"push_speed": rows})))
    assert "| command | jaxsand bench push |" in page
    assert "commit" not in page
    assert "### push speed" in page
    assert "| one \\| two | 0.1235 |  |\n| three | 12,346 |  |" in page


def test_rooms_import_downwards_in_the_drawing(hooks):
    drawing = hooks.rooms_drawing()
    assert drawing.count("marker-end") > 20
    assert "#d50000" not in drawing
    assert all(f">{room}</text>" in drawing for room in ("cli", "scene", "autodiff"))


def test_files_that_are_named_exist():
    """Whole names from the top or from the package, or a file's own name below one of these."""
    bare = {path.name for folder in ("jaxsand", "train", "tests", "notebooks") for path in (ROOT / folder).rglob("*.py")}
    named_files = 0
    for path in [README, *PAGES]:
        for name in re.findall(r"`((?:\w+/)*\w+\.(?:py|yml|npz))`", path.read_text(encoding="utf-8")):
            assert name in bare or (ROOT / name).exists() or (ROOT / "jaxsand" / name).exists(), f"{named(path)}: {name}"
            named_files += 1
    assert named_files > 40


def test_the_readme_is_short_and_has_code():
    assert blocks(README, "python")
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150


def test_the_walk_is_short():
    walk = (SITE / "architecture.md").read_text(encoding="utf-8").split("## A walk\n")[1].split("\n## ")[0]
    assert len(walk.split()) < 300


def test_nothing_is_fetched_from_a_network():
    settings = (NOTEBOOKS / "mkdocs.yml").read_text(encoding="utf-8")
    assert "font: false" in settings
    assert "http" not in settings
    assert not re.search(r"<(script|link|img|iframe)[^>]*http", "\n".join(p.read_text(encoding="utf-8") for p in PAGES))


def test_derivations_that_the_code_points_to_are_there():
    """A module names a page of the theory, and in brackets and quotes the headings that it means."""
    told = 0
    for path in [*(ROOT / "jaxsand").rglob("*.py")]:
        text = " ".join(path.read_text(encoding="utf-8").split())
        for page, said in re.findall(r"notebooks/(site/theory/[\w-]+\.md)( \([^)]*\))?", text):
            headings = re.findall(r"^#+ (.*)$", (NOTEBOOKS / page).read_text(encoding="utf-8"), re.MULTILINE)
            for heading in re.findall(r'"([^"]*)"', said):
                assert heading in headings, f"{path}: {heading} of {page}"
                told += 1
    assert told
