"""README.md and docs/: the tables that the code makes, and the blocks of commands that a reader would copy."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "examples").rglob("*.md"))]
_BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE
)


class Block(NamedTuple):
    """A fenced block. mark: the comment right before it."""

    page: Path
    line: int
    language: str
    mark: str
    text: str

    @property
    def why_not_run(self) -> str:
        """The reason why a block cannot be run by a test, if it has one."""
        return self.mark.removeprefix("not run:").strip() if self.mark.startswith("not run:") else ""

    @property
    def commands(self) -> list[str]:
        """Its commands, those over several lines in one."""
        joined = self.text.replace("\\\n", " ")
        return [line for line in joined.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    text = page.read_text()
    return [
        Block(page, text.count("\n", 0, found.start()) + 1, found["language"], found["mark"] or "", found["text"])
        for found in _BLOCK.finditer(text)
    ]


def section(name: str) -> str:
    """Text between the marks of this name, which stand once in README.md and docs/."""
    marks = re.compile(rf"<!-- {name} -->\n(.*?)<!-- end {name} -->", re.DOTALL)
    found = [text for page in PAGES for text in marks.findall(page.read_text())]
    assert len(found) == 1, f"{len(found)} sections {name} in README.md and docs/"
    return found[0].strip()
