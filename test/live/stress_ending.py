"""Ends nodes at any moment, two at once: ``python test/live/stress_ending.py --ends 500``; 1 if one end is unclean.

Half of them end within the first moments of their start, the other half while data come. An end is clean if its exit
code is 0, nothing is said but that the result is saved, and the result file is whole.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2])]

from conftest import ROOT  # noqa: E402
from geometry_msgs.msg import TwistWithCovarianceStamped  # noqa: E402
from ros import PATIENCE_S, World  # noqa: E402

from dvl_calib_ros.errors import InputError  # noqa: E402
from dvl_calib_ros.files.result_file import load_result  # noqa: E402

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# After its first statement, s. Until then Python itself comes up, which answers Ctrl-C with a traceback of its own.
START_S = (0.0, 0.7)
DATA_S = (0.0, 0.5)


class Feed:
    """Sends DVL and GNSS velocities to every node of a domain, as fast as a vehicle's are."""

    def __init__(self, world: World) -> None:
        make = world.node.create_publisher
        self._topics = [make(TwistWithCovarianceStamped, topic, 100) for topic in ("dvl/twist", "gnss/twist")]
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        for number in range(10_000_000):
            if self._ending.wait(0.005):
                return
            for publisher, frame in zip(self._topics, ("dvl_link", "base_link"), strict=True):
                message = TwistWithCovarianceStamped()
                message.header.frame_id = frame
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(10**18 + number * 5_000_000, 10**9)
                message.twist.twist.linear.x, message.twist.twist.linear.y = 1.5, 0.01 * (number % 7)
                publisher.publish(message)

    def end(self) -> None:
        self._ending.set()
        self._thread.join()


def wait_for_first_statement(pid: int) -> None:
    """Until SIGTERM is caught, which Python by itself does not."""
    bit = 1 << (signal.SIGTERM - 1)
    while True:
        status = Path(f"/proc/{pid}/status").read_text()
        if int(status.partition("SigCgt:")[2].split()[0], 16) & bit:
            return
        time.sleep(0.001)


def unclean(domain: int, seed: int) -> str:
    """What is wrong with the end of one node, '' if nothing is."""
    chance = random.Random(seed)
    number, at_start = chance.choice(SIGNALS), seed % 2 == 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.yaml"
        command = [sys.executable, "-m", "dvl_calib_ros.node.main", "--ros-args", "-p", f"result_file:={file}"]
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1",
        }  # fmt: skip
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
        )
        said = ""
        if at_start:
            wait_for_first_statement(process.pid)
            time.sleep(chance.uniform(*START_S))
        else:
            said = process.stdout.readline()  # that it runs
            time.sleep(chance.uniform(*DATA_S))
        process.send_signal(number)
        if chance.random() < 0.3:  # the impatient press it twice
            time.sleep(chance.uniform(0.0, 0.1))
            process.send_signal(number)
        try:
            said += process.communicate(timeout=PATIENCE_S)[0]
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # which tells where each thread is
            return f"seed {seed}: did not end\n{said}{process.communicate()[0]}"
        others = [line for line in said.splitlines() if "[INFO]" not in line and f"saved to {file}" not in line]
        if process.returncode or others:
            return f"seed {seed} ({number.name}, {'start' if at_start else 'data'}): {process.returncode}, {others}"
        left = sorted(each.name for each in Path(folder).iterdir())
        try:
            document = load_result(file)[0] if left else {"used": 0}
        except InputError as error:
            return f"seed {seed}: {error}"
        if left not in ([], ["result.yaml"]) or (not at_start and not document["counts"]):
            return f"seed {seed}: {left}"
        return ""


def stress(ends: int, first_seed: int = 0, at_once: int = 2) -> list[str]:
    """What is wrong with so many ends."""
    world = World()
    feed = Feed(world)
    try:
        with ThreadPoolExecutor(at_once) as pool:
            found = pool.map(lambda seed: unclean(world.domain, seed), range(first_seed, first_seed + ends))
            return [each for each in found if each]
    finally:
        feed.end()
        world.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ends", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began = time.monotonic()
    problems = stress(options.ends, options.seed)
    print(*problems, sep="\n")
    print(f"{options.ends - len(problems)} of {options.ends} ends clean, {time.monotonic() - began:.0f} s")
    sys.exit(bool(Counter(problems)))
