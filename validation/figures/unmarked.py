"""Figures on the pages that look measured and stand outside of every block, so that no command makes them.

By units and the words beside them, line by line. It cannot see a figure without unit or in words ("twice", "a third"),
one whose unit or word stands on the next line, one that is told as if it were a definition, and what is in a fenced
block or in a row of a table that names the test that holds it.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from .pages import without_blocks

_UNIT = r"(?:mm/s|cm/s|m/s|m per km|mm/s rms|°|%|s|ms|µs|min|MB/h|MB|GB|kB|m|mm|cm|times|x|σ)(?![\w/])"
_NUMBER = r"(?<![\w.,/:=\[-])[+−-]?\d+(?:\.\d+)?"
_TELLING = (
    "median|mean|average|rms|p50|p99|errors?|drift|off by|differ(?:s|ed)? by(?: up to)?|falls from|took|takes|lost"
    "|measured|found|seeds?|runs? of|costs?"
)
# what makes a figure one that was measured, beside its unit
_SIGNS = (
    r"±\s?\d",  # an estimate with its σ
    rf"{_NUMBER} of (?:the )?\d+\b",  # a count of cases
    rf"{_NUMBER}\s?{_UNIT}? (?:faster|slower|less than|more than before|of CPU)\b",
    rf"(?:{_TELLING})\b[^.|;]{{0,40}}?{_NUMBER}\s?{_UNIT}",
    rf"{_NUMBER}\s?{_UNIT}[^.|;,]{{0,25}}\b(?:rms|median|in the mean|on average|at a load)\b",
    r"\b\d\.\d{3,}\b",  # three digits and more are nobody's definition
    r"\b(?:was|were|had been|before it|used to)\b[^.|;]{0,30}" + _NUMBER + r"\s?" + _UNIT,
    r"\b\d{1,2} (?:January|February|March|April|May|June|July|August|September|October|November|December)\b",
    r"\(seeds? \d|\bseed \d",
)
_LOOKS = re.compile("|".join(f"(?:{sign})" for sign in _SIGNS), re.IGNORECASE)
_FENCED = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
_CODE = re.compile(r"`[^`\n]*`")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


class Unmarked(NamedTuple):
    """What looks measured, and its line."""

    line: int
    text: str


def unmarked(page: str) -> list[Unmarked]:
    """Lines of a page's text that have such a figure: not those in blocks, code, or a row that names its test."""
    text = without_blocks(page)
    for hidden in (_FENCED, _COMMENT):
        text = hidden.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        proven = line.startswith("|") and ("`test_" in line or "test_" in line or "| `[" in line or "`..._" in line)
        if not proven and _LOOKS.search(_CODE.sub("`", line)):
            found.append(Unmarked(number, line.strip()))
    return found
