"""Every sentence of every table as people read it, in one file: whoever mends one renews the file, and sees no other.

Renew it with ``python test/unit/verdict/test_sentences.py`` and look at ``git diff``.
"""

from __future__ import annotations

from pathlib import Path

from dvl_calib_ros.verdict.kinds import Kind
from dvl_calib_ros.verdict.reasons import TABLES

SNAPSHOT = Path(__file__).with_name("sentences.txt")


class Example:
    """Whatever is put in: a number where the sentence formats one, else its name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __format__(self, spec: str) -> str:
        return format(3 if spec.endswith("d") else 2.75, spec) if spec else f"<{self.name}>"

    def __repr__(self) -> str:
        return f"'<{self.name}>'"


class Examples(dict[str, Example]):
    """One for every field that a sentence asks for."""

    def __missing__(self, name: str) -> Example:
        return Example(name)


def sentence(kind: Kind) -> str:
    """An entry in two lines."""
    says, remedy = (text.format_map(Examples()) for text in (kind.says, kind.remedy))
    return f"{kind.code} ({kind.severity.value}, {kind.page})\n  {says}\n" + (f"  -> {remedy}\n" if remedy else "")


def all_sentences() -> str:
    """The file."""
    return "".join(f"== {name}\n" + "".join(map(sentence, kinds)) for name, kinds in TABLES.items())


def test_all_sentences_are_those_of_the_file():
    assert all_sentences() == SNAPSHOT.read_text(), f"renew it: python {Path(__file__).relative_to(Path.cwd())}"


if __name__ == "__main__":
    SNAPSHOT.write_text(all_sentences())
