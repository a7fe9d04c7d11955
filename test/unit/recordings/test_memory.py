"""How much memory it takes to open a recording, however long it is and whatever else is in it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from io_fixtures import IMU_TYPE, JAZZY, TWIST_TYPE
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Header, Schema, Statistics

MAGIC = b"\x89MCAP0\r\n"
START_NS = 1_700_000_000 * 10**9
CHUNK_S = 10
CAMERA = 9
CAMERA_CHUNK = 100 << 20
TYPES = JAZZY.types


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0):
    return TYPES["geometry_msgs/msg/Vector3"](x, y, z)


def header(frame: str):
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](1, 1), frame)


def twist(frame: str) -> bytes:
    inner = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        TYPES["geometry_msgs/msg/Twist"](vector(1.5), vector()), 1e-4 * np.eye(6).ravel()
    )
    return bytes(JAZZY.serialize_cdr(TYPES[TWIST_TYPE](header(frame), inner), TWIST_TYPE))


def imu() -> bytes:
    quaternion, covariance = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9)
    message = TYPES[IMU_TYPE](header("base_link"), quaternion, covariance, vector(), covariance, vector(), covariance)
    return bytes(JAZZY.serialize_cdr(message, IMU_TYPE))


def records(channel: int, data: bytes, times_ns: np.ndarray) -> np.ndarray:
    """(N,) message records, of one content, each with its own stamp."""
    names = {
        "opcode": ("u1", 0), "length": ("<u8", 1), "channel": ("<u2", 9), "log": ("<u8", 15), "publish": ("<u8", 23),
        "sec": ("<i4", 35), "nanosec": ("<u4", 39),
    }  # fmt: skip
    formats, offsets = zip(*names.values(), strict=True)
    dtype = np.dtype({"names": list(names), "formats": formats, "offsets": offsets, "itemsize": 31 + len(data)})
    rows = np.frombuffer(bytearray((bytes(31) + data) * len(times_ns)), dtype)
    rows["opcode"], rows["length"], rows["channel"] = 5, 22 + len(data), channel
    rows["log"] = rows["publish"] = times_ns
    rows["sec"], rows["nanosec"] = times_ns // 10**9, times_ns % 10**9
    return rows


class Writer:
    """An MCAP file, of chunks that are made elsewhere."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.indexes, self.counts = file, [], {}
        self.channels = [(1, "dvl/twist", TWIST_TYPE), (2, "gnss/twist", TWIST_TYPE), (3, "imu/data", IMU_TYPE),
                         (CAMERA, "camera/image", "sensor_msgs/msg/Image")]  # fmt: skip
        self.file.write(MAGIC + self._built(Header(profile="ros2", library="test")) + self._tables())

    def _built(self, *written) -> bytes:
        builder = RecordBuilder()
        for each in written:
            each.write(builder)
        return builder.end()

    def _tables(self) -> bytes:
        schemas = [
            Schema(
                id=number, name=kind, encoding="ros2msg", data=JAZZY.generate_msgdef(kind, ros_version=2)[0].encode()
            )
            for number, _, kind in self.channels
        ]
        channels = [
            Channel(id=number, topic=topic, message_encoding="cdr", metadata={}, schema_id=number)
            for number, topic, _ in self.channels
        ]
        return self._built(*schemas, *channels)

    def chunk(self, content: list[tuple[int, np.ndarray]], start_ns: int, end_ns: int) -> None:
        body = b"".join(rows.tobytes() for _, rows in content)
        at = self.file.tell()
        self.file.write(bytes([Opcode.CHUNK]) + (40 + len(body)).to_bytes(8, "little"))
        sizes = (start_ns, 8), (end_ns, 8), (len(body), 8), (0, 4), (0, 4), (len(body), 8)
        self.file.write(b"".join(value.to_bytes(size, "little") for value, size in sizes) + body)
        end, offsets, before = self.file.tell(), {}, 0
        for channel, rows in content:
            entries = np.column_stack([rows["log"], before + rows.itemsize * np.arange(len(rows), dtype=np.uint64)])
            before += rows.nbytes
            offsets[channel] = self.file.tell()
            index = (
                channel.to_bytes(2, "little") + entries.nbytes.to_bytes(4, "little") + entries.astype("<u8").tobytes()
            )
            self.file.write(bytes([Opcode.MESSAGE_INDEX]) + len(index).to_bytes(8, "little") + index)
            self.counts[channel] = self.counts.get(channel, 0) + len(rows)
        self.indexes.append(
            ChunkIndex(end - at, at, "", len(body), end_ns, self.file.tell() - end, offsets, start_ns, len(body))
        )

    def hole(self, start_ns: int) -> None:
        """A chunk of one image that takes no place on the disk."""
        at = self.file.tell()
        self.file.write(bytes([Opcode.CHUNK]) + (40 + CAMERA_CHUNK).to_bytes(8, "little"))
        self.file.seek(CAMERA_CHUNK + 40, 1)
        self.indexes.append(
            ChunkIndex(
                49 + CAMERA_CHUNK, at, "", CAMERA_CHUNK, start_ns + 10**9, 0, {CAMERA: at}, start_ns, CAMERA_CHUNK
            )
        )
        self.counts[CAMERA] = self.counts.get(CAMERA, 0) + 1

    def finish(self, seconds: int) -> None:
        self.file.write(self._built(DataEnd(data_section_crc=0)))
        start = self.file.tell()
        counts = sum(self.counts.values())
        statistics = Statistics(
            0, len(self.channels), self.counts, len(self.indexes), counts, START_NS + seconds * 10**9, START_NS, 0, 4
        )
        self.file.write(
            self._tables()
            + self._built(*self.indexes, statistics)
            + self._built(Footer(summary_start=start, summary_offset_start=0, summary_crc=0))
            + MAGIC
        )


def long_recording(path: Path, seconds: int, camera_chunks: int = 0) -> Path:
    """DVL 25 Hz, GNSS 10 Hz, IMU 200 Hz, and images between."""
    streams = (1, twist("dvl_link"), 25), (2, twist("base_link"), 10), (3, imu(), 200)
    with path.open("wb") as file:
        writer = Writer(file)
        for chunk in range(seconds // CHUNK_S):
            start_ns = START_NS + chunk * CHUNK_S * 10**9
            content = [
                (channel, records(channel, data, start_ns + np.arange(CHUNK_S * rate) * (10**9 // rate)))
                for channel, data, rate in streams
            ]
            writer.chunk(content, start_ns, start_ns + CHUNK_S * 10**9 - 1)
            if chunk < camera_chunks:
                writer.hole(start_ns)
        writer.finish(seconds)
    return path


MEASURED = """
import re, sys
from pathlib import Path
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.examination.examine import examine
from dvl_calib_ros.recordings.recording import open_recording
recording = open_recording([Path(sys.argv[1])])
if sys.argv[2] == "doctor":
    examine(recording, Parameters())
peak = int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read()).group(1)) / 1024
print(peak, *(recording.counts[topic] for topic in ("dvl/twist", "gnss/twist", "imu/data")))
"""


def measured(path: Path, what: str) -> tuple[float, list[int]]:
    """Peak memory (MB) of a process of its own, and how many messages it found of each topic."""
    done = subprocess.run([sys.executable, "-c", MEASURED, path, what], capture_output=True, text=True, check=True)
    peak, *counts = done.stdout.split()
    return float(peak), list(map(int, counts))


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks Linux for the peak")
def test_two_hours_beside_40_gb_of_images_are_examined_in_400_mb(tmp_path):
    path = long_recording(tmp_path / "long.mcap", 7200, camera_chunks=400)
    assert path.stat().st_size > 40e9
    peak, counts = measured(path, "doctor")
    assert counts == [7200 * 25, 7200 * 10, 7200 * 200]
    assert peak < 400


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks Linux for the peak")
def test_images_beside_cost_no_memory(tmp_path):
    peaks = [measured(long_recording(tmp_path / f"{n}.mcap", 100, n), "open")[0] for n in (0, 10)]
    assert peaks[1] < peaks[0] + 5
