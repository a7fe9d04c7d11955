"""The live node: CPU against a subscriber that only republishes, and 1000 Hz for a minute."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from ..io.yaml_files import load_yaml
from . import Measurement

CPU_TARGET = 2.0
ROUNDS = 3
MEGABYTE = 1 << 20

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
    """CPU per DVL sample at 50 Hz with GNSS at 10 Hz, every model in the bank; in turns with the peer."""
    ours, peer = [], []
    for _ in range(ROUNDS):
        ours.append(_cpu_per_sample([sys.executable, "-m", "dvl_calib_ros.node.main"], 50.0, 20.0))
        peer.append(_cpu_per_sample([sys.executable, "-c", _REPUBLISHER], 50.0, 20.0))
    ratio = min(ours) / min(peer)
    return [
        Measurement(
            "node, CPU per DVL sample at 50 Hz (GNSS at 10 Hz, all models)",
            f"{1e6 * min(ours):.0f} µs",
            f"{1e6 * min(peer):.0f} µs (rclpy subscriber that republishes)",
            f"{ratio:.2f}",
            f"<= {CPU_TARGET:.0f}",
            ratio <= CPU_TARGET,
        )
    ]


def measure_rate() -> list[Measurement]:
    """1000 Hz for 60 s from a reliable publisher: what the node received, and its memory early and late."""
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "result.yaml"
        command = [sys.executable, "-m", "dvl_calib_ros.node.main", "--ros-args", "-p", f"result_file:={saved}"]
        environment = _environment()
        with _process(command, environment) as node:
            publisher = _publish(environment, 1000.0, 10.0, 60.0)
            time.sleep(15.0)
            early = _resident(node.pid)
            sent = int(publisher.communicate(timeout=120)[0])
            time.sleep(2.0)
            late = _resident(node.pid)
            node.send_signal(signal.SIGINT)
            node.wait(30)
        received = load_yaml(saved, "result file")["counts"]["dvl"]["accepted"]
    return [
        Measurement(
            "node at 1000 Hz for 60 s, reliable publisher: samples",
            f"{received} used", f"{sent} sent", f"{sent - received} lost", "0 lost", received == sent,
        ),
        Measurement(
            "node at 1000 Hz: memory after 60 s against after 15 s",
            f"{late / MEGABYTE:.1f} MB", f"{early / MEGABYTE:.1f} MB", f"{(late - early) / MEGABYTE:+.1f} MB",
            "flat (< 1 MB)", late - early < MEGABYTE,
        ),
    ]  # fmt: skip


def _environment() -> dict[str, str]:
    return os.environ | {"ROS_DOMAIN_ID": str(random.randint(1, 100)), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def _process(command: list[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True)


def _publish(environment: dict[str, str], dvl_rate: float, gnss_rate: float, seconds: float) -> subprocess.Popen[str]:
    arguments = [str(value) for value in (dvl_rate, gnss_rate, seconds)]
    command = [sys.executable, "-m", "dvl_calib_ros.benchmark.publisher", *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)


def _cpu_per_sample(command: list[str], rate: float, seconds: float) -> float:
    """CPU time (s) of a process per message that is published to it, start-up and discovery left out."""
    environment = _environment()
    with _process(command, environment) as process:
        publisher = _publish(environment, rate, 10.0, seconds)
        time.sleep(5.0)  # both are up and matched: the rest is steady
        before, started = _cpu_seconds(process.pid), time.monotonic()
        time.sleep(seconds - 7.0)
        used, elapsed = _cpu_seconds(process.pid) - before, time.monotonic() - started
        publisher.communicate(timeout=60)
        process.send_signal(signal.SIGINT)
        process.wait(30)
    return used / (elapsed * rate)


def _cpu_seconds(pid: int) -> float:
    """CPU time of all threads of a process, to the nanosecond (Linux)."""
    tasks = Path(f"/proc/{pid}/task")
    return sum(int((task / "schedstat").read_text().split()[0]) for task in tasks.iterdir()) * 1e-9


def _resident(pid: int) -> int:
    """Resident memory of a process, bytes (Linux)."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
