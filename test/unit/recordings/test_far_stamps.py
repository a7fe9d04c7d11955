"""Messages whose stamps are absurdly far from the others are set aside and named; pauses and other clocks are not."""

from __future__ import annotations

import numpy as np
import pytest
from driver_fixtures import TWIST, TYPES, write_driver_bag
from io_fixtures import TOPICS, rewrite, run, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Storage
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.messages.decode import stamp_ns
from dvl_calib_ros.messages.drivers import KNOWN_DEFINITIONS
from dvl_calib_ros.recordings.far_stamps import far, logged_elsewhere
from dvl_calib_ros.recordings.recording import open_recording

S, DAY = 10**9, 86_400 * 10**9
NOW = 1_760_000_000 * S
IN_2038 = 2_145_916_800 * S


def every(seconds: float, rate: float = 5.0, start: int = NOW) -> np.ndarray:
    return start + (np.arange(int(seconds * rate)) * S / rate).astype(np.int64)


def changed(stamps: np.ndarray, at: int, stamp: int) -> np.ndarray:
    stamps = stamps.copy()
    stamps[at] = stamp
    return stamps


@pytest.mark.parametrize("stamp", [0, 5 * S, IN_2038, NOW - 365 * DAY, NOW - 30 * DAY, NOW + 30 * DAY, -(2**62)])
@pytest.mark.parametrize("at", [0, 300, 599])
def test_one_stamp_is_set_aside_wherever_it_is(at, stamp):
    dvl, imu = changed(every(120.0), at, stamp), every(120.0, 10.0)
    of_dvl, of_imu = far([dvl, imu])
    assert np.flatnonzero(of_dvl).tolist() == [at]
    assert not of_imu.any()


def test_what_came_before_the_clock_was_set_is_set_aside_on_all_topics():
    each = [np.concatenate([every(20.0, rate, 5 * S), every(40.0, rate)]) for rate in (5.0, 1.0, 10.0)]
    for stamps, aside in zip(each, far(each), strict=True):
        assert (aside == (stamps < NOW)).all()


def test_streams_keep_the_same_segment_where_most_of_each_is_in_another():
    """GNSS, which sets the clock, begins late: most of the DVL's stamps are of 1970, of the others most are not."""
    dvl = np.concatenate([every(60.0, 5.0, 5 * S), every(40.0, 5.0)])
    gnss = np.concatenate([every(10.0, 1.0, 60 * S), every(40.0, 1.0)])
    imu = np.concatenate([every(60.0, 10.0, 5 * S), every(60.0, 10.0)])
    for stamps, aside in zip((dvl, gnss, imu), far([dvl, gnss, imu]), strict=True):
        assert (aside == (stamps < NOW)).all()


@pytest.mark.parametrize(
    "each",
    [
        [np.zeros(0, dtype=np.int64)],
        [every(60.0), np.zeros(0, dtype=np.int64)],
        [np.concatenate([every(60.0), every(3.0, start=NOW + 6 * DAY)])],  # a pause of days
        [np.concatenate([every(60.0), every(60.0, start=NOW + 60 * DAY)])],  # two dives in one bag
        [np.concatenate([every(60.0), every(60.0, start=NOW - 3600 * S)])],  # a clock that is set back
        [every(60.0, start=5 * S), every(60.0), every(60.0, 10.0)],  # a DVL whose clock counts since it was switched on
    ],
)
def test_nothing_else_is_set_aside(each):
    assert [len(aside) for aside in far(each)] == [len(own) for own in each]
    assert not any(aside.any() for aside in far(each))


def test_a_small_part_months_away_is_no_second_dive():
    [aside] = far([np.concatenate([every(60.0), every(3.0, start=NOW + 60 * DAY)])])
    assert aside.sum() == 15 and aside[-15:].all()


def early(topic: str, number: int = 0):
    """The change of a message's stamp to 1970, for `rewrite`."""
    seen = iter(range(10**6))

    def change(of, message):
        if of == topic and next(seen) == number:
            message.header.stamp.sec, message.header.stamp.nanosec = 5, 0
        return message

    return change


def test_a_recording_without_far_stamps_is_the_one_that_was_opened(tmp_path):
    source = write_bag(tmp_path / "sound", run(20.0))
    bag = rewrite(tmp_path / "bag", early("dvl/twist", 3), run(20.0))
    sound, found = open_recording([source]), open_recording([bag])
    [note] = found.notes
    assert "dvl/twist: 1 of 100 messages are set aside: stamped at 1970-01-01 00:00:05 UTC" in note
    assert not sound.notes
    assert found.counts["dvl/twist"] == sound.counts["dvl/twist"] - 1 == found.survey.previews["dvl/twist"].count
    own, other = (each.recorded("dvl/twist", Parameters()) for each in (found, sound))
    np.testing.assert_array_equal(own.stamps_ns, np.delete(other.stamps_ns, 3))
    np.testing.assert_array_equal(own.values, np.delete(other.values, 3, axis=0))


@pytest.mark.parametrize("kind", TYPES)
def test_stamps_of_messages_that_are_decoded_one_by_one_are_those_of_their_headers(tmp_path, kind):
    def without_stamp(message) -> None:
        message.header.stamp.sec = message.header.stamp.nanosec = 0

    bag = write_driver_bag(tmp_path / "bag", run(10.0), kind, TWIST, changes={3: without_stamp})
    recording = open_recording([bag], parameters=Parameters(dvl_type=kind))
    [part] = next(parts for parts in recording.columns.values() if parts[0].msgtype == kind)
    with BagReader([bag], KNOWN_DEFINITIONS) as reader:
        expected = [stamp_ns(message.header.stamp) or log_ns for _, log_ns, message, _ in reader.messages([part.topic])]
    assert part.stamped_ns.tolist() == expected
    kept = np.arange(len(part)) % 3 > 0
    assert part.part(kept).stamped_ns.tolist() == np.array(expected)[kept].tolist()
    np.testing.assert_array_equal(part.part(kept).arrival, part.arrival[kept])


def logged(path, topic: str, off: dict[int, int], storage: str, pause_ns: int = 0):
    """A bag of 20 s in which some log times of a topic (place -> ns) are off, after a pause from the middle on."""
    with BagReader([write_bag(path / "sound", run(20.0))]) as bag:
        messages = [(name, log_ns, message) for name, log_ns, message, _ in bag.messages(TOPICS)]
    middle_ns = messages[0][1] + 10 * S
    with BagWriter(path / "bag", Storage(storage)) as bag:
        rows, seen = [], dict.fromkeys(TOPICS, 0)
        for name, log_ns, message in messages:
            later = pause_ns if log_ns >= middle_ns else 0
            message.header.stamp.sec += later // S
            rows.append((log_ns + later + (off.get(seen[name], 0) if name == topic else 0), name, message))
            seen[name] += 1
        for log_ns, name, message in sorted(rows, key=lambda row: row[0]):
            bag.message(name, TOPICS[name], log_ns, message)
    return open_recording([path / "bag"]), messages


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("off", [2 * DAY, -3 * 3600 * S, 120 * S])
@pytest.mark.parametrize("topic", ["dvl/twist", "imu/data"])
def test_one_log_time_does_not_stretch_a_recording(tmp_path, topic, off, storage):
    recording, messages = logged(tmp_path, topic, {40: off}, storage)
    assert recording.span_ns == (messages[0][1], messages[-1][1])
    [note] = recording.notes
    assert f"{topic}: 1 of " in note and "set aside: recorded at" in note
    for name, look in recording.survey.previews.items():
        expected = sum(each == name for each, *_ in messages) / 20.0
        assert look.rate_hz == pytest.approx(expected, rel=0.03), name


@pytest.mark.parametrize("off", [{}, {40: DAY}], ids=["none", "one"])
def test_a_log_time_beyond_a_pause_of_hours_is_set_aside_and_not_the_pause(tmp_path, off):
    pause_ns = 5 * 3600 * S
    recording, messages = logged(tmp_path, "dvl/twist", off, "mcap", pause_ns)
    assert recording.span_ns == (messages[0][1], messages[-1][1] + pause_ns)
    assert len(recording.notes) == len(off)


def test_stamps_that_are_off_while_log_times_go_on_are_no_wrong_log_times():
    log = every(120.0)
    for late in (3600 * S, -3600 * S):
        stamps = log.copy()
        stamps[:20] += late  # the clock of a driver, set after 4 s
        assert not any(mask.any() for mask in logged_elsewhere([stamps, log], [log, log]))


@pytest.mark.parametrize("off", [3 * 3600 * S, -3 * 3600 * S])
def test_a_log_time_of_a_topic_that_nobody_reads_does_not_stretch_a_recording(tmp_path, off):
    with BagReader([write_bag(tmp_path / "sound", run(20.0))]) as bag:
        rows = [(log_ns, topic, TOPICS[topic], message) for topic, log_ns, message, _ in bag.messages(TOPICS)]
    first_ns, last_ns = rows[0][0], rows[-1][0]
    with BagWriter(tmp_path / "bag") as bag:
        text = bag.typestore.types["std_msgs/msg/String"]("said")
        rows.append((first_ns + off, "chatter", "std_msgs/msg/String", text))
        for log_ns, topic, kind, message in sorted(rows, key=lambda row: row[0]):
            bag.message(topic, kind, log_ns, message)
    assert open_recording([tmp_path / "bag"]).span_ns == (first_ns, last_ns)
