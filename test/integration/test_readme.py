"""The README: a row for every warning of the node under "When something is wrong", and files that are there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest
from conftest import ROOT

WARNING_MODULES = ("calibration/advice.py", "node/diagnostics.py", "node/graph.py", "messages/decode.py")
# a text with fewer is a name
WORDS = 3
# pieces of sentences whose other pieces are looked for, and names of values
PIECES = (
    "… … samples …; they are not used",
    "check the sensor, its driver and the topic dvl/twist",
    "the models that need attitude learn nothing; check its driver and the topic imu/data",
    "the DVL's own frame (dvl_link)",
    "set … to it, or remap one of the two",
    "remap one of the two, or convert",
    "dvl longest dropout [s]",
    "NIS ratio low",
    "NIS ratio high",
)


def sentences(module: str) -> Iterator[str]:
    """The texts of a module without its docstrings; … stands for what is put in."""
    tree = ast.parse((ROOT / "dvl_calib_ros" / module).read_text())
    skipped = {id(piece) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for piece in node.values}
    skipped |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        pieces = node.values if isinstance(node, ast.JoinedStr) else [node]
        texts = [piece.value if isinstance(piece, ast.Constant) else "…" for piece in pieces]
        if isinstance(node, ast.JoinedStr | ast.Constant) and all(isinstance(text, str) for text in texts):
            text = "".join(texts)
            if len(re.findall(r"(?<!\S)[A-Za-z]+(?![^\s:;,.?])", text)) >= WORDS and text not in PIECES:
                yield text


def phrases() -> list[str]:
    """What the table quotes from /diagnostics."""
    section = (ROOT / "README.md").read_text().partition("### When something is wrong")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [phrase for row in rows for phrase in re.findall(r"`([^`]+)`", row)]


@pytest.mark.parametrize("module", WARNING_MODULES)
def test_every_warning_of_the_node_has_a_row_in_the_troubleshooting_table(module):
    quoted = phrases()
    missing = [text for text in sentences(module) if not any(phrase in text for phrase in quoted)]
    assert missing == []


def test_the_table_quotes_nothing_that_the_node_does_not_say():
    said = [text for module in (*WARNING_MODULES, "node/calibration_node.py") for text in sentences(module)]
    assert [phrase for phrase in phrases() if not any(phrase in text for text in said)] == []


def test_files_that_the_readme_names_are_there_and_its_pictures_are_small():
    text = (ROOT / "README.md").read_text()
    pictures = [ROOT / name for name in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)]
    assert len(pictures) >= 3 and all(picture.stat().st_size < 150_000 for picture in pictures)
    named = re.findall(r"`((?:config|bags|test|\.ci|calibration|bags|files|messages|node|cli|effects)/[\w./]*)`", text)
    assert len(named) > 5
    roots = (ROOT, ROOT / "dvl_calib_ros")
    assert [name for name in named if not any((root / name).exists() for root in roots)] == []


def test_every_test_that_proves_a_promise_is_there():
    section = (ROOT / "README.md").read_text().partition("## What is promised")[2].partition("\n## ")[0]
    named = re.findall(r"`(test_\w+)(\.\.\.)?`", section)
    there = re.findall(
        r"^def (test_\w+)", "\n".join(path.read_text() for path in (ROOT / "test").rglob("test_*.py")), re.M
    )
    assert len(named) > 30
    assert [
        name for name, cut in named if not any(each == name or (cut and each.startswith(name)) for each in there)
    ] == []
