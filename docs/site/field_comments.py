"""Reads the comments ``#: ...`` beside and above fields as their docstrings, for the API page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Gives every attribute without a docstring the comment beside it or above it."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called by griffe for each attribute."""
        if attr.docstring is not None or attr.lineno is None or not isinstance(attr.filepath, Path):
            return
        lines = attr.lines_collection[attr.filepath]
        beside = re.search(r"#: (.*)$", lines[attr.lineno - 1])
        above = re.match(r" *#: (.*)$", lines[attr.lineno - 2])
        if found := beside or above:
            attr.docstring = griffe.Docstring(found[1], parent=attr)
