"""Recorded messages as columns are the same samples, refusals and problems as one by one."""

from __future__ import annotations

import math
import random
from itertools import product

import numpy as np
import pytest
from conftest import searched
from driver_fixtures import MARINE, ODOMETRY, TWIST, TWIST_STAMPED, TYPES, Maker, write_driver_bag
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import IMU_TYPE, JAZZY, TWIST_TYPE, mcap_bytes, raw, run, write_bag

from dvl_calib_ros.bags import columns as bag_columns
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import Stream
from dvl_calib_ros.messages.decode import MessageDecoder, Refusal
from dvl_calib_ros.messages.drivers import KNOWN_DEFINITIONS, POSE_TYPES
from dvl_calib_ros.messages.encode import FIX_TYPE
from dvl_calib_ros.recordings import columns, far_stamps
from dvl_calib_ros.recordings import sample_columns as kept_streams
from dvl_calib_ros.recordings.recording import open_recording

TOPICS = {"dvl/twist": Stream.DVL, "gnss/twist": Stream.REFERENCE, "imu/data": Stream.IMU}


@pytest.fixture(autouse=True, scope="module")
def nothing_is_set_aside():
    """Stamps are any here; what is set aside for them is tested in test_far_stamps.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(far_stamps, "SEGMENT_GAP_NS", 2**64)
        yield


def plain(decoded):
    """To be compared: nan as nan of either sign, and of an IMU as if there were nothing, for it says as much."""
    if isinstance(decoded, str | Refusal):
        return decoded if isinstance(decoded, str) else decoded.reason
    values = {
        name: None if value is None else bits(value)
        for name, value in decoded._asdict().items()
        if name not in ("stamp_ns", "frame")
    }
    if not hasattr(decoded, "velocity"):
        values = {name: None if value is None or value[0] == "nan" else value for name, value in values.items()}
    return type(decoded), decoded.stamp_ns, values, getattr(decoded, "frame", None)


def bits(values) -> list[str]:
    return list(map(repr, np.ravel(np.asarray(values, dtype=float)).tolist()))


def as_columns(paths, parameters, on_problem=print):
    decoder = MessageDecoder(parameters, on_problem)
    found = [
        (stream, plain(sample))
        for stretch in open_recording(paths, parameters=parameters).stretches(TOPICS, decoder)
        for stream, sample in stretch.streams.in_order()
    ]
    return found, decoder


def one_by_one(paths, parameters, on_problem=print):
    decoder = MessageDecoder(parameters, on_problem)
    take = {"dvl/twist": decoder.dvl, "gnss/twist": decoder.reference, "imu/data": decoder.imu}
    found = []
    with BagReader(paths, KNOWN_DEFINITIONS) as bag:
        for topic, log_ns, message, why in bag.messages(TOPICS):
            stream = TOPICS[topic]
            found.append((stream, plain(decoder.undecodable(stream, why) if why else take[topic](message, log_ns))))
    return found, decoder


STATE = ("zero_stamps", "dvl_frame", "frame_of_reference", "turns_dvl")


def assert_same(paths, parameters, state=STATE):
    said, expected_said = set(), set()
    found, decoder = as_columns(paths, parameters, said.add)
    expected, expected_decoder = one_by_one(paths, parameters, expected_said.add)
    assert found == expected
    assert said == expected_said
    assert decoder.problems.keys() == expected_decoder.problems.keys()
    for name in state:
        assert getattr(decoder, name) == getattr(expected_decoder, name), name
    return found


@pytest.mark.parametrize(
    ("reference", "kind", "version"),
    [
        (*pair, ("first", "covariance", "fixed sizes")[n % 3])
        for n, pair in enumerate(product((TWIST, TWIST_STAMPED, ODOMETRY), TYPES))
    ],
)
def test_every_type_gives_the_same_samples_in_columns(tmp_path, kind, reference, version):
    changes = {
        3: lambda message: setattr(message.header.stamp, "sec", 0) or setattr(message.header.stamp, "nanosec", 0)
    }
    if kind == MARINE:
        changes |= {
            5: lambda m: setattr(m, "velocity_mode", 2), 6: lambda m: setattr(m, "num_good_beams", 2),
            7: lambda m: vars(m).update(altitude=float("nan"), beam_ranges_valid=False),
            8: lambda m: setattr(m, "beam_velocities_valid", False),
            9: lambda m: m.velocity_covar.__setitem__(0, -1.0),
            10: lambda m: vars(m).update(altitude=-1.0, range=np.zeros(4)),
            11: lambda m: vars(m).update(altitude=float("inf"), beam_ranges_valid=False),
            12: lambda m: setattr(m, "velocity_mode", 0),
        }  # fmt: skip
    samples = [s._replace(velocity=(0.0, 0.0, 0.0)) if i == 77 and hasattr(s, "velocity") else s
               for i, s in enumerate(run(20.0))]  # fmt: skip
    bag = write_driver_bag(tmp_path / "bag", samples, kind, reference, maker=Maker(version), changes=changes)
    found = assert_same([bag], Parameters(dvl_type=kind, gnss_type=reference))
    assert len(found) == len(samples)
    if kind == MARINE:
        assert {"water_track", "few_beams", "no_bottom", "flagged_invalid", "unknown_mode"} <= {
            each for _, each in found if isinstance(each, str)
        }


@pytest.mark.parametrize("kind", [FIX_TYPE, *POSE_TYPES])
def test_positions_give_the_same_velocities_and_fixes_in_columns(tmp_path, monkeypatch, kind):
    """Some are invalid, nan, without stamp, without covariance, in another frame or before a pause."""
    new = {name.rpartition("/")[2]: made for name, made in JAZZY.types.items()}
    messages = []
    for row in range(300):
        at_ns = 1_700_000_000 * 10**9 + row * 200_000_000 + (10**10 if row > 200 else 0)
        stamp = new["Time"](*divmod(0 if row % 40 == 3 else at_ns, 10**9))
        header = new["Header"](stamp, "elsewhere" if row % 50 == 7 else "map_nwu" if row > 250 else "map")
        x, y, z = 1e-5 * row, 2e-5 * row, math.nan if row % 60 == 5 else 0.1
        point = new["Point"](1e5 * x, 1e5 * y, z)
        pose = new["Pose"](point, new["Quaternion"](0.0, 0.0, 0.0, 1.0))
        variance = 0.0 if row % 9 == 0 else 1e-4 * (1 + row // 100)
        if kind == FIX_TYPE:
            status = new["NavSatStatus"](-1 if row % 10 == 0 else 0, 1)
            covariance = variance * np.eye(3).ravel()
            message = new["NavSatFix"](header, status, 43.0 + x, 10.0 + y, z, covariance, int(variance > 0.0))
        elif kind == POSE_TYPES[0]:
            message = new["PoseWithCovarianceStamped"](
                header, new["PoseWithCovariance"](pose, variance * np.eye(6).ravel())
            )
        else:
            message = new["PoseStamped"](header, pose)
        messages.append(("gnss/twist", at_ns, bytes(JAZZY.serialize_cdr(message, kind))))
    path = tmp_path / "bag.mcap"
    definition = JAZZY.generate_msgdef(kind, ros_version=2)[0]
    path.write_bytes(mcap_bytes(messages, {"gnss/twist": (kind, definition)}))
    fixes: list[list[str]] = []
    parameters = Parameters(gnss_type=kind)
    monkeypatch.setattr(MessageDecoder, "forget", noting(fixes, MessageDecoder.forget))
    found = assert_same([path], parameters)
    assert len(found) == 300 and sum(not isinstance(sample, str) for _, sample in found) > 150
    assert fixes[0] == fixes[1] and len(fixes[0]) > 200


def noting(fixes, forget):
    """`MessageDecoder.forget` that also begins a list of the decoder's fixes."""

    def forgets(decoder):
        forget(decoder)
        noted: list[str] = []
        fixes.append(noted)
        decoder.on_fix = lambda *fix: noted.append(repr(fix))

    return forgets


FRAMES = ["dvl_link", "dvl_frd", "base_link", "map", "ned", "odom", "", "x", "gnss", "größe", "a\0b"]
FLOATS = st.sampled_from([0.0, -0.0, 1.0, -1.0, 0.25, float("nan"), float("inf"), 1e300])


@st.composite
def recordings(draw: st.DrawFn):
    """Messages of any frames, stamps, values and covariances, whole or damaged, in either endianness."""
    rng = random.Random(draw(st.integers(0, 2**32)))
    types = JAZZY.types
    frames = draw(st.lists(st.sampled_from(FRAMES), min_size=1, max_size=4))
    floats = draw(st.lists(FLOATS, min_size=1, max_size=5))
    messages = []
    for i in range(draw(st.integers(1, 40))):
        topic = rng.choice(list(TOPICS))
        stamp = 0 if rng.random() < 0.1 else 1_700_000_000 * 10**9 + i
        header = types["std_msgs/msg/Header"](
            types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), rng.choice(frames)
        )
        vector = lambda: types["geometry_msgs/msg/Vector3"](*(rng.choice(floats) for _ in range(3)))  # noqa: E731
        covariance = lambda size: np.array([rng.choice(floats) for _ in range(size)])  # noqa: E731
        if topic == "imu/data":
            quaternion = types["geometry_msgs/msg/Quaternion"](*(rng.choice(floats) for _ in range(4)))
            message, kind = types[IMU_TYPE](
                header, quaternion, covariance(9), vector(), covariance(9), vector(), covariance(9)
            ), IMU_TYPE  # fmt: skip
        else:
            twist = types["geometry_msgs/msg/Twist"](vector(), vector())
            inner = types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance(36))
            message, kind = types[TWIST_TYPE](header, inner), TWIST_TYPE
        data = bytes(JAZZY.serialize_cdr(message, kind, little_endian=rng.random() < 0.7))
        if rng.random() < 0.1:
            at = rng.randrange(len(data))
            data = rng.choice([data[:at], data[:at] + b"\xff" + data[at + 1 :], data + b"\0"])
        messages.append((topic, 10**18 + i, data))
    return messages


@searched(120)
@given(
    recordings(), st.sampled_from([1, 7, 4096]), st.sampled_from(["", "dvl_link", "base_link"]), st.booleans(),
    st.sampled_from([100, columns.IN_MEMORY]),
)  # fmt: skip
def test_whatever_is_recorded_gives_the_same_in_columns(
    tmp_path_factory, messages, window, dvl_frame, is_turned, in_memory
):
    """Also where what is kept goes to the disk."""
    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    path.write_bytes(mcap_bytes(messages))
    parameters = Parameters(dvl_frame=dvl_frame, imu_rpy=(0.1, 0.0, 0.5) if is_turned else (0.0, 0.0, 0.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bag_columns, "WINDOW_MESSAGES", window)
        patch.setattr(kept_streams, "STRETCH_MESSAGES", window)
        patch.setattr(columns, "IN_MEMORY", in_memory)
        assert_same([path], parameters)


def test_an_imu_message_without_attitude_that_is_read_by_itself_keeps_its_rates(tmp_path):
    """As it is where a frame's name is not ASCII: the condition on the attitude chose rows instead of columns."""
    new = {name.rpartition("/")[2]: made for name, made in JAZZY.types.items()}
    missing, given = np.append(-1.0, np.zeros(8)), np.zeros(9)
    stamp, quaternion = new["Time"](1_700_000_000, 0), new["Quaternion"](0.0, 0.0, 0.0, 0.0)
    rates, none = new["Vector3"](0.1, 0.2, 0.3), new["Vector3"](0.0, 0.0, 0.0)
    imu = new["Imu"](new["Header"](stamp, "größe"), quaternion, missing, rates, given, none, missing)
    data = bytes(JAZZY.serialize_cdr(imu, IMU_TYPE))
    for count in (1, 50):
        path = tmp_path / f"{count}.mcap"
        path.write_bytes(mcap_bytes([("imu/data", 10**18 + i, data) for i in range(count)]))
        samples = [sample for _, sample in assert_same([path], Parameters())]
        assert len(samples) == count and all("0.1" in str(sample) for sample in samples)


def test_messages_of_several_bags_arrive_in_order_of_log_time(tmp_path):
    first = write_bag(tmp_path / "first", run(20.0)[::2])
    second = write_bag(tmp_path / "second", run(20.0)[1::2], "sqlite3")
    found = assert_same([second, first], Parameters())
    whole, _ = as_columns([write_bag(tmp_path / "whole", run(20.0))], Parameters())
    assert sorted(map(str, found)) == sorted(map(str, whole))  # of two at the same time either may be first
    stamps = [sample[1] for _, sample in found]
    assert stamps == sorted(stamps)


def test_a_window_holds_no_more_than_it_may_of_messages_and_bytes(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", run(20.0))
    monkeypatch.setattr(bag_columns, "WINDOW_BYTES", 10_000)
    with BagReader([bag]) as reader:
        sizes = [sum(len(part) for part in window.parts) for window in bag_columns.windows(reader, TOPICS)]
    lengths = [len(data) for _, _, data in raw(bag)]
    assert sum(sizes) == len(lengths)
    assert max(sizes) <= 1 + 10_000 // min(lengths) and min(sizes[:-1]) >= 10_000 // max(lengths)
    assert_same([bag], Parameters())


def test_a_definition_without_what_is_read_is_counted_message_by_message(tmp_path):
    """A vendor's Twist without covariance, and an Imu that is none."""
    with_less = {
        "dvl/twist": (TWIST_TYPE, "std_msgs/Header header\nfloat64 speed\n" + HEADER),
        "imu/data": (IMU_TYPE, "float64 x\n"),
    }
    header = bytes(JAZZY.serialize_cdr(header_message("dvl_link"), "std_msgs/msg/Header"))
    padding = bytes(-(len(header) - 4) % 8)
    content = [("dvl/twist", i, header + padding + bytes(8)) for i in range(1, 6)]
    content += [("imu/data", i, b"\0\1\0\0" + bytes(8)) for i in range(6, 9)]
    (tmp_path / "less.mcap").write_bytes(mcap_bytes(content, with_less))
    # live, the header of a message counts even if its velocity cannot be read
    found = assert_same([tmp_path / "less.mcap"], Parameters(), [name for name in STATE if name != "dvl_frame"])
    assert [reason for _, reason in found] == ["invalid"] * 8


def header_message(frame_id):
    return JAZZY.types["std_msgs/msg/Header"](JAZZY.types["builtin_interfaces/msg/Time"](5, 0), frame_id)


HEADER = (
    "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)  # fmt: skip
