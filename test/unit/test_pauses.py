"""Times in which the process did not run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.node.diagnostics import PAUSE_S, Pauses, steady_s


@given(steps=st.lists(st.floats(0.01, 100.0), max_size=50))
def test_the_clock_stands_still_while_the_process_does_and_only_then(steps):
    now = 1000.0
    pauses = Pauses(now)
    running = 0.0
    for step in steps:
        now += step
        running += 0.0 if step > PAUSE_S else step
        assert abs(pauses.running_s(now) - 1000.0 - running) < 1e-6
    assert abs(sum(pauses.within(1e9)) + running - sum(steps)) < 1e-6


def test_a_pause_is_told_of_for_a_minute_of_running():
    pauses = Pauses(0.0)
    for now in (1.0, 2.0, 62.0, 63.0):
        pauses.running_s(now)
    assert pauses.within(60.0) == [60.0]
    for now in range(64, 122):
        pauses.running_s(float(now))
    assert pauses.within(60.0) == [60.0]
    pauses.running_s(123.0)
    assert pauses.within(60.0) == []


def test_the_clock_goes_on_while_a_process_is_stopped():
    script = "from dvl_calib_ros.node.diagnostics import *; print(steady_s(), flush=True); input(); print(steady_s())"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        first = float(process.stdout.readline())
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        process.send_signal(signal.SIGCONT)
        assert float(process.communicate("\n")[0]) - first >= 0.3
    assert steady_s() > first
