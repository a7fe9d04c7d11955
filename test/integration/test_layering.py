"""Imports run one way: the core knows no ROS, bags or pictures, bags know no DVL, and nobody knows the commands."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from validation import rooms, size
from validation.__main__ import main
from validation.layout import layout_functions

FOREIGN = ("rclpy", "rosbags", "mcap", "apsw", "lz4", "yaml", "rich", "matplotlib", "jinja2", "joblib")


def files_of(package: str) -> list[Path]:
    return sorted((rooms.PACKAGE / package).rglob("*.py"))


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


def test_each_room_is_known_and_imports_only_what_the_table_says():
    """Within functions and for types alone as well."""
    assert {rooms.room_of(path) for path in rooms.modules()} == set(rooms.ROOMS)
    beyond = {
        (room, other): sorted(str(path.relative_to(rooms.PACKAGE)) for path in files)
        for (room, other), files in rooms.arrows().items()
        if other not in rooms.ROOMS[room]
    }
    assert beyond == {}


def test_no_arrow_of_the_table_goes_up_so_that_there_is_no_circle():
    below: set[str] = set()
    for room, may_import in rooms.ROOMS.items():
        assert set(may_import) <= below, room
        below.add(room)
    assert rooms.arrows_up() == []


def test_each_room_has_a_paragraph_in_the_architecture_page():
    page = (ROOT / "docs" / "architecture.md").read_text()
    assert [room for room in rooms.ROOMS if f"**{room.rpartition('.')[2].strip('_')}**" not in page] == ["__init__"]


def test_no_two_modules_import_each_other():
    """Within functions and for types alone as well."""
    assert rooms.module_circles() == []


def test_a_circle_of_modules_is_seen(tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "__init__.py").write_text("")
    (tmp_path / "disk" / "a.py").write_text("if TYPE_CHECKING:\n    from .b import B\n")
    (tmp_path / "disk" / "b.py").write_text("def f():\n    from . import a\n")
    monkeypatch.setattr(rooms, "PACKAGE", tmp_path)
    assert rooms.module_circles() == [["disk.a", "disk.b"]]


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("attic/box.py", "from ..bags import reader", ("attic", "bags")),
        ("bags/new.py", "if TYPE_CHECKING:\n    from ..recordings import look", ("bags", "recordings")),
        ("calibration/streams/new.py", "def f():\n    from ...bags import reader", ("calibration.streams", "bags")),
        ("calibration/streams/a.py", "from ..filters import b", ("calibration.streams", "calibration.filters")),
        ("disk/new.py", "from .. import api", ("disk", "api")),
    ],
)  # fmt: skip
def test_an_arrow_up_and_an_unknown_room_are_seen(tmp_path, monkeypatch, name, text, what):
    for known in ("bags/reader.py", "disk/atomic.py"):
        (tmp_path / known).parent.mkdir(exist_ok=True)
        (tmp_path / known).write_text("from ..errors import InputError\n")
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
    monkeypatch.setattr(rooms, "PACKAGE", tmp_path)
    assert what in rooms.arrows_up()
    (tmp_path / name).unlink()
    assert rooms.arrows_up() == []


def test_no_estimator_is_asked_for_by_its_name_outside_its_own_room():
    named = {path.parent.name for path in rooms.modules() if '"full"' in path.read_text()}
    assert named <= {"estimators", "models"}


def test_the_size_is_printed_with_arrows(capsys):
    assert main(["size"]) == 0
    *_, lines, arrows, layout = capsys.readouterr().out.splitlines()
    n_modules, n_rooms = len(list(rooms.modules())), len(rooms.ROOMS)
    assert lines.split() == f"{rooms.sizes().total()} lines of code in {n_modules} modules and {n_rooms} rooms".split()
    assert arrows.split() == f"{len(rooms.arrows())} arrows between rooms, 0 up".split()
    assert layout.split()[:2] == [str(len(list(layout_functions()))), "functions"]
    assert main(["size", "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts["lines"] == rooms.sizes().total() and counts["arrows_up"] == 0


def test_what_has_grown_fails_the_limit(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(size, "LIMITS", tmp_path / "limits.json")
    assert main(["size", "--store", "--limit"]) == 0
    stored = json.loads(size.LIMITS.read_text())
    assert set(stored) == {"lines", "modules", "arrows"} and "too many" not in capsys.readouterr().out
    for name in stored:
        size.LIMITS.write_text(json.dumps(stored | {name: stored[name] - 1}))
        assert main(["size", "--limit"]) == 1
        assert f"{stored[name]} {name}, {stored[name] - 1} allowed: 1 too many" in capsys.readouterr().out


def test_a_result_is_laid_out_by_few_functions_and_none_of_them_is_long():
    """Parts that are tables are declared as columns; a function that lays out a part is for what is no table."""
    found = list(layout_functions())
    assert 40 < len(found) < 50, sorted(f"{each.path.name} {each.name}" for each in found)
    assert max(each.lines for each in found) <= 100


def test_blank_lines_comments_and_docstrings_are_no_code():
    text = '"""Of the\n\nmodule."""\n# why\nimport a  # b\n\ndef f():\n    """Docs."""\n    return (\n"x"\n    )\n'
    assert rooms.lines_of_code(text) == 5


@pytest.mark.spread(1)
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
from dvl_calib_ros.calibration.numerics import kalman
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample
kalman.prepare()
before = set(sys.modules)
calibrator = Calibrator(Parameters(), block_size=512)
for fifth in range(300):
    stamp_ns = 1_700_000_000_000_000_000 + fifth * 200_000_000
    calibrator.feed_imu(ImuSample(stamp_ns, (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.01)))
    calibrator.feed_reference(ReferenceSample(stamp_ns, (1.5, 0.0, 0.0)))
    calibrator.feed_dvl(DvlSample(stamp_ns, (1.5, 0.0, 0.0)))
    calibrator.published(calibrator.selected)
assert calibrator.selected == "full"
print(*sorted(set(sys.modules) - before))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []
