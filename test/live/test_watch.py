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
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pyte
import pytest
from conftest import ROOT
from rich.console import Console
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.filters.observability import observability
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.cli.watch import LINE_S, SILENCE_S, SURE_S, Keys, View, line, show
from dvl_calib_ros.files.result_file import result_document, save_result
from dvl_calib_ros.node.status import Status
from dvl_calib_ros.verdict.reasons import finding

PATIENCE_S = 30.0
VALUES = {
    "model": "full", "convergence": "coarse", "elapsed [s]": "754",
    "dvl rate [Hz]": "5.0", "dvl age [s]": "0", "gnss rate [Hz]": "1.0", "gnss age [s]": "3", "imu age [s]": "-",
    "mounting roll [deg]": "0.108", "sigma mounting roll [deg]": "1.177",
    "mounting yaw [deg]": "3.036", "sigma mounting yaw [deg]": "0.116",
    "mounting arm x [m]": "0.300", "sigma mounting arm x [m]": "not estimated",
    "worth": "3.45", "worth to the side": "2.83", "worth ahead": "1.96", "target": "2",
    "goal worth [%]": "75", "goal side [%]": "60", "goal ahead [%]": "100",
    "next": "drive straight, west (270°)", "next code": "NEXT_LEG", "seconds": "75", "seconds spread": "43",
    "driven N [s]": "120", "driven E [s]": "60",
}  # fmt: skip
GOOD = {"next": "good enough: save", "next code": "NEXT_IS_GOOD", "seconds": "-"}


def status(level=0, message="", received_s=100.0, **changes) -> Status:
    return Status(level, message, VALUES | changes, received_s)


def drawn(*arguments, width=110) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None, record=True)
    console.print(View(*arguments))
    return console.export_text()


# ---------------------------------------------------------------- drawing


def test_the_view_shows_the_mounting_what_it_is_worth_and_what_to_drive():
    text = drawn(status(), 100.5)
    assert text.startswith("model full   12 min 34 s\n")
    assert "\nDVL 5.0 Hz, 0 s ago   reference 1.0 Hz, 3 s ago   IMU none yet\n" in text
    assert "yaw     3.036 ±0.116°" in text and "arm x   0.300 m, as set" in text
    assert re.search(r"\ndrift  █{18}░{6}  75 %  3.45 m/km, goal 2\n", text)
    assert re.search(r"\n scale █{24} 100 %  1.96 m/km\n", text)
    assert "N█  NE   E▄  SE   S   SW   W   NW " in text
    assert "next: drive straight, west (270°), about 75 s ± 43 s until good enough" in text
    assert "phi" not in text and "skid" not in text
    longer = finding("LONGER_AS_LITTLE_SHOWN", before=3.9, now=3.45).sentence
    long = drawn(status(longer=longer, seconds="600", **{"seconds spread": "343"}), 100.5)
    assert "about 10 min ± 6 min until good enough" in long and "it takes longer than promised: the motion" in long


def test_good_enough_is_said_and_of_a_wrong_configuration_nothing_that_could_be_used():
    assert "next: good enough: save\n" in drawn(status(**GOOD), 100.0)
    back = drawn(status(**{"taken back": "no longer good enough: the model is unaided now"}), 100.0)
    assert "no longer good enough: the model is unaided now\n" in back and "next: drive straight" in back
    assert "not to be used" not in drawn(status(2, "no DVL message for 7 s"), 100.0)
    wrong = drawn(status(2, "the data contradict the configuration", usable="no", **GOOD), 100.0)
    assert "not to be used" in wrong and "good enough: save" not in wrong and "contradict the configuration" in wrong
    early = drawn(status(usable="no"), 100.0)
    assert "not to be used, not observable yet" in early and "next: drive straight" in early


@pytest.mark.parametrize(("level", "first"), [(2, "no usable DVL message for 13 s"), (1, "no GNSS for 13 s")])
def test_a_silent_sensor_comes_before_the_reason_why_it_takes_longer(level, first):
    longer = "it takes longer than promised"
    text = drawn(status(level, first, longer=longer, **{"finding 1": first, "finding 2": "another"}), 100.0)
    assert first in text and longer not in text and "+2 more (w)" in text


def test_of_an_unknown_frame_the_remedy_is_read_on_a_small_terminal_and_the_warning_is_there_once():
    warning = str(finding("REFERENCE_FRAME", frame_id="gps", base="base_link"))
    text = drawn(status(1, warning, **{"finding 1": warning}), 100.0, [], warning, width=80)
    said = " ".join(text.split())
    assert said.count("reference not used") == 1 and "set gnss_frame to body, enu or ned [REFERENCE_FRAME]" in said


def test_the_speed_of_sound_is_said_in_a_line_where_the_water_is_known():
    brief = "1497.3 m/s would take the scale out (the DVL used 1506.6)"
    assert f"speed of sound  {brief}\n" in drawn(status(**{"speed of sound": brief}), 100.0, width=80)
    assert "speed of sound" not in drawn(status(), 100.0)
    assert "speed of sound" not in drawn(status(2, "wrong", usable="no", **{"speed of sound": brief}), 100.0)


def test_what_another_process_says_can_neither_style_the_view_nor_move_the_cursor():
    evil = "[bold]\x1b[2J[/] \x07"
    text = drawn(status(1, evil, **dict.fromkeys(VALUES, evil)), 100.0, [evil], evil)
    assert text.count("[bold]") >= 4 and not {"\x1b", "\x07"} & set(text)
    assert drawn(status(**dict.fromkeys(VALUES, "nan")), 100.0) and drawn(status(**dict.fromkeys(VALUES, "inf")), 100.0)


class Asked:
    """A listener that remembers what was asked for."""

    answer = "saved to x.yaml"
    is_waiting = False

    def __init__(self) -> None:
        self.calls: list[str] = []

    def call(self, service: str) -> None:
        self.calls.append(service)


def test_keys_save_and_leave_and_forget_only_when_pressed_twice():
    listener = Asked()
    keys = Keys(listener)
    assert keys.press("s", 0.0) and listener.calls == ["save"] and keys.last_answer == "saved to x.yaml"
    assert keys.press("r", 1.0) and listener.calls == ["save"] and "again" in keys.last_answer
    assert keys.press("r", 1.0 + SURE_S) and listener.calls == ["save"]
    assert keys.press("r", 2.0 + SURE_S) and listener.calls == ["save", "reset"]
    keys.press("r", 9.0), keys.press("s", 9.1), keys.press("r", 9.2)
    assert listener.calls == ["save", "reset", "save"]
    assert not keys.press("q", 10.0)


def test_q_asks_before_a_worse_result_replaces_a_better_one():
    """Where the node ends with the view; a view of a node elsewhere just leaves."""
    for answer, key, calls in (
        ("saved to x.yaml", "", ["save"]),
        ("parameter result_file is not set", "", ["save"]),
        ("x.yaml is kept [RESULT_WORSE]", "n", ["save"]),
        ("x.yaml is kept [RESULT_WORSE]", "y", ["save", "save_anyway"]),
    ):
        listener = Asked()
        keys = Keys(listener, ends_node=True)
        listener.answer, listener.is_waiting = "save ...", True
        assert keys.press("q", 1.0) and not keys.has_left() and listener.calls == ["save"]
        listener.answer, listener.is_waiting = answer, False
        assert keys.has_left() == (not key)
        if key:
            assert (
                keys.last_answer.startswith("replace the better result? (y/n)  x.yaml is kept") and not keys.has_left()
            )
            assert keys.press("x", 2.0), "another key answers nothing"
            went_on = keys.press(key, 3.0)
            listener.answer = "saved to x.yaml"
            assert keys.has_left() if went_on else key == "n"
        assert listener.calls == calls


MOUNTED = {
    "mounting pitch [deg]": "-0.512", "sigma mounting pitch [deg]": "0.322",
    "mounting arm y [m]": "0.000", "sigma mounting arm y [m]": "not estimated",
    "mounting arm z [m]": "-0.120", "sigma mounting arm z [m]": "not estimated",
    "mounting scale [%]": "0.412", "sigma mounting scale [%]": "0.120",
    "mounting delay [s]": "0.102", "sigma mounting delay [s]": "0.011", "imu rate [Hz]": "50.0", "imu age [s]": "0",
}  # fmt: skip
WARNINGS = [
    str(finding("DVL_SILENT", seconds=7.0, topic="/dvl/velocity")),
    str(finding("CLOCKS_DIFFER", stream="GNSS", seconds=18.3, side="ahead of", other="DVL")),
    str(finding("TF_NOT_THERE")),
]
SEEN = {
    (80, 24): """\
model full   12 min 34 s
drift  ██████████████████░░░░░░  75 %  3.45 m/km, goal 2
next: drive straight, west (270°), about 75 s ± 43 s until good enough
s save  r r forget  w warnings  q quit
14:03:22 saved to /data/calibration.yaml

mounting now
roll    0.108 ±1.177°     pitch  -0.512 ±0.322°     yaw     3.036 ±0.116°
arm x   0.300 m, as set   arm y   0.000 m, as set   arm z  -0.120 m, as set
scale   0.412 ±0.120 %    delay   0.102 ±0.011 s against the IMU
no usable DVL message for 7 s; check the sensor, its driver and the topic
/dvl/velocity [DVL_SILENT]
+2 more (w)

DVL 5.0 Hz, 0 s ago   reference 1.0 Hz, 3 s ago   IMU 50.0 Hz, 0 s ago
 yaw   ██████████████░░░░░░░░░░  60 %  2.83 m/km
 scale ████████████████████████ 100 %  1.96 m/km
headings  N█  NE   E▄  SE   S   SW   W   NW
[INFO] model auto""",
    (40, 20): """\
model full   12 min 34 s
drift  ████░░  75 %  3.45 m/km, goal 2
next: drive straight, west (270°), about
75 s ± 43 s until good enough
s save  r r forget  w warnings  q quit
14:03:22 saved to /data/calibration.yaml
no usable DVL message for 7 s; check the
sensor, its driver and the topic …
+2 more (w)
mounting now
roll    0.108 ±1.177°
pitch  -0.512 ±0.322°
yaw     3.036 ±0.116°
arm x   0.300 m, as set
arm y   0.000 m, as set
arm z  -0.120 m, as set
scale   0.412 ±0.120 %
delay   0.102 ±0.011 s against the IMU
DVL 5.0 Hz, 0 s ago   reference 1.0 Hz,
3 s ago   IMU 50.0 Hz, 0 s ago""",
}


def seen_screens(monkeypatch, size: tuple[int, int], found: Status, keys: str) -> list[str]:
    """What an emulated terminal shows of the view after each of these keys. The answer to one comes a look later."""
    out, listener, screens = io.StringIO(), Asked(), []
    screen = pyte.Screen(*size)
    screen.set_mode(pyte.modes.LNM)
    listener.answer = ""
    pressed = iter(each for key in keys for each in (key, ""))

    def latest(_: float) -> Status:
        pyte.Stream(screen).feed(out.getvalue())
        out.seek(0), out.truncate()
        screens.append("\n".join(each.rstrip() for each in screen.display).rstrip())
        listener.answer = "14:03:22 saved to /data/calibration.yaml" if listener.calls else ""
        return found

    listener.latest = latest
    monkeypatch.setattr("dvl_calib_ros.cli.watch._single_keys", lambda: nullcontext(lambda: next(pressed)))
    monkeypatch.setattr("dvl_calib_ros.cli.watch.time.monotonic", lambda: 100.5)
    running = iter([True] * len(keys) + [False])
    console = Console(file=out, width=size[0], height=size[1], force_terminal=True, highlight=False)
    show(console, listener, lambda: next(running), ["[INFO] model auto"])
    latest(0.0)
    return screens[1:]


@pytest.mark.parametrize("size", SEEN)
def test_all_that_an_operator_needs_is_seen_on_a_small_terminal(monkeypatch, size):
    values = MOUNTED | {f"finding {number}": each for number, each in enumerate(WARNINGS, start=1)}
    found = status(2, "; ".join(WARNINGS), **values)
    first, saved, *told = seen_screens(monkeypatch, size, found, "s.www")
    assert saved == SEEN[size]
    fixed = [first.splitlines()[:4], *(each.splitlines()[:4] for each in told)]
    assert fixed == [saved.splitlines()[:4]] * 4, "what an operator looks for stays at its place"


def test_a_long_answer_hides_no_warning_on_a_small_terminal():
    values = MOUNTED | {f"finding {number}": each for number, each in enumerate(WARNINGS, start=1)}
    found = status(2, "; ".join(WARNINGS), **values, next="straight legs on opposite headings, at two speeds")
    console = Console(file=io.StringIO(), width=40, height=20, force_terminal=True, color_system=None)
    console.print(View(found, 100.5, (), "/data/calibration.yaml is kept: its result is better " * 3))
    shown = console.file.getvalue().splitlines()
    assert len(shown) <= 20 and "+2 more (w)" in shown and any("no usable DVL message" in each for each in shown)


@pytest.mark.parametrize("size", [(80, 24), (40, 20), (40, 12)])
def test_w_shows_all_warnings_a_screen_at_a_time(monkeypatch, size):
    found = status(2, "; ".join(WARNINGS), **{f"finding {n}": each for n, each in enumerate(WARNINGS, start=1)})
    screens = [each.splitlines() for each in seen_screens(monkeypatch, size, found, "wwww")]
    pages = screens[: int(re.search(r"page 1 of (\d) \(w goes on\)$", screens[0][-1])[1])]
    fixed = next(at for at, each in enumerate(pages[0]) if "[INFO]" in each) + 1
    told = " ".join(" ".join(each) for page in pages for each in [page[fixed:-1]])
    assert told == " ".join(f"{number}. {each}" for number, each in enumerate(WARNINGS, start=1))
    assert "mounting now" in screens[len(pages)], "after the last comes the mounting"


def test_faults_silence_and_waiting_are_said():
    assert "no DVL message for 7 s" in drawn(status(2, "no DVL message for 7 s"), 100.0)
    assert "nothing heard" not in drawn(status(), 100.0 + SILENCE_S)
    assert "nothing heard of the node for 9 s" in drawn(status(), 109.0)
    assert "waiting for the node" in drawn(None, 0.0)


def test_before_a_sample_nothing_looks_like_an_estimate_and_a_long_goal_is_one_line():
    before = status(usable="no", **{"samples used": "0", "worth": "50.36", "goal worth [%]": "0"})
    text = drawn(before, 100.0, width=40)
    assert "yaw     3.036°, as set" in text and "±0.116" not in text
    assert "\ndrift  ░░░░░░   0 %  50.36 m/km, goal 2\n" in text


def test_a_log_line_is_shown_without_its_stamp():
    text = drawn(status(), 100.0, ["[INFO] [1795830187.907451278] [dvl_calibration]: model auto"])
    assert "\nmodel auto\n" in text and "1795830187" not in text


def test_only_the_last_lines_of_the_log_are_shown_whatever_is_in_them():
    text = drawn(status(), 100.0, [f"line {i} [/bold] {'x' * 200}" for i in range(20)])
    assert "line 19 [/bold]" in text and "line 10 " not in text
    assert max(map(len, text.splitlines())) <= 110


def test_without_a_terminal_a_line_is_written_when_something_changes_and_now_and_then(monkeypatch):
    changes = [None, status(), status(), status(convergence="fine"), status(1, "check", convergence="fine")]
    statuses = iter([*changes, changes[-1], changes[-1]])
    clock = iter([99.5, 100.0, 100.5, 101.0, 101.5, 102.0, 102.5, 102.6 + LINE_S])
    monkeypatch.setattr("dvl_calib_ros.cli.watch.time.monotonic", lambda: next(clock))
    running = iter([True] * 7 + [False])
    out = io.StringIO()
    show(Console(file=out, width=40), SimpleNamespace(latest=lambda _: next(statuses)), lambda: next(running))
    lines = out.getvalue().splitlines()
    assert len(lines) == 4
    assert lines[0] == line(status()) and lines[0].startswith("full coarse: roll 0.108 ±1.177°, ")
    assert lines[1].startswith("full fine:") and lines[2].endswith("; check") and lines[3] == lines[2]


def test_without_a_terminal_it_is_said_that_no_node_answers(monkeypatch):
    clock = iter([100.0, 100.5, 105.5, 106.0])
    monkeypatch.setattr("dvl_calib_ros.cli.watch.time.monotonic", lambda: next(clock))
    running, out = iter([True] * 3 + [False]), io.StringIO()
    show(Console(file=out), SimpleNamespace(latest=lambda _: None), lambda: next(running))
    assert out.getvalue() == "waiting for the node's /diagnostics ... (same ROS_DOMAIN_ID?)\n"


@pytest.mark.parametrize("name", ["M3", "unaided"])
def test_progress_goes_from_the_prior_to_fine_by_the_logarithm(name):
    parameters = Parameters()
    calibrator = calibrate(make_samples(MatchedRun(dvl_std=0.01, gnss_std=0.01)), parameters)
    covariance = calibrator.estimate(name).covariance
    for entry in observability(MODELS[name], covariance, parameters):
        angle = entry.name.startswith("phi")
        prior = parameters.initial_std_misalignment if angle else parameters.initial_std_scale
        fine = 1e-3 * parameters.target_drift / math.sqrt(2.0)  # of an angle, rad, or a scale
        expected = math.log(prior / entry.std) / math.log(prior / fine)
        assert entry.progress == pytest.approx(min(max(expected, 0.0), 1.0))
    first = calibrate([]).estimate(name)
    assert [entry.progress for entry in first.observability] == pytest.approx([0.0] * MODELS[name].n_errors, abs=1e-9)


# ---------------------------------------------------------------- over DDS

rclpy = pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")


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
    from test_node import Publisher, twist

    saved = tmp_path / "result.yaml"
    with terminal(world, "run", "--watch", "-p", f"result_file:={saved}", "-p", "gnss_frame:=enu") as screen:
        Publisher(world).send(*(twist(1000 + i) for i in range(20)))
        for text in ("mounting now", "drift", "next: ", "model auto; parameters", "s save"):
            screen.until(text)
        seen = pyte.Screen(80, 24)
        pyte.Stream(seen).feed(screen.text)
        assert seen.display[0].startswith("model "), "the view begins in the first row"
        assert not saved.exists()
        screen.key(b"s")
        screen.until("saved to ")
        saved.unlink()
        screen.key(b"\x03")
        text = screen.rest()
        assert screen.process.wait(30) == 0
    assert saved.exists()
    assert f"saved to {saved}" in text and "Traceback" not in text
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")  # the cursor is back


@pytest.mark.slow
def test_q_does_not_replace_a_good_result_by_a_few_samples_without_asking(world, tmp_path):
    from test_node import Publisher, twist

    saved = tmp_path / "result.yaml"
    calibrated = result_document(calibrate(make_samples(MatchedRun(dvl_std=0.01, gnss_std=0.01))).result())
    save_result(saved, calibrated | {"verification": {"verdict": "accept", "reasons": ["so"]}})
    good = saved.read_bytes()
    with terminal(world, "run", "--watch", "-p", f"result_file:={saved}", "-p", "model:=M7") as screen:
        Publisher(world).send(twist(1000))
        screen.until("mounting")
        screen.until("DVL ")
        screen.key(b"q")
        screen.until("replace the better result? (y/n)")
        assert saved.read_bytes() == good
        screen.key(b"n")
        last = screen.rest().rstrip().splitlines()[-1]
        assert screen.process.wait(30) == 0
    assert saved.read_bytes() == good and (tmp_path / "result.newer.yaml").exists()
    assert "is kept, because it is better" in last


@pytest.mark.slow
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
        assert first.startswith("unaided collecting: roll 0.000°, as set")
        assert (watching.returncode, errors) == (0, "")
        assert node.poll() is None


@pytest.mark.slow
def test_of_two_nodes_the_one_is_shown_that_was_named(world):
    """The other, in a namespace, is heard on the same /diagnostics and has another model."""
    with world.calibration_node("model:=unaided"):
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
    assert shown == ["M5", "unaided", "M5"]


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
    code = "import sys; sys.modules['rclpy'] = None; import dvl_calib_ros.cli.watch, dvl_calib_ros.node.status"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
