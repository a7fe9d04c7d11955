"""What is fuzzed: functions from bytes, which must end well or raise an error made for the user, and their seeds."""

from __future__ import annotations

import os
import re
import shutil
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from flips import flip_seeds, run_flips
from io_fixtures import mcap_bytes, raw, run, write_bag
from log_fixtures import dataflash, pd0, rmc, telemetry
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from wholes import Names, names_seeds, run_names, run_settings, run_stamps, settings_seeds, stamps_seeds

from dvl_calib_ros.bags.channels import Definition, DefinitionError, typestore
from dvl_calib_ros.bags.columns import NoLayoutError, layout_of
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.salvage.damage import DamagedError
from dvl_calib_ros.bags.salvage.mcap_file import salvage_mcap_stream
from dvl_calib_ros.bags.salvage.sqlite_file import salvage_sqlite_stream
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import ParameterError, Parameters
from dvl_calib_ros.calibration.numerics.frames import rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import Stream
from dvl_calib_ros.calibration.streams.stream_order import SEGMENT_GAP_NS
from dvl_calib_ros.disk.text_files import parse_scalar
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import load_parameters
from dvl_calib_ros.files.result_file import load_initial_calibration
from dvl_calib_ros.files.urdf import read_urdf
from dvl_calib_ros.fleet_catalogue.recording_entry import Entry
from dvl_calib_ros.fleet_catalogue.update import ASIDE, Catalogue, CataloguePart
from dvl_calib_ros.logs.dvl_log import DvlLog
from dvl_calib_ros.logs.dvl_logs import read_dvl_log
from dvl_calib_ros.logs.text_logs import read_rmc
from dvl_calib_ros.logs.trajectories import read_attitude, read_columns, read_table
from dvl_calib_ros.messages.decode import MessageDecoder, Refusal
from dvl_calib_ros.messages.drivers import IMU_TYPE, TWIST_TYPE
from dvl_calib_ros.messages.live_feed import MessageFeed
from dvl_calib_ros.recordings import far_stamps
from dvl_calib_ros.recordings.recording import open_recording

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(tempfile.mkdtemp(prefix="fuzz", dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
JAZZY = get_typestore(Stores.ROS2_JAZZY)


class Part(NamedTuple):
    """A part of a fleet's catalogue, whole."""

    catalogue: Catalogue
    path: Path
    recording: str
    whole: bytes


class Target(NamedTuple):
    """run: takes an input; anything it raises is a finding. seeds: where the corpus begins.

    damaged: number of damaged seeds that the suite tries; few where one takes a second.
    """

    run: Callable[[bytes], None]
    seeds: Callable[[], Iterator[bytes]]
    damaged: int = 30


def _file(name: str, data: bytes) -> Path:
    path = FOLDER / name
    path.write_bytes(data)
    return path


def _read_bag(path: Path) -> None:
    try:
        with BagReader([path]) as bag:
            topics = bag.topics
            assert all(channel.topic in topics for _, channel, _ in bag.raw_messages(topics))
    except InputError as error:
        assert str(error)


def run_mcap(data: bytes) -> None:
    _read_bag(_file("fuzzed.mcap", data))


def run_sqlite(data: bytes) -> None:
    _read_bag(_file("fuzzed.db3", data))


def run_mcap_records(data: bytes) -> None:
    """Only the reader of damaged files, in memory: it takes a tenth of the time."""
    with suppress(DamagedError):
        assert sum(len(message.data) for message in salvage_mcap_stream(BytesIO(data), len(data))) < 1 << 24


def run_sqlite_pages(data: bytes) -> None:
    with suppress(DamagedError):
        assert sum(len(message.data) for message in salvage_sqlite_stream(BytesIO(data), len(data))) < 1 << 24


def run_metadata(data: bytes) -> None:
    folder = FOLDER / "bag"
    folder.mkdir(exist_ok=True)
    (folder / "fuzzed.mcap").write_bytes(_SMALLEST_BAG)
    (folder / "metadata.yaml").write_bytes(data)
    _read_bag(folder)


def run_message(data: bytes) -> None:
    """The first byte says which message, of which stream."""
    if not data:
        return
    _FEED.forget()
    msgtype, take = [(TWIST_TYPE, _FEED.dvl), (TWIST_TYPE, _FEED.reference), (IMU_TYPE, _FEED.imu)][data[0] % 3]
    half = 1 + (len(data) - 1) // 2
    for part in (data[1:], data[1:half], data[half:]):
        try:
            take(JAZZY.deserialize_cdr(part, msgtype), 1)
        except SerdeError:
            continue
    if _CALIBRATOR.n_given("M3") > 1000:
        _CALIBRATOR.result()
        _CALIBRATOR.reset()


def run_columns(data: bytes) -> None:
    """Messages of all streams as columns are what they are one by one. The first byte says how they are cut."""
    if len(data) < 2:
        return
    size = 1 + data[0]
    topics = {"dvl/twist": Stream.DVL, "gnss/twist": Stream.REFERENCE, "imu/data": Stream.IMU}
    parts = [data[at : at + size] for at in range(1, len(data), size)][:30]
    messages = [
        (list(topics)[i % 3], 10**18 + i, part + _MESSAGE_ENDS[i % 3][len(part) :]) for i, part in enumerate(parts)
    ]
    path = _file("columns.mcap", mcap_bytes(messages))
    found, singly = [], []
    decoder = MessageDecoder(Parameters())
    with patch.object(far_stamps, "SEGMENT_GAP_NS", 2**64):  # stamps are any: nothing is set aside for them
        recording = open_recording([path])
    for stretch in recording.stretches(topics, decoder):
        found += [(stream, isinstance(each, str)) for stream, each in stretch.streams.in_order()]
    decoder = MessageDecoder(Parameters())
    take = {"dvl/twist": decoder.dvl, "gnss/twist": decoder.reference, "imu/data": decoder.imu}
    with BagReader([path]) as bag:
        for topic, log_ns, message, why in bag.messages(topics):
            refused = bool(why) or isinstance(take[topic](message, log_ns), Refusal)
            singly.append((topics[topic], refused))
    assert found == singly


def run_definition(data: bytes) -> None:
    """The first byte says whether it is MSG or IDL."""
    kind = MessageDefinitionFormat.MSG if data[:1] < b"\x80" else MessageDefinitionFormat.IDL
    try:
        types = typestore(Definition(kind, data[1:].decode("utf-8", "replace")), "a/msg/B")
    except DefinitionError:
        return
    data = b"\0\1\0\0" + bytes(64)
    with suppress(NoLayoutError, LookupError):  # that it has none, which the reader knows
        layout_of(types, "a/msg/B", data)
    try:
        types.deserialize_cdr(data, "a/msg/B")
    except Exception:  # the reader counts whatever a decoder raises as a message that cannot be decoded
        return


def run_log_times(data: bytes) -> None:
    """Messages of any log times, eight bytes each: all come out, in order, or are set aside.

    The first byte says how they are stored.
    """
    if len(data) < 9:
        return
    times = [int.from_bytes(data[at : at + 8], "little") for at in range(1, len(data) - 7, 8)][:400]
    topics = ("dvl/twist", "gnss/twist", "imu/data")
    messages = [(topics[i % 3], log_ns, _MESSAGE_ENDS[i % 3]) for i, log_ns in enumerate(times)]
    options = {"use_chunking": data[0] % 2 == 0, "chunk_size": (1000, 10**6)[data[0] // 2 % 2]}
    path = _file("times.mcap", mcap_bytes(messages, **options))
    with BagReader([path]) as bag:
        found = [(channel.topic, log_ns) for log_ns, channel, _ in bag.raw_messages(bag.topics)]
    assert Counter(found) == Counter((topic, log_ns) for topic, log_ns, _ in messages)
    assert all(before <= after for (_, before), (_, after) in pairwise(found))
    recording = open_recording([path])
    kept = {topic: sum(map(len, parts)) for topic, parts in recording.columns.items()}
    aside = [int(each[1]) for note in recording.notes for each in re.finditer(r"(\d+) of \d+ messages are set", note)]
    assert sum(kept.values()) + sum(aside) == len(messages)
    assert set(recording.survey.previews) == {topic for topic, count in kept.items() if count}
    if len(times) >= 200 and len(usual := [each for each in times if each >> 40 == times[0] >> 40]) > 0.99 * len(times):
        first_ns, last_ns = recording.span_ns
        assert last_ns - first_ns <= max(usual) - min(usual) + 2 * SEGMENT_GAP_NS


def run_result_file(data: bytes) -> None:
    try:
        load_initial_calibration(_file("result.yaml", data), (0.0, 0.0, 0.0))
    except InputError as error:
        assert len(str(error)) < 10_000


def run_parameters(data: bytes) -> None:
    try:
        load_parameters(_file("parameters.yaml", data))
    except (InputError, ParameterError) as error:
        assert len(str(error)) < 10_000


def run_urdf(data: bytes) -> None:
    """A mounting that is found is turned and moved, and found again as it was turned and moved."""
    turned = rotation_from_rpy((0.1, -0.2, 0.3))
    for by in (None, np.array([0.5, -1.0, 2.0])):
        try:
            urdf = read_urdf(_file("robot.urdf", data))
            mounting = urdf.mounting("base_link", "dvl_link")
            position = mounting.position if by is None else mounting.position + by
            moved = urdf.moved(mounting, turned, None if by is None else position)
            again = read_urdf(_file("robot.urdf", moved)).mounting("base_link", "dvl_link")
        except InputError as error:
            assert len(str(error)) < 10_000
            return
        np.testing.assert_allclose(again.rotation_body_from_dvl, turned, rtol=0, atol=1e-6)
        if by is None:
            np.testing.assert_array_equal(again.position, position)
        else:  # rounded to what is written, and to the largest that joints add up to nothing
            scale = np.abs(mounting.joint.xyz).max() + np.abs(mounting.position).max()
            np.testing.assert_allclose(again.position, position, rtol=0, atol=1e-5 + 1e-8 * scale)


def run_trajectory(data: bytes) -> None:
    """The first byte says whether it is CSV or NPY."""
    path = _file(f"fuzzed_dvl.{'csv' if data[:1] < b'a' else 'npy'}", data[1:])
    try:
        time, values, _ = read_columns(path, "m/s")
        if path.suffix == ".csv":
            read_table(path, "time=1,vx=2,vy=3,vz=4", 0, np.eye(3), 0.0)
        attitudes = read_attitude(path, 0, [])
    except InputError as error:
        assert len(str(error)) < 10_000
        return
    assert all(np.isfinite([*each.orientation, *each.angular_velocity]).all() for each in attitudes)
    assert values.shape == (len(time), 3) and np.isfinite(values).all() and (np.diff(time) > 0.0).all()


def run_log(data: bytes) -> None:
    """The first byte says what the log is called."""
    path = _file(f"fuzzed.{('log', 'BIN', 'tlog', 'nmea')[data[0] % 4] if data else 'log'}", data[1:])
    try:
        log = DvlLog(read_rmc(path, 0.0, []), Counter()) if path.suffix == ".nmea" else read_dvl_log(path)
    except InputError as error:
        assert len(str(error)) < 10_000
        return
    samples = log.samples
    assert all(np.isfinite([*each.orientation, *each.angular_velocity]).all() for each in log.attitudes)
    assert all(np.isfinite(each.velocity).all() for each in log.references)
    stamps = [each.stamp_ns for each in samples]
    assert stamps == sorted(set(stamps)) and all(np.isfinite(each.velocity).all() for each in samples)


def run_part(data: bytes) -> None:
    """A part of a fleet's catalogue is read as it was written, or set aside: nobody can change a bit of it."""
    _PART.catalogue.notes.clear()
    shutil.rmtree(_PART.catalogue.folder / ASIDE, ignore_errors=True)
    _PART.path.write_bytes(data)
    parts = list(_PART.catalogue.parts())
    if data == _PART.whole:
        assert [each.recording for each in parts] == [_PART.recording]
        assert _PART.catalogue.rows_of(_PART.recording)[0]["value"] == 2.187
    else:
        assert not parts and len(_PART.catalogue.notes) == 1 and not _PART.path.exists()


def run_override(data: bytes) -> None:
    text = data.decode("utf-8", "replace")
    parse_scalar(text)
    try:
        load_parameters(None, [f"model:={text}", f"mounting_rpy:={text}", f"min_speed:={text}", text])
    except (InputError, ParameterError) as error:
        assert len(str(error)) < 10_000


# ---------------------------------------------------------------------- seeds


def _small_run() -> list[tuple[str, int, bytes]]:
    with tempfile.TemporaryDirectory() as folder:
        messages = raw(write_bag(Path(folder) / "bag", run(6.0)))
    return [next(message for message in messages if message[0] == topic) for topic in ("dvl/twist", "imu/data")]


def _small_mcap(**options: Any) -> bytes:
    """Two channels, three messages; no checksums: a changed byte must get further than to the checksum."""
    output = BytesIO()
    writer = Writer(output, **{"chunk_size": 60, "enable_crcs": False, **options})
    writer.start("ros2", "")
    schema = writer.register_schema("a/msg/B", "ros2msg", b"uint8 x")
    channels = [writer.register_channel(topic, "cdr", schema) for topic in "ab"]
    for log_ns in (1, 2, 3):
        writer.add_message(channels[log_ns % 2], log_ns, b"\0\1\0\0abcdefgh", log_ns)
    writer.finish()
    return output.getvalue()


def _mcap_seeds() -> Iterator[bytes]:
    for compression in CompressionType:
        whole = _small_mcap(compression=compression)
        yield from (whole, whole[:-60], whole[: len(whole) // 2])
    yield _small_mcap(use_chunking=False, compression=CompressionType.NONE)
    yield _small_mcap(index_types=IndexType.NONE)


def _sqlite_seeds() -> Iterator[bytes]:
    import sqlite3

    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

    for page_size in (512, 1024):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "seed.db3"
            connection = sqlite3.connect(path)
            connection.execute(f"PRAGMA page_size={page_size}")
            connection.executescript(Sqlite3Writer.SQLITE_SCHEMA)
            connection.execute("INSERT INTO topics VALUES (1, 'dvl/twist', ?, 'cdr', '', '')", (TWIST_TYPE,))
            for i, (_, log_ns, data) in enumerate(_small_run() * 4):
                connection.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (i + 1, log_ns, data * (1 + i)))
            connection.commit()
            connection.close()
            yield path.read_bytes()


def _column_seeds() -> Iterator[bytes]:
    dvl, imu = (data for _, _, data in _small_run())
    yield bytes([23]) + b"".join(each[:24] for each in (dvl, dvl, imu) * 4)
    yield bytes([99]) + b"".join(each[:100] for each in (dvl, dvl.replace(b"dvl_link", b"map\0\0\0\0\0"), imu) * 3)


def _log_time_seeds() -> Iterator[bytes]:
    usual = [1_700_000_000_000_000_000 + 50_000_000 * i for i in range(300)]
    for kind in range(4):
        for wild in ([], [(150, 0)], [(150, 2**63 - 1)], [(0, 2**64 - 1), (299, 2**62)]):
            times = list(usual)
            for place, log_ns in wild:
                times[place] = log_ns
            yield bytes([kind]) + struct.pack("<300Q", *times)
    yield b"\0" + struct.pack("<4Q", 5, 2**64 - 1, 2**63, 7)


def _definition_seeds() -> Iterator[bytes]:
    for msgtype in (TWIST_TYPE, IMU_TYPE, "diagnostic_msgs/msg/DiagnosticArray"):
        yield b"\0" + JAZZY.generate_msgdef(msgtype, ros_version=2)[0].encode()
    yield b"\0int32 X=3\nfloat64[<=4] values\nstring<=5 name 'a'\nfloat64[9] covariance\n"
    yield b"\0a/B self\n"
    halves = [f"{'=' * 80}\nMSG: a/{'CDEFGH'[i]}\na/{'DEFGHI'[i]} x\na/{'DEFGHI'[i]}[2] y\n" for i in range(6)]
    yield f"\0a/C[60] x\n{''.join(halves)}{'=' * 80}\nMSG: a/I\nuint8[0] x\n".encode()
    yield b"\0a/B2[] x\n" + b"=" * 80 + b"\nMSG: a/B2\na/B y\n"
    yield b"\xff" + (
        b"================================================================================\nIDL: a/msg/B\n"
        b"module a { module msg { typedef double double__9[9]; struct B { long x; double__9 covariance; "
        b"sequence<string> names; }; }; };\n"
    )


def _message_seeds() -> Iterator[bytes]:
    for number, (_, _, data) in enumerate(_small_run() * 2):
        yield struct.pack("B", (0, 2, 1, 2)[number]) + data


def _result_seeds() -> Iterator[bytes]:
    yield b"""format: dvl_calib_ros result 1
models:
  M5: {state_names: [phi_x, phi_y, phi_z], state: [0.0, 0.1, 0.2], covariance: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  M9: 3
mounting: {nominal_rpy: [0.0, 0.0, 0.0]}
parameters: {}
"""


def _parameter_seeds() -> Iterator[bytes]:
    yield b"/**:\n  ros__parameters:\n    model: M3\n    lever_arm: [0.1, -2, 1e-3]\n    use_message_covariance: true\n"
    yield b"/auv:\n  dvl_calibration:\n    ros__parameters: {qos_overrides: {a: {b: 1}}, min_speed: .5}\n"
    yield _ALIASES


def _metadata_seeds() -> Iterator[bytes]:
    yield b"rosbag2_bagfile_information:\n  version: 9\n  relative_file_paths: [fuzzed.mcap, ../x.db3]\n"
    yield _ALIASES


def _urdf_seeds() -> Iterator[bytes]:
    body = b'<joint name="j" type="fixed"><parent link="base_link"/><child link="%s"/>%s</joint>'
    mast = b'<joint name="k" type="fixed"><parent link="base_link"/><child link="mast"/></joint>'
    origin = b'<origin xyz="1 0 -0.5" rpy="3.1415 0 0"/>'
    yield b'<?xml version="1.0"?><robot name="r"><link name="base_link"/>' + body % (b"dvl_link", origin) + b"</robot>"
    yield b"<robot>" + mast + (body % (b"dvl_link", b"")).replace(b"base_link", b"mast") + b"</robot>"
    yield b'<?xml version="1.0" encoding="latin-1"?><robot><!-- \xe9 -->' + body % (b"dvl_link", origin) + b"</robot>"
    yield b'<robot xmlns:xacro="x"><xacro:arg name="a"/></robot>'


def _trajectory_seeds() -> Iterator[bytes]:
    yield b"Atime [s],x [m/s],y [m/s],z [m/s]\n0,1,2,3\n1,1.5,2,-3e-2\n"
    yield b"A0;1;2;3\r\n1;2;3;4\r\n"
    for kind in ("<f8", ">f4", "<i2"):
        output = BytesIO()
        np.save(output, np.array([[0, 1, 2, 3], [1, 1, 2, 3]], dtype=kind))
        yield b"n" + output.getvalue()


def _log_seeds() -> Iterator[bytes]:
    yield b"\0" + b"".join(pd0(i, 4500 + 10 * i, 200, -300) for i in range(4))
    yield b'\0{"vx": 1.0, "vy": 0, "vz": 0, "fom": 0.1, "velocity_valid": true, "time_of_validity": 1638191471563017}\n'
    yield b"\3" + "\r\n".join(rmc(11.0 + i, "3.0", "90.0") for i in range(4)).encode()
    with suppress(ImportError):  # without the extra ardupilot
        yield b"\1" + dataflash(FOLDER / "seed.BIN").read_bytes()
        yield b"\2" + telemetry(FOLDER / "seed.tlog").read_bytes()


def _override_seeds() -> Iterator[bytes]:
    yield from (b"[0.0, 1e-3, -2]", b"M3", b"min_speed:=0.5", b"{a: [1, 2]}", b"1:30:00", b"0x1F", b"!!python/name:os")


def _part() -> Part:
    catalogue, recording = Catalogue(FOLDER / "catalogue"), "/dives/auv1/dive0"
    rows = [{"recording": recording, "parameter": "yaw", "unit": "deg", "value": 2.187, "codes": ["FEW_TURNS"]}]
    catalogue.write(CataloguePart(recording, "auv1", "0" * 64, {"model": "M5"}), Entry(rows))
    (path,) = catalogue.rows.iterdir()
    return Part(catalogue, path, recording, path.read_bytes())


_ALIASES = b"a: &a [1.0e-3, .nan]\nb: *a\nc: {d: !!binary aGFsbG8=, <<: {x: 1}}\n"
_CALIBRATOR = Calibrator(Parameters())
_FEED = MessageFeed(_CALIBRATOR, lambda _: None)
_SMALLEST_BAG = _small_mcap()
_MESSAGE_ENDS = [_small_run()[number][2] for number in (0, 0, 1)]
TARGETS = {
    "mcap": Target(run_mcap, _mcap_seeds),
    "flips": Target(partial(run_flips, path=FOLDER / "flipped.mcap"), flip_seeds),
    "sqlite": Target(run_sqlite, _sqlite_seeds),
    "mcap_records": Target(run_mcap_records, _mcap_seeds),
    "sqlite_pages": Target(run_sqlite_pages, _sqlite_seeds),
    "metadata": Target(run_metadata, _metadata_seeds),
    "message": Target(run_message, _message_seeds),
    "columns": Target(run_columns, _column_seeds),
    "log_times": Target(run_log_times, _log_time_seeds),
    "definition": Target(run_definition, _definition_seeds),
    "result_file": Target(run_result_file, _result_seeds),
    "parameters": Target(run_parameters, _parameter_seeds),
    "override": Target(run_override, _override_seeds),
    "urdf": Target(run_urdf, _urdf_seeds),
    "trajectory": Target(run_trajectory, _trajectory_seeds),
    "log": Target(run_log, _log_seeds),
    "settings": Target(run_settings, settings_seeds),
    "stamps": Target(partial(run_stamps, folder=FOLDER), stamps_seeds, damaged=3),
    "names": Target(partial(run_names, names=Names(FOLDER, _SMALLEST_BAG)), names_seeds),
}
with suppress(InputError):  # without pyarrow there is no catalogue
    _PART = _part()
    TARGETS["part"] = Target(run_part, lambda: iter([_PART.whole]))
with suppress(ImportError):  # without ROS 2 there is no live node
    from live import live_seeds, run_live

    TARGETS["live"] = Target(partial(run_live, folder=FOLDER), live_seeds)
