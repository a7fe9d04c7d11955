"""Replay of an hour of data against reading and deserialising the same messages with rosbags."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

from . import DifferentWorkError, Measurement

SECONDS = 3600.0
TARGET = 0.4
# The columns of a recording are kept: 60 MB for this hour
MEGABYTES = 200.0
ROUNDS = 3

# Each runs in a process of its own, so that CPU time and peak memory are its alone.
_OURS = """
from pathlib import Path
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.replay.replay import replay
def work(bag):
    counts = replay([Path(bag)], Parameters()).result.counts
    return sum(counts[stream]["received"] for stream in ("dvl", "reference", "imu"))
"""
_PEER = """
from pathlib import Path
from rosbags.highlevel import AnyReader
def work(bag):
    read = 0
    with AnyReader([Path(bag)]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            read += 1
    return read
"""
_MEASURE = r"""
import json, re, sys, time
started = time.process_time()
read = work(sys.argv[1])
peak = int(re.search(r"VmHWM:\s*(\d+)", open("/proc/self/status").read()).group(1)) / 1024
print(json.dumps([time.process_time() - started, peak, read]))
"""


def measure(quick: bool = False) -> list[Measurement]:
    """An hour of DVL and GNSS (in ENU) at 10 Hz and IMU at 100 Hz; memory beside a sixth of it. quick: one round."""
    with tempfile.TemporaryDirectory() as folder:
        long, short = Path(folder) / "hour", Path(folder) / "sixth"
        for path, seconds in ((long, SECONDS), (short, SECONDS / 6)):
            scenario = Scenario(
                seconds=seconds, dvl_rate=10, gnss_rate=10, imu_rate=100, errors=DvlErrors(beam_std=0.005)
            )
            write_bag(scenario, path, Storage.MCAP, Compression.NONE)
        # in turns, best of each: what else the machine does only ever adds
        rounds = [(_run(_OURS, long), _run(_PEER, long)) for _ in range(1 if quick else ROUNDS)]
        short_run = _run(_OURS, short)
    ours, peer = (min(each.seconds for each in side) for side in zip(*rounds, strict=True))
    memory = min(own.megabytes for own, _ in rounds)
    read = {each.messages for both in rounds for each in both}
    if len(read) > 1:
        raise DifferentWorkError(f"replay and rosbags do not read the same number of messages: {sorted(read)}")
    return [
        Measurement(
            "replay of 1 h (DVL, GNSS 10 Hz, IMU 100 Hz), CPU",
            f"{ours:.2f} s",
            f"{peer:.2f} s (rosbags, read and deserialise)",
            f"{ours / peer:.2f}",
            f"<= {TARGET}",
            ours / peer <= TARGET,
            ours / peer,
        ),
        Measurement(
            "replay, peak memory of 1 h against 10 min",
            f"{memory:.0f} MB",
            f"{short_run.megabytes:.0f} MB",
            f"{memory / short_run.megabytes:.2f}",
            f"<= {MEGABYTES:g} MB",
            memory <= MEGABYTES,
            memory / short_run.megabytes,
        ),
    ]


class _Cost(NamedTuple):
    """CPU time (s), peak memory (MB), and how many messages that was for."""

    seconds: float
    megabytes: float
    messages: int


def _run(work: str, bag: Path) -> _Cost:
    done = subprocess.run([sys.executable, "-c", work + _MEASURE, str(bag)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return _Cost(*json.loads(done.stdout))
