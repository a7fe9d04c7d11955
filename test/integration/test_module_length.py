"""Modules stay short enough to be read at one sitting."""

from __future__ import annotations

import ast
from collections import defaultdict

from conftest import ROOT

LONGEST = 600
FOLDERS = ("dvl_calib_ros", "benchmarks", "validation")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def test_no_module_is_above_600_lines():
    assert len(MODULES) > 100
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in MODULES}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


def test_a_class_name_has_one_meaning():
    """In the package two classes never share a name: a reader who searches for one finds it."""
    places = defaultdict(list)
    for path in (ROOT / "dvl_calib_ros").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.name)
    assert len(places) > 200
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}
