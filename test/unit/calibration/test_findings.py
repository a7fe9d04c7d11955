"""Findings: the one table of warnings, its calls throughout the package, and its page in the documentation."""

from __future__ import annotations

import ast
import string
from functools import cache

import pytest
from conftest import ROOT
from documentation import section

from dvl_calib_ros.calibration.findings import FINDINGS, FindingKind, Severity, finding, finding_table
from dvl_calib_ros.examination.kinds import KINDS

PACKAGE = ROOT / "dvl_calib_ros"
MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path.name != "findings.py"]


def fields(kind: FindingKind) -> set[str]:
    """What has to be put into its sentences."""
    parsed = string.Formatter().parse(kind.says + kind.remedy)
    return {name for _, name, _, _ in parsed if name}


@cache
def nodes() -> list[ast.AST]:
    """All of the package's code."""
    return [node for path in MODULES for node in ast.walk(ast.parse(path.read_text()))]


def literal_calls() -> list[tuple[str, set[str], bool]]:
    """(code, keywords, whether there are others by **) of each call of `finding` with a code in place."""
    found = []
    for node in nodes():
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "finding":
            first = node.args[0]
            if isinstance(first, ast.Constant):
                names = {keyword.arg for keyword in node.keywords if keyword.arg}
                found.append((first.value, names, any(keyword.arg is None for keyword in node.keywords)))
    return found


def test_a_finding_says_what_is_wrong_what_to_do_and_its_code():
    found = finding("DVL_DROPOUTS", count=3)
    assert str(found) == f"the DVL dropped out 3 times; {found.remedy} [DVL_DROPOUTS]"
    assert found.as_dict()["severity"] == "warning" and found.severity is Severity.WARNING


@pytest.mark.parametrize(("code", "given"), [("NO_SUCH_CODE", {}), ("DVL_DROPOUTS", {})])
def test_an_unknown_code_or_a_missing_field_is_an_error_of_the_program(code, given):
    with pytest.raises(KeyError):
        finding(code, **given)


def test_every_call_gives_its_entry_exactly_the_fields_it_has():
    calls = literal_calls()
    assert len(calls) > 25
    for code, names, more in calls:
        wanted = fields(FINDINGS[code])
        assert names <= wanted and (more or names == wanted), code


def test_every_entry_of_the_table_is_said_somewhere():
    constants = {node.value for node in nodes() if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert [code for code in FINDINGS if code not in constants] == []


@pytest.mark.parametrize("code", ["lower_case", "WITH SPACE", ""])
def test_a_code_is_one_word_in_capitals(code):
    with pytest.raises(ValueError, match="code"):
        FindingKind(code, "a", "b", "c")


@pytest.mark.parametrize(("name", "kinds"), [("findings", FINDINGS), ("doctor", KINDS)])
def test_the_troubleshooting_page_has_the_tables(name, kinds):
    assert section(name) == finding_table(kinds.values()).strip(), "take it from: python -m validation figures --render"
