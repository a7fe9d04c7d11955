"""Which functions lay out a part of a result, by what they say that they return, and how long they are."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from .rooms import PACKAGE

# Where results are laid out, and what of that knows of no result: the words of it, and what renders it
ROOMS = ("present", "cli", "api")
OF_NO_RESULT = {
    "document",
    "numbers",
    "page",
    "terminal",
    "figure_style",
}
PARTS = {
    "Document", "Section", "Item", "Answer", "Sentence", "Table", "Cell", "Number", "Numbers", "Commands", "Facts",
    "Figures", "Picture", "Text", "RenderableType",
}  # fmt: skip


class LayoutFunction(NamedTuple):
    """One, with where it stands and its lines."""

    path: Path
    name: str
    lines: int


def layout_functions() -> Iterator[LayoutFunction]:
    """Functions of `ROOMS` that return a part of a document or a picture, or in present/ texts.

    A function within a function counts by itself. What draws a figure, and attributes (decorated), do not.
    """
    for room in ROOMS:
        for path in sorted((PACKAGE / room).glob("*.py")):
            if path.stem in OF_NO_RESULT:
                continue
            parts = PARTS | {"str"} if room == "present" and not path.stem.endswith("_figures") else PARTS
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef) and not node.decorator_list and _returned(node) & parts:
                    yield LayoutFunction(path, node.name, (node.end_lineno or node.lineno) - node.lineno + 1)


def _returned(node: ast.FunctionDef) -> set[str]:
    """Names in what it says that it returns."""
    return {each.id for each in ast.walk(node.returns or ast.Constant(None)) if isinstance(each, ast.Name)}
