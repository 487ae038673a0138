"""Rows of figures as lines of text."""

from typing import Any


def as_table(rows: list[dict[str, Any]], title: str) -> list[str]:
    """Rows of figures as lines of text: what is text in a row names it, and None is a dash."""
    texts = [" ".join(v for v in row.values() if isinstance(v, str)) for row in rows]
    names = [n for n in dict.fromkeys(n for row in rows for n in row) if not isinstance(rows[0].get(n), str)]
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
