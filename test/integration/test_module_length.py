"""Modules stay short enough to be read at one sitting, or say why they are not."""

from __future__ import annotations

import ast
from collections import defaultdict

from conftest import ROOT

LONGEST = 350
FOLDERS = ("dvl_calib_ros", "benchmarks", "validation")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def lacks_reason(text: str) -> bool:
    """Whether a module is long, and its docstring does not say in brackets why: "(Long, because ...)"."""
    if len(text.splitlines()) <= LONGEST:
        return False
    return "(Long, because" not in " ".join((ast.get_docstring(ast.parse(text)) or "").split())


def test_no_module_is_above_350_lines_without_a_reason_at_its_top():
    assert len(MODULES) > 100
    assert [path for path in MODULES if lacks_reason(path.read_text())] == []


def test_a_long_module_is_noticed_until_it_says_why():
    body = "x = 1\n" * LONGEST
    assert lacks_reason(f'"""About."""\n{body}')
    assert not lacks_reason(f'"""About. (Long, because it is a table.)"""\n{body}')
    assert not lacks_reason('"""About."""\n' + "x = 1\n" * (LONGEST - 1))


def test_a_class_name_has_one_meaning():
    """In the package two classes never share a name: a reader who searches for one finds it."""
    places = defaultdict(list)
    for path in (ROOT / "dvl_calib_ros").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.name)
    assert len(places) > 200
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}
