"""The tables of the documentation that the code makes."""

from __future__ import annotations

import re

from conftest import ROOT


def section(name: str) -> str:
    """Text between the marks of this name, which stand once in README.md and docs/."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    marks = re.compile(rf"<!-- {name} -->\n(.*?)<!-- end {name} -->", re.DOTALL)
    found = [text for page in pages for text in marks.findall(page.read_text())]
    assert len(found) == 1, f"{len(found)} sections {name} in README.md and docs/"
    return found[0].strip()
