"""The live view in the terminal: on a recorded console, and over DDS in a pseudo-terminal."""

from __future__ import annotations

import io
import math
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
from conftest import ROOT
from rich.console import Console
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.observability import observability
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.cli.live_view import LINE_S, SILENCE_S, line, rendered, show
from dvl_calib_ros.node.status import Status

PATIENCE_S = 30.0
VALUES = {
    "model": "G1", "why": "auto: GNSS is available", "gnss": "GNSS is available", "convergence": "coarse",
    "phi_x [deg]": "0.8834", "std phi_x [deg]": "1.4004", "progress phi_x [%]": "25.0",
    "observed phi_x": "no (roll); needs turns or a figure eight",
    "phi_z [deg]": "-3.0797", "std phi_z [deg]": "0.0487", "progress phi_z [%]": "100.0", "observed phi_z": "yes",
    "heave [m/s]": "0.0000", "std heave [m/s]": "0.0200",
    "mean NIS": "2.104 of 3 (99 %: 2.829 .. 3.140)", "samples used": "1583", "samples gated": "2", "dvl invalid": "0",
}  # fmt: skip


def status(level=0, message="", received_s=100.0, **changes) -> Status:
    return Status(level, message, VALUES | changes, received_s)


def drawn(*arguments, width=110) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None, record=True)
    console.print(rendered(*arguments))
    return console.export_text()


# ---------------------------------------------------------------- drawing


def test_the_view_shows_estimates_convergence_and_what_to_fly():
    text = drawn(status(), 100.5)
    rows = {words[0]: row for row in text.splitlines() if len(words := row.split()) > 2}
    assert "0.8834" in rows["phi_x"] and "1.4004" in rows["phi_x"] and "turns or a figure eight" in rows["phi_x"]
    assert "-3.0797" in rows["phi_z"] and "needs" not in rows["phi_z"]
    assert "0.0200" in rows["heave"]
    assert text.startswith("G1: auto: GNSS is available\ncoarse   1583 used, 2 gated, NIS 2.104")


@pytest.mark.parametrize(("percent", "full"), [(0.0, 0), (25.0, 5), (99.0, 19), (100.0, 20)])
def test_the_bar_is_as_long_as_the_convergence(percent, full):
    console = Console(file=io.StringIO(), width=110, force_terminal=True, color_system="standard", legacy_windows=False)
    console.print(rendered(status(**{"progress phi_x [%]": str(percent)}), 100.0))
    row = next(row for row in console.file.getvalue().splitlines() if "phi_x" in row)
    bars = re.findall(r"\x1b\[(33|32)m(━+)", row)
    assert sum(len(bar) for _, bar in bars) == full
    assert all(colour == ("32" if percent == 100.0 else "33") for colour, _ in bars)


def test_what_another_process_says_can_neither_style_the_view_nor_move_the_cursor():
    evil = "[bold]\x1b[2J[/] \x07"
    changes = {"why": evil, "phi_x [deg]": evil, "observed phi_x": f"no (roll); needs {evil}", "convergence": evil}
    text = drawn(status(1, evil, **changes), 100.0, [evil])
    assert text.count("[bold]") >= 4 and not {"\x1b", "\x07"} & set(text)


def test_before_the_first_sample_there_is_no_nis():
    text = drawn(status(**{"samples used": "0", "mean NIS": "nan of 3 (99 %: -3.041 .. 7.013)"}), 100.0)
    assert "0 used, 2 gated" in text and "nan" not in text


def test_faults_silence_and_waiting_are_said():
    assert "no DVL message for 7 s" in drawn(status(2, "no DVL message for 7 s"), 100.0)
    assert "nothing heard" not in drawn(status(), 100.0 + SILENCE_S)
    assert "nothing heard of the node for 9 s" in drawn(status(), 109.0)
    assert "waiting for the node" in drawn(None, 0.0)


def test_only_the_last_lines_of_the_log_are_shown_whatever_is_in_them():
    text = drawn(status(), 100.0, [f"line {i} [/bold] {'x' * 200}" for i in range(20)])
    assert "line 19 [/bold]" in text and "line 10 " not in text
    assert max(map(len, text.splitlines())) <= 110


@pytest.mark.parametrize("width", [20, 60, 80, 300])
def test_the_view_fits_any_terminal(width):
    text = drawn(status(1, "[red]" * 50, why="[/]"), 100.0, width=width)
    assert max(map(len, text.splitlines())) <= width


def test_without_a_terminal_a_line_is_written_when_something_changes_and_now_and_then(monkeypatch):
    changes = [None, status(), status(), status(convergence="fine"), status(1, "check", convergence="fine")]
    statuses = iter([*changes, changes[-1], changes[-1]])
    clock = iter([100.0, 100.5, 101.0, 101.5, 102.0, 102.5, 102.6 + LINE_S])
    monkeypatch.setattr("dvl_calib_ros.cli.live_view.time.monotonic", lambda: next(clock))
    running = iter([True] * 7 + [False])
    out = io.StringIO()
    show(Console(file=out, width=40), lambda _: next(statuses), lambda: next(running))
    lines = out.getvalue().splitlines()
    assert len(lines) == 4
    assert lines[0] == line(status()) and lines[0].startswith("G1 coarse: phi_x 0.8834 ± 1.4004 deg, ")
    assert lines[1].startswith("G1 fine:") and lines[2].endswith("; check") and lines[3] == lines[2]


@pytest.mark.parametrize("name", ["G1", "F1"])
def test_progress_goes_from_the_prior_to_fine_by_the_logarithm(name):
    parameters = Parameters()
    calibrator = calibrate(make_samples(MatchedRun(dvl_std=0.01, gnss_std=0.01)), parameters)
    covariance = calibrator.estimate(name).covariance
    for entry in observability(MODELS[name], covariance, parameters):
        angle = entry.name.startswith("phi")
        prior = parameters.initial_std_misalignment if angle else parameters.initial_std_scale
        fine = parameters.fine_std_misalignment if angle else parameters.fine_std_scale
        expected = math.log(prior / entry.std) / math.log(prior / fine)
        assert entry.progress == pytest.approx(min(max(expected, 0.0), 1.0))
    first = calibrate([]).estimate(name)
    assert [entry.progress for entry in first.observability] == pytest.approx([0.0] * MODELS[name].n_errors, abs=1e-9)


# ---------------------------------------------------------------- over DDS

rclpy = pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")


@pytest.fixture
def world():
    from ros import World

    world = World()
    yield world
    world.close()


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "dvl_calib_ros.cli.main", *arguments]


def environment(world) -> dict[str, str]:
    return os.environ | {"ROS_DOMAIN_ID": str(world.domain), "PYTHONPATH": str(ROOT), "TERM": "xterm-256color"}


class Terminal:
    """A pseudo-terminal that collects what a program draws."""

    def __init__(self, process: subprocess.Popen, handle: int) -> None:
        self.process, self._handle, self.text = process, handle, ""

    def until(self, text: str) -> None:
        """Read on until this has been drawn."""
        deadline = time.monotonic() + PATIENCE_S
        while text not in self.text:
            assert self._read() and time.monotonic() < deadline, f"no {text!r} in: {self.text[-2000:]}"

    def rest(self) -> str:
        """What is drawn until the program ends."""
        deadline = time.monotonic() + 2.0 * PATIENCE_S
        while self._read():
            assert time.monotonic() < deadline, f"it does not end: {self.text[-2000:]}"
        return self.text

    def _read(self) -> bool:
        ready, _, _ = select.select([self._handle], [], [], PATIENCE_S)
        assert ready, f"nothing new for {PATIENCE_S} s after: {self.text[-2000:]}"
        try:
            data = os.read(self._handle, 65536)
        except OSError:  # Linux's way to say that the other side is closed
            return False
        self.text += data.decode(errors="replace")
        return bool(data)

    def key(self, byte: bytes) -> None:
        os.write(self._handle, byte)


@contextmanager
def terminal(world, *arguments: str):
    handle, other = pty.openpty()
    process = subprocess.Popen(
        command(*arguments), stdin=other, stdout=other, stderr=other, cwd=ROOT, env=environment(world),
        start_new_session=True, preexec_fn=lambda: __import__("fcntl").ioctl(0, __import__("termios").TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(other)
    try:
        yield Terminal(process, handle)
    finally:
        process.terminate()  # so that it ends its node
        process.wait(PATIENCE_S)
        os.close(handle)


def test_run_watch_shows_the_node_live_and_ctrl_c_saves_and_ends_cleanly(world, tmp_path):
    from geometry_msgs.msg import TwistWithCovarianceStamped
    from ros import until

    saved = tmp_path / "result.yaml"
    with terminal(world, "run", "--watch", "-p", f"result_file:={saved}") as screen:
        publisher = world.node.create_publisher(TwistWithCovarianceStamped, "dvl/twist", 100)
        until(lambda: publisher.get_subscription_count() == 1, "the node's subscription")
        for i in range(20):
            message = TwistWithCovarianceStamped()
            message.header.stamp.sec, message.header.frame_id = 1000 + i, "dvl_link"
            message.twist.twist.linear.x = 1.5
            publisher.publish(message)
        for text in ("20 used", "still to drive", "phi_x deg", ": model auto"):
            screen.until(text)
        assert not saved.exists()
        screen.key(b"\x03")
        text = screen.rest()
        assert screen.process.wait(30) == 0
    assert saved.exists()
    assert f"saved to {saved}" in text and "Traceback" not in text
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")  # the cursor is back


def test_watching_a_node_elsewhere_writes_lines_to_a_pipe_and_leaves_the_node_running(world):
    with world.calibration_node() as node:
        watching = subprocess.Popen(
            command("watch"),
            env=environment(world),
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        first = watching.stdout.readline()
        watching.send_signal(signal.SIGINT)
        _, errors = watching.communicate(timeout=30)
        assert first.startswith("F1 collecting: phi_x 0.0000 ± ")
        assert (watching.returncode, errors) == (0, "")
        assert node.poll() is None


def test_of_two_nodes_the_one_is_shown_that_was_named(world):
    """The other, in a namespace, is heard on the same /diagnostics and has another model."""
    with world.calibration_node("model:=A1"):
        port = subprocess.Popen(
            command("run", "--watch", "-p", "model:=M5", "--ros-args", "-r", "__ns:=/port"), env=environment(world),
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        elsewhere = [
            subprocess.Popen(
                command("watch", *named), env=environment(world), cwd=ROOT, stdout=subprocess.PIPE, text=True
            )
            for named in ([], ["--node", "/port/dvl_calibration"])
        ]
        shown = [each.stdout.readline().partition(" ")[0] for each in (port, *elsewhere)]
        for each in (*elsewhere, port):
            each.send_signal(signal.SIGINT)
            each.communicate(timeout=PATIENCE_S)
    assert shown == ["M5", "A1", "M5"]


def test_a_node_that_cannot_start_says_why_and_watching_ends(world):
    done = subprocess.run(
        command("run", "--watch", "-p", "result_file:=/no/such/folder/r.yaml"),
        env=environment(world), cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    assert "the folder /no/such/folder does not exist" in done.stderr and done.stderr.count("\n") == 1


def test_bad_ros_arguments_are_said_without_a_traceback(world):
    done = subprocess.run(
        command("run", "--watch", "--ros-args", "-r", "__ns:=bad//ns"),
        env=environment(world), cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]  # after rcl's own log
    assert last.startswith("dvl-calib run: ") and "__ns:=bad//ns" in last and "Traceback" not in done.stderr


def test_the_view_needs_no_ros():
    code = "import sys; sys.modules['rclpy'] = None; import dvl_calib_ros.cli.live_view, dvl_calib_ros.node.status"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
