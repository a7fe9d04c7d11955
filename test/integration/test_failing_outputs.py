"""Standard streams, disks, links and schedulers that fail: one line or none, no traceback, nothing left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import fail, room_for, succeed
from conftest import ROOT
from io_fixtures import run, write_bag

from dvl_calib_ros.calibration.numerics.samples import DvlSample
from dvl_calib_ros.cli import common
from dvl_calib_ros.cli.main import main

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return write_bag(tmp_path_factory.mktemp("failing") / "bag", run(30.0))


def shell(redirected: str, *arguments, before: str = "", module: str = "cli.main") -> subprocess.CompletedProcess:
    """A command with its standard streams as a shell redirects them."""
    words = [sys.executable, "-m", f"dvl_calib_ros.{module}", *map(str, arguments)]
    script = f'{before} exec "$@" {redirected}'
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        ["bash", "-c", script, "bash", *words], capture_output=True, text=True, env=environment, timeout=PATIENCE_S
    )


CLOSED = ["<&- ", ">&- ", "<&- >&- 2>&- "]


@pytest.mark.spread(1)
@pytest.mark.parametrize("closed", CLOSED)
def test_closed_streams_are_as_good_as_nowhere(bag, tmp_path, closed):
    done = shell(closed, "replay", bag, "--json", tmp_path / "out.json", "--verbose")
    assert done.returncode == 0 and "Traceback" not in done.stdout + done.stderr
    document = json.loads((tmp_path / "out.json").read_text())  # nothing that was said is in it
    assert "models" in document and os.listdir(tmp_path) == ["out.json"]
    assert (">&-" in closed.replace("2>&-", "")) == (done.stdout == "")


@pytest.fixture(scope="module")
def warned_of(tmp_path_factory) -> Path:
    """A bag that a replay warns of."""
    still = [each._replace(velocity=(1.5, 0.0, 0.0)) if isinstance(each, DvlSample) else each for each in run(40.0)]
    bag = write_bag(tmp_path_factory.mktemp("warned") / "bag", still)
    assert "warning: " in shell("", "replay", bag).stderr
    return bag


@pytest.mark.spread(1)
@pytest.mark.parametrize("stream", ["2>&-", "2>/dev/full"])
def test_warnings_that_nobody_can_read_cost_no_result(warned_of, tmp_path, stream):
    done = shell(stream, "replay", warned_of, "--json", tmp_path / "o.json")
    assert done.returncode == 0 and "\nnext  dvl-calib" in done.stdout
    assert "models" in json.loads((tmp_path / "o.json").read_text())


@pytest.mark.slow
def test_a_comparison_of_which_only_the_first_line_is_read_still_says_by_its_code_that_the_mounting_moved(
    tmp_path, capsys
):
    for name, yaw in (("before", 0.0), ("after", 5.0)):
        options = ("--trajectory", "figure8", "--duration", 120, "--misalignment", 0, 0, yaw)
        succeed(capsys, "simulate", tmp_path / name, *options)
        succeed(capsys, "replay", tmp_path / name, "--save", tmp_path / f"{name}.yaml")
    results = (tmp_path / "before.yaml", tmp_path / "after.yaml")
    assert shell("", "compare", *results).returncode == 4
    done = shell("> >(true)", "compare", *results)
    assert done.returncode == 4 and "Traceback" not in done.stderr


@pytest.mark.parametrize("stream", ["2>&-", "2>/dev/full", ">&- 2>&-"])
def test_the_exit_code_says_what_standard_error_cannot(tmp_path, stream):
    done = shell(stream, "replay", tmp_path / "missing")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


def test_a_closed_standard_error_does_not_end_the_node(tmp_path):
    pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")
    done = shell("<&- >&- 2>&-", "--ros-args", "-p", "gnss_timout:=1.0", module="node.main")
    assert done.returncode == 2
    done = shell("2>&1", "--ros-args", "-p", "gnss_timout:=1.0", module="node.main")
    assert done.returncode == 2 and done.stdout.count("\n") == 1


@pytest.mark.parametrize("arguments", [("replay", "BAG"), ("parameters",), ("parameters", "--models")])
def test_a_full_standard_output_is_said_in_one_line(bag, arguments):
    done = shell(">/dev/full", *(bag if word == "BAG" else word for word in arguments))
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"dvl-calib {arguments[0]}: No space left on device") and "Traceback" not in done.stderr


@pytest.mark.parametrize("where", ["missing/x", "loop", "file/x"])
@pytest.mark.parametrize(
    "arguments",
    [
        ("replay", "BAG", "--json"), ("replay", "BAG", "--save"), ("replay", "BAG", "--report"),
        ("salvage", "BAG", "-o"), ("simulate", "--duration", "5"), ("import", "T.csv", "-o"),
        ("evaluate", "--csv"), ("diagnose", "BAG", "--apply"),
    ],
)  # fmt: skip
def test_a_link_that_leads_nowhere_is_refused_before_any_work(bag, tmp_path, monkeypatch, capsys, arguments, where):
    monkeypatch.chdir(tmp_path)
    Path("T.csv").write_text("0,1.5,0,0\n0.2,1.5,0,0\n")
    Path("file").touch()
    Path("loop").symlink_to(where)
    before = sorted(os.listdir(tmp_path))
    error = fail(capsys, *(bag if word == "BAG" else word for word in arguments), "loop")
    assert "loop" in error
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize(
    ("command", "storage", "compression"),
    [
        ("salvage", "mcap", "file"),
        ("salvage", "sqlite3", "message"),
        ("simulate", "mcap", "none"),
        ("simulate", "sqlite3", "file"),
        ("import", "mcap", "message"),
        ("import", "sqlite3", "none"),
    ],
)
def test_a_bag_that_a_full_disk_stops_is_said_and_leaves_nothing(
    bag, tmp_path, monkeypatch, capsys, command, storage, compression
):
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"{0.01 * i},1.5,{i % 7},0\n" for i in range(5000))
    Path("T.csv").write_text(rows)
    arguments = {
        "salvage": ("salvage", bag, "-o", "made/for/it"),
        "simulate": ("simulate", "new", "--duration", 40),
        "import": ("import", "T.csv", "-o", "made/for/it"),
    }[command]
    with room_for(30_000):
        error = fail(capsys, *arguments, "--storage", storage, "--compression", compression)
    assert "free some space" in error
    assert os.listdir(tmp_path) == ["T.csv"]


def test_what_a_full_disk_does_not_take_is_printed_and_the_other_files_are_written(bag, tmp_path, capsys):
    """The answer of hours must not be lost with a file of it."""
    small, large = tmp_path / "o.json", tmp_path / "r.yaml"
    large.write_text("the one before")
    assert main(["replay", str(bag), "--json", str(small)]) == 0
    answer = capsys.readouterr().out
    with room_for(8192):
        assert main(["doctor", str(bag), "--json", str(small)]) == 0
        capsys.readouterr()
        assert main(["replay", str(bag), "--json", str(small), "--save", str(large)]) == 2
    shown, error = capsys.readouterr()
    assert shown.split("next")[0] == answer.split("next")[0] and "The DVL is rotated by" in shown
    assert error.splitlines()[-1].count("free some space") == 2 and "verdict" in json.loads(small.read_text())
    assert large.read_text() == "the one before" and len(os.listdir(tmp_path)) == 3


@pytest.mark.slow
def test_a_full_disk_is_said_in_one_line_also_when_nobody_reads_the_answer(bag, tmp_path):
    done = shell("> >(true)", "replay", bag, "--json", tmp_path / "o.json", before="ulimit -f 1; trap '' XFSZ;")
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith("name a file on another disk")
    assert "Exception ignored" not in done.stderr and os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "words", [("doctor", "b"), ("replay", "BAG", "--json", "o.json"), ("simulate", "new"), ("apply", "r.yaml")]
)
def test_that_the_folder_it_was_started_in_is_gone_is_said(bag, tmp_path, monkeypatch, capsys, words):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    error = fail(capsys, *(bag if word == "BAG" else word for word in words))
    assert error.endswith("the folder that this was started in is gone, change to another\n")


@pytest.mark.spread(2)
@pytest.mark.parametrize(
    ("what", "storage"), [("grows", "mcap"), ("grows", "sqlite3"), ("replaced", "mcap"), ("journal", "sqlite3")]
)
def test_a_recording_that_changes_while_it_is_read_is_said(tmp_path, monkeypatch, capsys, storage, what):
    """Discovery read one bag, the calibration another: the answer looked as usable as any."""
    for name, turned in (("a", 0.0), ("b", 4.0)):
        options = ["--duration", "30", "--misalignment", "0", "0", str(turned), "--storage", storage]
        assert main(["simulate", str(tmp_path / name), *options]) == 0
    file, other = (next(path for path in (tmp_path / name).iterdir() if path.suffix != ".yaml") for name in "ab")
    assert main(["replay", str(tmp_path / "a")]) == 0
    assert "changed while" not in capsys.readouterr().err
    found = common.discovered

    def meanwhile(*given):
        discovery = found(*given)
        if what == "grows":
            with file.open("ab") as written:
                written.write(bytes(100))
        elif what == "replaced":
            other.replace(file)
        else:
            os.utime(journal)
        return discovery

    journal = file.with_name(f"{file.name}-wal")
    if what == "journal":
        journal.touch()
        os.utime(journal, (0, 0))
    monkeypatch.setattr(common, "discovered", meanwhile)
    assert main(["replay", str(file if what == "journal" else tmp_path / "a")]) == 0
    assert capsys.readouterr().err.count("changed while it was read") == 1


@pytest.mark.parametrize("place", ["/proc/new", "T.csv/new", "T.csv/new/deeper"])
@pytest.mark.parametrize(
    "words", [("salvage", "BAG", "-o"), ("import", "T.csv", "-o"), ("simulate",), ("diagnose", "BAG", "--twin")]
)
def test_a_folder_that_cannot_be_made_is_said_before_any_work_with_a_remedy_that_helps(
    bag, tmp_path, monkeypatch, capsys, words, place
):
    monkeypatch.chdir(tmp_path)
    Path("T.csv").write_text("")  # who reads it finds no rows
    error = fail(capsys, *(bag if word == "BAG" else word for word in words), place)
    assert place in error and "is not writable" in error and "name another" in error and "space" not in error
    assert os.listdir(tmp_path) == ["T.csv"]


@pytest.mark.spread(1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_ended_half_way_leaves_no_half_of_a_bag(tmp_path, number):
    command = [sys.executable, "-m", "dvl_calib_ros.cli.main", "simulate", str(tmp_path / "new"), "--duration", "200"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + PATIENCE_S
        while not os.listdir(tmp_path):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        process.send_signal(number)
        assert process.stderr.read() == "dvl-calib simulate: interrupted\n"
    # Python makes the second of it where the interrupt went through an exec() of text; 130 to a shell, too
    assert process.returncode in (130, -signal.SIGINT) and os.listdir(tmp_path) == []
