"""Ctrl-C, kill, a closed terminal, a parent that is gone: at any moment the node ends cleanly and loses nothing."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from conftest import ROOT
from live_fixtures import Live, Offline, assert_agree, received, sent
from ros import PATIENCE_S, until
from stress_ending import stress

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.disk.text_files import load_yaml
from dvl_calib_ros.node.main import parameter_files
from dvl_calib_ros.node.shutdown import END_SIGNALS, Ending
from dvl_calib_ros.simulation.scenario import Scenario, simulate

# ---------------------------------------------------------------- the flag


@pytest.mark.parametrize("number", END_SIGNALS)
def test_a_signal_becomes_a_flag_wakes_who_waits_and_raises_nothing(number):
    before = signal.getsignal(number)
    told = threading.Event()
    with Ending() as ending:
        assert not ending.requested
        ending.call_on_request(told.set)
        os.kill(os.getpid(), number)
        assert told.wait(10.0) and ending.requested
        late = threading.Event()
        ending.call_on_request(late.set)
        assert late.is_set()
    assert signal.getsignal(number) is signal.SIG_IGN  # what comes while the process ends
    signal.signal(number, before)


IN_THE_MIDST = """
import signal, sys
from dvl_calib_ros.node.shutdown import Ending

def again(frame, event, argument):
    global left
    if left and frame.f_code.co_name != "again":
        left -= 1
        signal.raise_signal(signal.SIGTERM)

with Ending() as ending:
    left = 100
    sys.setprofile(again)
    signal.raise_signal(signal.SIGINT)
    sys.setprofile(None)
    assert ending.requested
"""


def test_a_signal_that_comes_while_another_is_taken_does_not_wait_for_it():
    """It did, one time in some thousands: both set an Event, whose lock the first one held."""
    subprocess.run([sys.executable, "-c", IN_THE_MIDST], cwd=ROOT, timeout=PATIENCE_S, check=True)


def test_who_is_told_is_told_again_until_it_has_heard(monkeypatch):
    """A wake-up that the middleware loses must not leave a node that waits for ever."""
    monkeypatch.setattr("dvl_calib_ros.node.shutdown.REPEATED_EVERY_S", 0.2)
    before = signal.getsignal(signal.SIGINT)
    told = threading.Semaphore(0)
    with Ending() as ending:
        ending.call_on_request(told.release)
        os.kill(os.getpid(), signal.SIGINT)
        assert all(told.acquire(timeout=10.0) for _ in range(3))
        ending.stop_calling()
        time.sleep(0.1)  # a call that is under way
        while told.acquire(blocking=False):
            pass
        assert not told.acquire(timeout=1.0)
    signal.signal(signal.SIGINT, before)


def test_without_a_signal_everything_is_afterwards_as_it_was():
    before = [signal.getsignal(number) for number in END_SIGNALS]
    threads = threading.active_count()
    with Ending() as ending:
        assert signal.getsignal(signal.SIGINT) not in before
    assert not ending.requested
    assert [signal.getsignal(number) for number in END_SIGNALS] == before and threading.active_count() == threads


def test_a_pipe_that_is_closed_is_a_request():
    reading, writing = os.pipe()
    told = threading.Event()
    with Ending(closed=reading) as ending:
        ending.call_on_request(told.set)
        os.close(writing)
        assert told.wait(10.0)
    os.close(reading)
    for number in END_SIGNALS:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)


def test_parameter_files_are_found_where_rcl_looks_for_them():
    words = ["--params-file", "no", "--ros-args", "--params-file", "a", "-p", "x:=1", "--params-file", "b", "--"]
    assert [*map(str, parameter_files([*words, "--params-file", "no"]))] == ["a", "b"]
    assert [*parameter_files([])] == []  # ros2 run without any


# ---------------------------------------------------------------- the node


@pytest.mark.slow
def test_an_interrupt_under_data_cuts_no_sample_short_so_the_saved_result_is_a_replay_of_what_was_received(
    world, tmp_path
):
    run = simulate(Scenario(trajectory="figure8", seconds=400, dvl_rate=5, gnss_rate=5, imu_rate=5))
    samples = sorted([*run.imu, *run.gnss, *run.dvl], key=lambda sample: sample.stamp_ns)
    messages = [sent(sample) for sample in samples]
    saved = tmp_path / "result.yaml"
    given = {"max_latency": 600.0}
    with world.calibration_node("max_latency:=600.0", f"result_file:={saved}", stop=signal.SIGINT) as process:
        live = Live(world, process, saved)
        publishing = threading.Thread(target=live.publish, args=[messages], daemon=True)
        publishing.start()
        until(lambda: len(live._corrected) > 100, "data to come")
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)
    publishing.join()
    assert process.returncode == 0 and "Traceback" not in process.output, process.output
    document = load_yaml(saved, "result file")
    count, left = received(document["counts"]), []
    assert 100 < count["dvl"] < len(run.dvl), "it was to end in the midst"
    for message in messages:
        if count[message.stream]:
            count[message.stream] -= 1
            left.append(message)
    assert_agree(document, Offline(Parameters(**given)).feed(left).calibrator.result())


@pytest.mark.slow
def test_a_view_that_is_killed_takes_its_node_with_it_and_the_node_saves(world, tmp_path):
    saved = tmp_path / "result.yaml"
    environment = os.environ | {"ROS_DOMAIN_ID": str(world.domain), "PYTHONPATH": str(ROOT)}
    view = subprocess.Popen(
        [sys.executable, "-m", "dvl_calib_ros.cli.main", "run", "--watch", "-p", f"result_file:={saved}"],
        env=environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert view.stdout.readline().startswith("unaided collecting")
    # asked of the system: a participant that hears late of a node that has gone keeps its name for ever
    (node,) = Path(f"/proc/{view.pid}/task/{view.pid}/children").read_text().split()
    ended = os.pidfd_open(int(node))
    view.kill()
    view.wait()
    assert select.select([ended], [], [], PATIENCE_S)[0], "the node goes on without its view"
    os.close(ended)
    assert load_yaml(saved, "result file")["counts"]


@pytest.mark.faults
def test_forty_ends_at_any_moment_are_clean():
    """Five hundred: python test/live/stress_ending.py"""
    assert stress(40, first_seed=int(time.time()) % 1_000_000) == []
