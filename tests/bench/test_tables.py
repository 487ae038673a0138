"""Rows of figures as text."""

from jaxsand.bench.tables import as_table


def test_columns_with_text_name_the_rows():
    rows = [{"neighbours": 4, "error": 0.25, "good": True}, {"neighbours": "isotropic", "error": None, "good": False}]
    assert [line.split() for line in as_table(rows, "cone")] == [
        ["cone", "error", "good"],
        ["4", "0.25", "yes"],
        ["isotropic", "-", "NO"],
    ]
