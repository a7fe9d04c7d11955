"""The live node: CPU and latency against a subscriber that only republishes, 1000 Hz for a minute, and the soak."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import theilslopes

from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.cli.demo import private_domain
from dvl_calib_ros.disk.text_files import load_yaml

from . import Measurement

CPU_TARGET = 1.8
LATENCY_TARGET = 1.8
# The soak: rates (Hz) of an ordinary vehicle, and how much faster they come.
SOAK_MINUTES = 10.0
SOAK_RATES = {"dvl": 5.0, "gnss": 5.0, "imu": 20.0}
SOAK_SPEED = 10.0
# Operation (s) sent first, as fast as possible: queues grow as in a stall of the machine, and then stay.
SOAK_BURST_S = 200.0
# Share of a soak after which memory and CPU are to be steady: the streams of 40 minutes that `full` keeps are full.
SOAK_WARM_UP = 0.45
MEMORY_TARGET_MB_PER_H = 1.0
CPU_GROWTH_TARGET = 1.1
ROUNDS = 3
# Number of windows in which CPU is measured, their length (s), and the time to start before the first (s).
WINDOWS, WINDOW_S, STARTING_S = 12, 3.0, 8.0
MEGABYTE = 1 << 20

_NODE = [sys.executable, "-m", "dvl_calib_ros.node.main"]
_CORRECTED = "dvl_calibration/calibrated_twist"
_REPUBLISHER = """
import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped as Twist
rclpy.init()
node = rclpy.create_node("republisher")
publisher = node.create_publisher(Twist, "republished", 10)
node.create_subscription(Twist, "dvl/twist", publisher.publish, 1000)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""


def measure_cpu() -> list[Measurement]:
    """CPU per DVL sample at 50 Hz with GNSS at 10 Hz, every model in the bank.

    Node and peer run together on the same messages, so other load affects both. The best of some windows counts.
    """
    ours, peer = _cpu_per_sample([_NODE, [sys.executable, "-c", _REPUBLISHER]], 50.0)
    ratio = ours / peer
    return [
        Measurement(
            "node, CPU per DVL sample at 50 Hz (GNSS at 10 Hz, all models)",
            f"{1e6 * ours:.0f} µs",
            f"{1e6 * peer:.0f} µs (rclpy subscriber that republishes)",
            f"{ratio:.2f}",
            f"<= {CPU_TARGET:g}",
            ratio <= CPU_TARGET,
            ratio,
        )
    ]


def measure_latency() -> list[Measurement]:
    """From a DVL message's publishing to the return of the estimate with its stamp, at 50 Hz with GNSS at 10 Hz.

    The node runs M7, which has an estimate for every DVL message; those with GNSS wait for the next GNSS sample. In
    turns with the peer, and the best of each: a machine that does something else at times must not decide.
    """
    ours, peer = [], []
    for _ in range(ROUNDS):
        ours.append(_latencies_s([*_NODE, "--ros-args", "-p", "model:=M7"], "dvl_calibration/estimate"))
        peer.append(_latencies_s([sys.executable, "-c", _REPUBLISHER], "republished"))
    return [
        Measurement(
            f"node, DVL message to estimate and back, 50 Hz: {name}",
            f"{1e3 * mine:.2f} ms", f"{1e3 * theirs:.2f} ms (rclpy subscriber that republishes)",
            f"{mine / theirs:.2f}", f"<= {LATENCY_TARGET:g}", mine <= LATENCY_TARGET * theirs,
            mine / theirs,
        )
        for name, mine, theirs in zip(("p50", "p99"), np.min(ours, axis=0), np.min(peer, axis=0), strict=True)
    ]  # fmt: skip


def measure_rate() -> list[Measurement]:
    """1000 Hz for 60 s from a reliable publisher: samples received, and memory early and late."""
    with _running_node() as (node, environment):
        publisher = _publish(environment, dvl_rate=1000.0, gnss_rate=10.0, seconds=60.0, echo=_CORRECTED)
        time.sleep(15.0)
        early = _resident(node.process.pid)
        sent = _report(publisher)["sent"]
        late = _resident(node.process.pid)
        received = node.stop()["dvl"]["accepted"]
    return [
        Measurement(
            "node at 1000 Hz for 60 s, reliable publisher: samples",
            f"{received} used", f"{sent} sent", f"{sent - received} lost", "0 lost", received == sent,
            received / sent, True,
        ),
        Measurement(
            "node at 1000 Hz: memory after 60 s against after 15 s",
            f"{late / MEGABYTE:.1f} MB", f"{early / MEGABYTE:.1f} MB", f"{(late - early) / MEGABYTE:+.1f} MB",
            "flat (< 1 MB)", late - early < MEGABYTE, late / early,
        ),
    ]  # fmt: skip


def measure_soak(minutes: float = SOAK_MINUTES) -> list[Measurement]:
    """Minutes of operation at ten times the usual rates: samples lost, growth of memory and of CPU."""
    with _running_node(f"max_latency:={SOAK_BURST_S}") as (node, environment):
        rates = {f"{name}_rate": rate for name, rate in SOAK_RATES.items()}
        publisher = _publish(
            environment,
            **rates,
            seconds=60.0 * minutes + SOAK_BURST_S,
            speed=SOAK_SPEED,
            burst=SOAK_BURST_S,
            echo=_CORRECTED,
        )
        usage = _watch(node.process.pid, publisher)
        sent = _report(publisher)["sent"]
        received = node.stop()["dvl"]["accepted"]
    steady = usage[usage[:, 0] > usage[-1, 0] * SOAK_WARM_UP]
    hours = steady[:, 0] * SOAK_SPEED / 3600.0
    growth = float(theilslopes(steady[:, 1] / MEGABYTE, hours).slope)
    first, second = _cpu_shares(steady)
    what = f"soak, {minutes:g} min of operation at {SOAK_SPEED:.0f} times the rates (DVL 5, GNSS 5, IMU 20 Hz)"
    return [
        Measurement(
            f"{what}: samples", f"{received} used", f"{sent} sent", f"{sent - received} lost", "0 lost",
            received == sent, received / sent, True,
        ),
        Measurement(
            "soak: memory, trend over an hour of operation", f"{steady[-1, 1] / MEGABYTE:.1f} MB",
            f"{steady[0, 1] / MEGABYTE:.1f} MB (after 45 %)", f"{growth:+.2f} MB/h",
            f"< {MEMORY_TARGET_MB_PER_H:g} MB/h", growth < MEMORY_TARGET_MB_PER_H,
            float(steady[-1, 1] / steady[0, 1]),
        ),
        Measurement(
            "soak: CPU, second half of the rest against the first", f"{100 * second:.1f} %", f"{100 * first:.1f} %",
            f"{second / first:.2f}", f"<= {CPU_GROWTH_TARGET}", second <= CPU_GROWTH_TARGET * first, second / first,
        ),
    ]  # fmt: skip


def _watch(pid: int, publisher: subprocess.Popen[str]) -> Array:
    """Time (s), resident memory (bytes) and CPU time (s) of a process, every second while the publisher runs (N, 3)."""
    started, rows = time.monotonic(), []
    while publisher.poll() is None:
        rows.append((time.monotonic() - started, _resident(pid), _cpu_seconds(pid)))
        time.sleep(1.0)
    return np.array(rows)


def _cpu_shares(usage: Array) -> tuple[float, float]:
    """Share of a processor used in the first and in the second half."""
    middle = len(usage) // 2
    halves = (usage[: middle + 1], usage[middle:])
    first, second = (float((half[-1, 2] - half[0, 2]) / (half[-1, 0] - half[0, 0])) for half in halves)
    return first, second


class _Node(NamedTuple):
    process: subprocess.Popen[str]
    result_file: Path

    def stop(self) -> dict[str, Any]:
        """Its counts at the end."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)
        return load_yaml(self.result_file, "result file")["counts"]


@contextmanager
def _running_node(*parameters: str) -> Iterator[tuple[_Node, dict[str, str]]]:
    """The node with (name:=value) parameters, and the environment in which it is heard."""
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "result.yaml"
        given = [word for each in (f"result_file:={saved}", *parameters) for word in ("-p", each)]
        environment = _environment()
        with _process([*_NODE, "--ros-args", *given], environment) as process:
            try:
                yield _Node(process, saved), environment
            finally:
                process.kill()


def _latencies_s(command: list[str], echo: str) -> tuple[float, float]:
    """p50 and p99."""
    environment = _environment()
    with _process(command, environment) as process:
        publisher = _publish(environment, dvl_rate=50.0, gnss_rate=10.0, seconds=30.0, echo=echo)
        report = _report(publisher)
        process.kill()  # it has nothing to save; a peer that does not hear SIGINT was waited for for ever
    return report["p50"], report["p99"]


def _environment() -> dict[str, str]:
    return os.environ | private_domain()


def _process(command: list[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True)


def _publish(environment: dict[str, str], **options: Any) -> subprocess.Popen[str]:
    """The vehicle of `publisher`, with its options."""
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in options.items()]
    command = [sys.executable, "-m", "benchmarks.publisher", *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def _report(publisher: subprocess.Popen[str]) -> dict[str, Any]:
    said = publisher.communicate()[0]
    if publisher.returncode:
        raise RuntimeError("the benchmark's publisher failed, see above; does the node run?")
    return json.loads(said)


def _cpu_per_sample(commands: list[list[str]], rate: float) -> list[float]:
    """CPU time (s) of each of some processes per message that is published to all, start-up and discovery left out."""
    environment = _environment()
    with ExitStack() as running:
        processes = [running.enter_context(_process(command, environment)) for command in commands]
        time.sleep(STARTING_S)
        publisher = _publish(environment, dvl_rate=rate, gnss_rate=10.0, seconds=WINDOWS * WINDOW_S + 10.0)
        time.sleep(5.0)  # all are up and matched: the rest is steady
        used = []
        for _ in range(WINDOWS):
            before, started = [_cpu_seconds(process.pid) for process in processes], time.monotonic()
            time.sleep(WINDOW_S)
            after, samples = [_cpu_seconds(process.pid) for process in processes], (time.monotonic() - started) * rate
            used.append((np.array(after) - before) / samples)
        publisher.communicate(timeout=60)
        for process in processes:
            process.kill()  # as above
    return np.min(used, axis=0).tolist()


def _cpu_seconds(pid: int) -> float:
    """CPU time of all threads of a process, to the nanosecond (Linux)."""
    tasks = Path(f"/proc/{pid}/task")
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks.iterdir()) * 1e-9


def _resident(pid: int) -> int:
    """Resident memory of a process, bytes (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
