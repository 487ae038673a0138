"""What the site adds to its pages when mkdocs builds it: the reference, the notebooks' outputs, reports, formulas, pictures.

Pages name pictures and notebooks by their place in the repository (`../../pictures/x.png`, `../../settling.ipynb`), so that
their links work there too; on the site both lie one folder higher.
"""

import ast
import hashlib
import html
import json
import os
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
CACHE = HERE.parent / "build" / "notebooks"
ROOMS = {  # rooms of the package with public names, and what else is public in them
    "scene": ("Scene", ("jaxsand.scene.bearing", "jaxsand.scene.soil")),
    "relaxation": ("Relaxation", ()),
    "interaction": ("Interaction", ()),
    "terramechanics": (
        "Terramechanics",
        ("jaxsand.terramechanics.cutting", "jaxsand.terramechanics.force_trace", "jaxsand.terramechanics.wheel_trench"),
    ),
    "goals": ("Goals", ("jaxsand.goals.metrics",)),
    "planning": ("Planning", ()),
    "envs": ("Environments", ("jaxsand.envs",)),
    "viz": ("Pictures", ()),
}
LAYERS = (
    "cli",
    "bench",
    "viz",
    "envs",
    "planning",
    "terramechanics",
    "goals",
    "interaction",
    "relaxation",
    "scene",
    "autodiff",
)
NOT_REPORTS = ("map", "work_precision", "strokes_curves", "ramp_maps")  # long lists that are drawn and not read


def reference_pages() -> dict[str, str]:
    """A page for each room with the public names of `import jaxsand as js` that live there, and one that lists them all."""
    import jaxsand

    pages, rows = {}, []
    for room, (title, modules) in ROOMS.items():
        names = [name for name, home in jaxsand._HOMES.items() if home.partition(".")[0] == room]
        about = ast.get_docstring(ast.parse((HERE.parent / "jaxsand" / room / "__init__.py").read_text(encoding="utf-8")))
        lines = [f"# {title}", "", (about or "").split("\n\n")[0], ""]
        lines += [f"::: jaxsand.{name}\n" for name in names]
        for module in modules:
            lines += [f"::: {module}\n    options:\n      show_root_full_path: true\n"]
        pages[f"reference/{room}.md"] = "\n".join(lines)
        shown = [f"[`{name}`]({room}.md#jaxsand.{name})" for name in names] + [
            f"[`{module}`]({room}.md#{module})" for module in modules
        ]
        rows.append(f"| [{title}]({room}.md) | {', '.join(shown)} |")
    about = "Every public name of `import jaxsand as js`, and public modules, by the room of the package that they live in."
    pages["reference/index.md"] = "\n".join(["# Reference", "", about, "", "| room | names |", "|---|---|", *rows, ""])
    return pages


def notebook_pages() -> list[str]:
    """The pages that the notebooks become."""
    return [f"notebooks/{path.stem}.md" for path in sorted(HERE.glob("*.ipynb"))]


def report_page(report: dict[str, Any]) -> str:
    """A report that `jaxsand bench` wrote, as a part of a page: what was run where and when, then its tables."""
    facts = ["command", "machine", "commit", "date"]
    lines = ["| | |", "|---|---|", *(f"| {fact} | {_cell(report[fact])} |" for fact in facts if report.get(fact)), ""]
    for name, rows in report.items():
        if name in NOT_REPORTS or not (isinstance(rows, list) and rows and all(isinstance(row, dict) for row in rows)):
            continue
        columns = list(dict.fromkeys(column for row in rows for column in row))
        lines += [f"### {name.replace('_', ' ')}", "", f"| {' | '.join(c.replace('_', ' ') for c in columns)} |"]
        lines += ["|" + "---|" * len(columns)]
        lines += [f"| {' | '.join(_cell(row.get(column)) for column in columns)} |" for row in rows]
        lines += [""]
    return "\n".join(lines)


def rooms_drawing() -> str:
    """Which room imports which, as an arc from each room down to those that it imports; SVG."""
    arcs, texts, step, left = [], [], 34, 150
    for above, room in enumerate(LAYERS):
        y = step * (above + 1)
        texts.append(f'<circle cx="{left}" cy="{y}" r="4"/>')
        texts.append(f'<text x="{left - 14}" y="{y + 5}" text-anchor="end">{room}</text>')
        for other in sorted(_imported(HERE.parent / "jaxsand" / room) - {room}):
            below = LAYERS.index(other)
            far, colour = abs(below - above) * step / 2, "#8d6e63" if below > above else "#d50000"
            arcs.append(
                f'<path d="M {left + 4} {y} A {far} {far} 0 0 {int(below > above)} {left + 8} {step * (below + 1)}" '
                f'stroke="{colour}" marker-end="url(#tip)"/>'
            )
    size = f'width="360" height="{step * (len(LAYERS) + 1)}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="15"><defs>'
        '<marker id="tip" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto">'
        '<path d="M 6 0 L 0 3 L 6 6 z" fill="#8d6e63"/></marker></defs><rect width="100%" height="100%" fill="#fafafa"/>'
        f'<g fill="none" opacity="0.7">{"".join(arcs)}</g><g fill="#3e2723">{"".join(texts)}</g></svg>'
    )


def _imported(room: Path) -> set[str]:
    """The rooms from which a room's files import."""
    trees = [ast.walk(ast.parse(path.read_text(encoding="utf-8"))) for path in room.rglob("*.py")]
    modules = [node.module or "" for tree in trees for node in tree if isinstance(node, ast.ImportFrom)]
    return {module.split(".")[1] for module in modules if module.startswith("jaxsand.")}


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value).replace("|", "\\|")


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages that are made, and the pictures."""
    from mkdocs.structure.files import File

    for uri, text in reference_pages().items():
        files.append(File.generated(config, uri, content=text))
    files.append(File.generated(config, "rooms.svg", content=rooms_drawing()))
    for path in sorted((HERE / "pictures").glob("*.png")):
        files.append(File.generated(config, f"pictures/{path.name}", abs_src_path=str(path)))
    for uri in notebook_pages():
        page, pictures = executed(HERE / f"{Path(uri).stem}.ipynb", config.extra["notebooks"])
        files.append(File.generated(config, uri, content=page))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Puts links to pictures and notebooks right, and a benchmark's report under its page."""
    markdown = re.sub(r"\]\(\.\./((?:\.\./)*)pictures/", r"](\1pictures/", markdown)
    markdown = re.sub(r"\]\(\.\./((?:\.\./)*)(\w+)\.ipynb", r"](\1notebooks/\2.md", markdown)
    section, _, name = page.file.src_uri.rpartition("/")
    report = HERE / "site" / "results" / f"bench-{Path(name).stem}.json"
    if section == "results" and report.exists():
        drawn = sorted(report.parent.glob(f"{report.stem}*.png"))
        pictures = "\n\n".join(f"![{path.stem}]({path.name})" for path in drawn)
        body = report_page(json.loads(report.read_text(encoding="utf-8")))
        markdown += f"\n\n## The latest report\n\n{body}\n\n{pictures}\n\n[The report itself]({report.name})\n"
    return markdown


def on_page_content(content: str, page: Any, config: Any, files: Any) -> str:
    """Formulas become MathML, which browsers draw by themselves."""
    from latex2mathml.converter import convert
    from mkdocs.exceptions import PluginError

    def drawn(found: re.Match[str]) -> str:
        display = "block" if found[1] == "div" else "inline"
        formula = convert(html.unescape(found[2]).strip(), display=display)
        if "\\" in formula:
            raise PluginError(f"{page.file.src_uri}: {found[2]!r} holds a command of TeX that does not become MathML")
        return formula

    return re.sub(r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', drawn, content, flags=re.DOTALL)


def executed(notebook: Path, size: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown with the outputs of a run, and its pictures by name; kept until it or the code changes."""
    source = notebook.read_text(encoding="utf-8").replace('SIZE = \\"full\\"', f'SIZE = \\"{size}\\"')
    state = hashlib.sha256(source.encode())
    for folder in ("jaxsand", "train"):
        for path in sorted((HERE.parent / folder).rglob("*.py")):
            state.update(path.read_bytes())
    kept = CACHE / f"{notebook.stem}-{state.hexdigest()[:16]}"
    if not (kept / "page.md").exists():
        _execute(source, notebook.stem, size, kept)
    pictures = {path.name: path.read_bytes() for path in sorted(kept.glob("*.png"))}
    return (kept / "page.md").read_text(encoding="utf-8"), pictures


def _execute(source: str, name: str, size: str, kept: Path) -> None:
    import nbformat
    from mkdocs.exceptions import PluginError
    from nbconvert import MarkdownExporter
    from nbconvert.preprocessors import ExecutePreprocessor

    notebook = nbformat.reads(source, as_version=4)
    os.environ.setdefault("PYDEVD_DISABLE_FILE_VALIDATION", "1")
    ExecutePreprocessor(timeout=3600).preprocess(notebook, {"metadata": {"path": str(HERE)}})
    resources = {"unique_key": name, "output_files_dir": ""}
    page, resources = MarkdownExporter().from_notebook_node(notebook, resources)
    if "<Figure size" in page:
        raise PluginError(f"{name}.ipynb: a figure is told and not drawn; call plt.show() once before it")
    title, _, rest = page.strip().partition("\n")
    note = f"The outputs below were made when this site was built, at size `{size}`, by `notebooks/{name}.ipynb`."
    kept.mkdir(parents=True, exist_ok=True)
    for file, content in resources["outputs"].items():
        (kept / Path(file).name).write_bytes(content)
    (kept / "page.md").write_text(f"{title}\n\n*{note}*\n{rest}\n", encoding="utf-8")
