"""Tells griffe, which reads docstrings for the reference, that `Example:` begins examples, as `Examples:` does."""

import re
from typing import Any

import griffe


class Examples(griffe.Extension):
    """Puts the heading of examples in the plural."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
