"""Rules that all code of the package keeps: short modules, safe calls, one way to print, findings of the table."""

from __future__ import annotations

import ast
import re
import string
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from test_packaging import DISTRIBUTIONS, NOT_REQUIRED, required

from dvl_calib_ros.disk.text_files import _Loader
from dvl_calib_ros.verdict.kinds import Kind
from dvl_calib_ros.verdict.reasons import KINDS

LONGEST = 600
PACKAGE = ROOT / "dvl_calib_ros"
FORBIDDEN = {"eval", "exec", "compile", "pickle.load", "pickle.loads", "os.system", "os.popen", "marshal.loads"}
PRINTING = ("print", "Console", "RichConsole", "sys.stdout.write", "sys.stderr.write", "rich.print")
Nodes = dict[Path, list[ast.AST]]
Calls = list[tuple[Path, str, ast.Call]]


@pytest.fixture(scope="module")
def nodes() -> Nodes:
    """All nodes of each module of the package: parsing them takes two seconds."""
    return {path: [*ast.walk(ast.parse(path.read_text()))] for path in sorted(PACKAGE.rglob("*.py"))}


@pytest.fixture(scope="module")
def calls(nodes) -> Calls:
    """All calls, each with its module and the dotted name of what is called."""
    return [(path, ast.unparse(n.func), n) for path, each in nodes.items() for n in each if isinstance(n, ast.Call)]


def test_no_module_is_above_600_lines():
    modules = [path for name in ("dvl_calib_ros", "benchmarks", "validation") for path in (ROOT / name).rglob("*.py")]
    assert len(modules) > 100
    lengths = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in modules}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


def test_a_class_name_has_one_meaning(nodes):
    """In the package two classes never share a name: a reader who searches for one finds it."""
    places = defaultdict(list)
    for path, each in nodes.items():
        for node in each:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(path.name)
    assert len(places) > 200
    assert {name: paths for name, paths in places.items() if len(paths) > 1} == {}


def test_everything_that_is_imported_is_declared(nodes):
    imported = set()
    for node in (node for each in nodes.values() for node in each):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            imported.add(node.module.partition(".")[0])
    messages = {name for name in imported if name.endswith(("_msgs", "_srvs", "_interfaces"))}
    others = imported - {"dvl_calib_ros", "test", *sys.stdlib_module_names} - messages - NOT_REQUIRED
    assert {DISTRIBUTIONS.get(name, name) for name in others} - required().keys() == set()


def test_yaml_is_loaded_safely_everywhere(calls):
    assert issubclass(_Loader, yaml.SafeLoader)
    loads = [each for each in calls if re.search(r"(^|\.)yaml\.\w*load|YAML$", each[1])]
    assert loads
    for path, name, call in loads:
        loader = [ast.unparse(keyword.value) for keyword in call.keywords if keyword.arg == "Loader"]
        assert name == "yaml.load" and loader == ["_Loader"], f"{path}: {ast.unparse(call)}"


def test_nothing_in_the_package_evaluates_unpickles_or_starts_a_shell(calls):
    for path, name, call in calls:
        is_shell = any(keyword.arg == "shell" for keyword in call.keywords)
        is_unsafe = name in ("np.load", "numpy.load") and "allow_pickle=False" not in ast.unparse(call)
        assert name not in FORBIDDEN and not is_shell and not is_unsafe, f"{path}: {ast.unparse(call)}"


def test_only_two_functions_print(calls):
    """`standard_streams` prints lines, `common.console` makes the console: both print what is fit for a terminal."""
    found = {(path.relative_to(PACKAGE).as_posix(), name) for path, name, _ in calls if name in PRINTING}
    assert found == {
        ("standard_streams.py", "print"), ("cli/common.py", "Console"), ("api/calibrated.py", "Console"),
    }  # fmt: skip


def test_the_node_logs_by_one_class_alone(calls):
    """Others may log a text that stands in the code, for rclpy's filters."""
    logged = [(path, call) for path, name, call in calls if "get_logger()." in name]
    assert {path.name for path, call in logged if not isinstance(call.args[0], ast.Constant)} == {"services.py"}


def fields(kind: Kind) -> set[str]:
    """What has to be put into its sentences."""
    parsed = string.Formatter().parse(kind.says + kind.remedy)
    return {name for _, name, _, _ in parsed if name}


def findings(calls: Calls) -> Iterator[tuple[str, set[str], bool]]:
    """(code, keywords, whether there are others by **) of each call of `finding` with a code in place."""
    for path, name, call in calls:
        if path.parent.name != "verdict" and name == "finding" and isinstance(call.args[0], ast.Constant):
            names = {keyword.arg for keyword in call.keywords if keyword.arg}
            yield call.args[0].value, names, any(keyword.arg is None for keyword in call.keywords)


def test_every_call_gives_its_entry_exactly_the_fields_it_has(calls):
    found = [*findings(calls)]
    assert len(found) > 25
    for code, names, more in found:
        wanted = fields(KINDS[code])
        assert names <= wanted and (more or names == wanted), code


def test_every_entry_of_the_table_is_said_somewhere(nodes):
    elsewhere = (node for path, each in nodes.items() if path.parent.name != "verdict" for node in each)
    constants = {node.value for node in elsewhere if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert [code for code in KINDS if code not in constants] == []
