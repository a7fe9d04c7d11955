"""Replay and doctor of an hour of data, against reading and deserialising the same messages with rosbags."""

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
# The doctor replays the recording: it costs what a replay does
TARGET, TARGET_OF_DOCTOR, TARGET_OF_READING = 0.25, 0.3, 3.0
# The columns of a recording are kept: 60 MB for this hour
MEGABYTES = 200.0
ROUNDS = 3

# Each runs in a process of its own, so that CPU time and peak memory are its alone.
_OURS = """
from pathlib import Path
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.bag_replay.replay import replay
def work(bag):
    counts = replay([Path(bag)], Parameters()).result.counts
    return sum(counts[stream]["received"] for stream in ("dvl", "reference", "imu"))
"""
_DOCTOR = """
from pathlib import Path
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.examination.examine import examine
def work(bag):
    return sum(content.messages for content in examine([Path(bag)], Parameters()).contents)
"""
_READING = """
from pathlib import Path
from dvl_calib_ros.recordings.recording import open_recording
def work(bag):
    return sum(open_recording([Path(bag)]).counts.values())
"""
_DECOMPRESSING = """
import sys
from pathlib import Path
from mcap.reader import make_reader
if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd
def work(bag):
    (path,) = Path(bag).glob("*.mcap")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        for each in summary.chunk_indexes:
            file.seek(each.chunk_start_offset + each.chunk_length - each.compressed_size)
            zstd.decompress(file.read(each.compressed_size))
    return summary.statistics.message_count
"""
# What another reader of bags does; `work` returns how many messages it read.
PEER = """
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
        long, short, packed = (Path(folder) / name for name in ("hour", "sixth", "packed"))
        for path, seconds, compression in (
            (long, SECONDS, Compression.NONE), (short, SECONDS / 6, Compression.NONE),
            (packed, SECONDS, Compression.CHUNK),
        ):  # fmt: skip
            scenario = Scenario(
                seconds=seconds, dvl_rate=10, gnss_rate=10, imu_rate=100, errors=DvlErrors(beam_std=0.005)
            )
            write_bag(scenario, path, Storage.MCAP, compression)
        works = (_OURS, long), (_DOCTOR, long), (PEER, long), (_READING, packed), (_DECOMPRESSING, packed)
        # in turns, best of each: what else the machine does only ever adds
        rounds = [[_run(*each) for each in works] for _ in range(1 if quick else ROUNDS)]
        short_run = _run(_OURS, short)
    replayed, doctor, peer, reading, unpacking = (
        min(each.seconds for each in side) for side in zip(*rounds, strict=True)
    )
    memory = min(own.megabytes for own, *_ in rounds)
    read = {each.messages for all_works in rounds for each in all_works}
    if len(read) > 1:
        raise DifferentWorkError(f"replay, doctor and rosbags do not read the same number of messages: {sorted(read)}")
    by_rosbags = f"{peer:.2f} s (rosbags, read and deserialise)"
    by_zstd = f"{unpacking:.2f} s (zstd)"
    return [
        *(
            Measurement(
                what, f"{ours:.2f} s", said, f"{ours / than:.2f}", f"<= {most}", ours / than <= most, ours / than
            )
            for what, ours, than, said, most in (
                ("replay of 1 h (DVL, GNSS 10 Hz, IMU 100 Hz), CPU", replayed, peer, by_rosbags, TARGET),
                ("doctor of the same hour, CPU", doctor, peer, by_rosbags, TARGET_OF_DOCTOR),
                ("opening the hour against unpacking its chunks, CPU", reading, unpacking, by_zstd, TARGET_OF_READING),
            )
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
