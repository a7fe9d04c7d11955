"""A preview takes the same messages as one that decides at each of them."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from conftest import searched
from driver_fixtures import ODOMETRY, TWIST, write_driver_bag
from hypothesis import given
from hypothesis import strategies as st
from io_fixtures import run, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.messages.encode import FIX_TYPE, SampleWriter, SatelliteFix
from dvl_calib_ros.recordings import topic_messages as looking
from dvl_calib_ros.recordings.recording import hold_the_same, open_recording
from dvl_calib_ros.recordings.topic_messages import BURST_EVERY_NS, BURST_NS, BURSTS, in_bursts
from dvl_calib_ros.recordings.topics import Topics


class Topic:
    """What `in_bursts` asks of a topic's columns."""

    def __init__(self, arrival, log_ns) -> None:
        self.arrival, self.log_ns = np.array(arrival, dtype=np.int64), np.array(log_ns, dtype=np.int64)


def one_by_one(log_ns: list[int], spans_ns: list[tuple[int, int]]) -> list[int]:
    starts = [start for start, _ in spans_ns]
    before = np.cumsum([0, *(end - start for start, end in spans_ns)]).tolist()
    period = max(before[-1] // BURSTS, BURST_NS)
    taken, next_ns = [], 0
    for place, now in enumerate(log_ns):
        if now < next_ns:
            continue
        span = max(bisect_right(starts, now) - 1, 0)
        since = (now - starts[span] + before[span]) % period
        next_ns = now + (BURST_EVERY_NS if since < BURST_NS else period - since)
        if since < BURST_NS:
            taken.append(place)
    return taken


@searched(60)
@given(
    st.lists(st.tuples(st.integers(0, 10**12), st.integers(1, 10**12)), min_size=1, max_size=4),
    st.lists(st.floats(0.0, 1.0), max_size=200),
    st.booleans(),
)
def test_bursts_are_those_that_are_decided_one_by_one(gaps, places, in_two):
    """gaps: time before each stretch and its length, ns. places: of messages, as shares of all that was recorded."""
    spans, at = [], 0
    for before, length in gaps:
        spans.append((at + before, at + before + length))
        at += before + length
    log_ns = sorted(int(spans[0][0] + share * (at - spans[0][0])) for share in places)
    arrival = np.arange(len(log_ns)) * 3
    parts = [Topic(arrival, log_ns)]
    if in_two:
        parts = [Topic(arrival[at::2], log_ns[at::2]) for at in (0, 1)]
    assert in_bursts(parts, spans).tolist() == arrival[one_by_one(log_ns, spans)].tolist()


def test_recordings_are_the_same_that_share_half_of_their_velocities_at_the_same_stamps(tmp_path):
    samples = run(20.0)
    later = [each._replace(stamp_ns=each.stamp_ns + 10**12) for each in samples]
    other = [each._replace(velocity=(1.0, 2.0, 0.5)) if hasattr(each, "velocity") else each for each in samples]
    bags = {"whole": samples, "part": samples[len(samples) // 3 :], "later": later, "other": other, "none": []}
    bags["mostly later"] = sorted([*samples[: len(samples) // 4], *later], key=lambda each: each.stamp_ns)
    recorded = {}
    for name, content in bags.items():
        recording = open_recording([write_bag(tmp_path / name, content)])
        if "dvl/twist" in recording.types:
            recorded[name] = recording.recorded("dvl/twist", Parameters())
    whole = recorded["whole"]
    same = {name for name, each in recorded.items() if hold_the_same(whole, each)}
    assert same == {name for name, each in recorded.items() if hold_the_same(each, whole)} == {"whole", "part"}


def test_of_all_messages_of_a_fast_topic_no_more_are_looked_at_than_frames_need_evenly(tmp_path, monkeypatch):
    """Five hours at 50 Hz were copied several times over for 1.8 GB."""
    write_bag(tmp_path / "bag", run())
    recording = open_recording([tmp_path / "bag"])
    topics = Topics().found_in(recording.types)
    whole = recording.whole(topics).previews[topics.imu]
    assert len(whole.stamps_s) > 100
    monkeypatch.setattr(looking, "MOST", 100)
    step = -(-recording.counts[topics.imu] // 100)
    some = recording.whole(topics).previews[topics.imu]
    np.testing.assert_array_equal(some.stamps_s, whole.stamps_s[::step])
    np.testing.assert_array_equal(some.values, whole.values[::step])


def test_positions_that_the_receiver_marks_invalid_give_no_velocity_of_a_preview(tmp_path):
    """Every tenth fix is invalid and kilometres away; the others go north at 1 m/s."""
    start_ns, every_ns = 1_700_000_000 * 10**9, 200_000_000
    fixes = [SatelliteFix(start_ns + row * every_ns, 43.0 + row * 0.2 / 111_107.0, 10.0) for row in range(300)]
    with BagWriter(tmp_path / "valid") as bag:
        for fix in fixes:
            SampleWriter(bag).fix("fix", fix)
    with BagReader([tmp_path / "valid"]) as bag, BagWriter(tmp_path / "bag") as copy:
        for row, (topic, log_ns, message, _) in enumerate(bag.messages(["fix"])):
            if row % 10 == 0:
                message.status.status, message.latitude = -1, 43.1
            copy.message(topic, FIX_TYPE, log_ns, message)
    preview = open_recording([tmp_path / "bag"]).survey.previews["fix"]
    assert len(preview.values) > 100
    np.testing.assert_allclose(preview.values, np.tile([0.0, 1.0, 0.0], (len(preview.values), 1)), atol=0.01)


def test_of_recordings_with_different_types_on_a_topic_those_of_the_last_type_are_examined(tmp_path):
    bags = [write_driver_bag(tmp_path / name, run(10.0), kind) for name, kind in (("a", ODOMETRY), ("b", TWIST))]
    both, second = open_recording(bags), open_recording(bags[1:])
    assert both.types["dvl/twist"] == TWIST
    found, expected = (each.recorded("dvl/twist", Parameters()) for each in (both, second))
    np.testing.assert_array_equal(found.values, expected.values)
