"""Imports run one way: the core knows no ROS, bags or pictures, bags know no DVL, and nobody knows the commands."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT

PACKAGE = ROOT / "dvl_calib_ros"
FOREIGN = ("rclpy", "rosbags", "mcap", "apsw", "lz4", "yaml", "rich", "matplotlib", "jinja2", "joblib")
# what a package may import of its siblings; one that is not listed may import all but commands and node
MAY_IMPORT = {
    "calibration": {"errors"},
    "effects": {"calibration", "errors"},
    "bags": {"files", "errors"},
    "messages": {"bags", "calibration", "errors"},
    "recordings": {"bags", "messages", "calibration", "errors"},
    "files": {"bags", "messages", "calibration", "errors"},
    "diagnosis": {"recordings", "messages", "effects", "calibration", "errors"},
    "export": {"files", "effects", "calibration", "errors"},
    "unpaired": {"diagnosis", "recordings", "messages", "effects", "calibration", "errors"},
    "report": {"unpaired", "diagnosis", "evaluation", "replay", "files", "effects", "calibration", "errors"},
}
WIRING = {"cli", "node", "demo"}


@cache
def siblings_imported_by(path: Path) -> set[str]:
    """Packages and modules of ours, beside the one that the file is in, which it imports, also within functions."""
    inside = path.relative_to(PACKAGE).parent.parts
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            above = inside[: len(inside) - (node.level - 1)]
            full = [*above, *(node.module.split(".") if node.module else [])]
            found |= {full[0]} if full else {alias.name for alias in node.names if alias.name != "__version__"}
    return found - set(inside[:1])


def files_of(package: str) -> list[Path]:
    return sorted((PACKAGE / package).rglob("*.py"))


@pytest.mark.parametrize("package", ["calibration", "effects"])
def test_the_core_takes_numpy_and_scipy_and_nothing_else(package):
    """In a process of its own, into which nothing has been imported before."""
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in files_of(package)
        if path.name != "__init__.py"
    ]
    script = f"import importlib, sys\nfor name in {names}: importlib.import_module(name)\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert "numpy" in loaded and len(names) > 5
    assert loaded.intersection(FOREIGN) == set()


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_a_package_imports_only_those_below_it(package):
    imported = {each for path in files_of(package) for each in siblings_imported_by(path)}
    assert imported - MAY_IMPORT[package] == set()


def test_nothing_but_the_wiring_imports_commands_and_node():
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")} - WIRING
    assert len(packages) > 10
    for package in packages:
        for path in files_of(package):
            assert siblings_imported_by(path).intersection(WIRING) == set(), path


@pytest.mark.parametrize(
    ("command", "slow"),
    [
        ("replay", ("scipy", "numpy.ma", "matplotlib", "joblib")),
        ("doctor", ("scipy", "matplotlib", "joblib")),
        ("diagnose", ("scipy.stats", "scipy.signal", "matplotlib", "joblib")),
    ],
)
def test_a_command_imports_nothing_that_would_take_longer_than_its_work(command, slow):
    """scipy.special alone takes a quarter of a second of CPU, scipy.stats and scipy.signal a whole one.

    numpy.ma, which numpy.median and numpy.unique load, takes a tenth of all imports.
    """
    run = f"from dvl_calib_ros.cli.main import main; main([{command!r}, 'bags/straight_leg'])"
    script = f"import sys; {run}; print(*(name for name in {slow} if name in sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr.splitlines()[-1].split() == []


def test_no_live_message_waits_for_an_import():
    """The first one alone would for a fifth of a second, and those behind it."""
    script = """
import sys
from dvl_calib_ros.calibration import kalman
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import DvlSample, ImuSample, ReferenceSample
kalman.prepare()
before = set(sys.modules)
calibrator = Calibrator(Parameters(), block_size=512)
for fifth in range(300):
    stamp_ns = 1_700_000_000_000_000_000 + fifth * 200_000_000
    calibrator.feed_imu(ImuSample(stamp_ns, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.01)))
    calibrator.feed_reference(ReferenceSample(stamp_ns, (1.5, 0.0, 0.0)))
    calibrator.feed_dvl(DvlSample(stamp_ns, (1.5, 0.0, 0.0)))
    calibrator.published(calibrator.selected)
assert calibrator.selected == "G1" and calibrator.estimate("G2").used
print(*sorted(set(sys.modules) - before))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []
