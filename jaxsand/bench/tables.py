"""Rows of figures as lines of text."""

from typing import Any

Row = dict[str, Any]
"""What a bench found of one case: figures, None and text by their names, and lists of such rows."""


def as_table(rows: list[Row], title: str) -> list[str]:
    """Rows of figures as lines of text: columns that hold text in any row name the rows, and None is a dash."""
    columns = list(dict.fromkeys(n for row in rows for n in row))
    naming = [n for n in columns if any(isinstance(row.get(n), str) for row in rows)]
    texts = [" ".join(str(row[n]) for n in naming if row.get(n) is not None) for row in rows]
    names = [n for n in columns if n not in naming]
    first = max(len(title), *map(len, texts)) + 2
    wide = {n: max(10, len(n) + 2) for n in names}
    lines = [title.ljust(first) + "".join(n.replace("_", " ").rjust(wide[n]) for n in names)]
    for text, row in zip(texts, rows, strict=True):
        figures = (_figure(row.get(n)) for n in names)
        lines.append(text.ljust(first) + "".join(f.rjust(wide[n]) for f, n in zip(figures, names, strict=True)))
    return lines


def _figure(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return "-" if value is None else f"{value:.4g}"
