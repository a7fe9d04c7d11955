"""Messages of rclpy and of rosbags alike become samples: only their fields are looked at."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import Stream, VelocityFrame
from dvl_calib_ros.messages.decode import LinearCovariance
from dvl_calib_ros.messages.live_feed import MessageFeed

SECOND = 10**9


def header(stamp: int, frame_id: str) -> Fields:
    return Fields(stamp=Fields(sec=stamp // SECOND, nanosec=stamp % SECOND), frame_id=frame_id)


def twist(stamp: int, frame_id: str = "dvl_link", velocity=(1.5, 0.1, 0.0), covariance=None) -> Fields:
    linear, angular = Fields(**dict(zip("xyz", velocity, strict=True))), Fields(x=0.0, y=0.0, z=0.0)
    inner = Fields(linear=linear, angular=angular)
    return Fields(
        header=header(stamp, frame_id),
        twist=Fields(twist=inner, covariance=np.zeros(36) if covariance is None else covariance),
    )


def imu(stamp: int, frame_id: str = "base_link", q=(0.0, 0.0, 0.6, 0.8), w=(0.0, 0.0, 0.1), first=(0.0, 0.0)) -> Fields:
    return Fields(
        header=header(stamp, frame_id),
        orientation=Fields(**dict(zip("xyzw", q, strict=True))),
        orientation_covariance=[first[0], *[0.0] * 8],
        angular_velocity=Fields(**dict(zip("xyz", w, strict=True))),
        angular_velocity_covariance=[first[1], *[0.0] * 8],
    )


class Feed:
    """A feed with what it has said."""

    def __init__(self, **parameters) -> None:
        self.calibrator = Calibrator(Parameters(**parameters))
        self.said: list[str] = []
        self.feed = MessageFeed(self.calibrator, self.said.append)

    def counts(self, stream: str) -> dict[str, int]:
        return self.calibrator.counts[stream]


def test_a_frame_that_garbage_made_megabytes_long_is_kept_short_and_its_data_are_used():
    feed = Feed()
    for i in range(3):
        feed.feed.dvl(twist(i * SECOND, frame_id="d" * 30_000_000), 0)
        feed.feed.imu(imu(i * SECOND, frame_id="i" * 30_000_000), 0)
        feed.feed.reference(twist(i * SECOND, frame_id="r" * 30_000_000), 0)
    assert all(1 < len(name) < 300 for name in feed.feed.decoder.frame_ids)
    assert feed.counts("dvl")["usable"] == 3
    assert sum(map(len, feed.said)) < 3000


def test_the_linear_covariance_is_the_upper_left_of_the_six_by_six():
    read = LinearCovariance()
    for _ in range(2):
        assert read(list(range(36))).tolist() == [[0, 1, 2], [6, 7, 8], [12, 13, 14]]
    assert read([0.5] * 36).tolist() == [[0.5] * 3] * 3


def test_a_dvl_message_becomes_the_sample_it_describes():
    covariance = np.diag([0.01, 0.02, 0.03, 9, 9, 9]).ravel()
    sample = Feed().feed.dvl(twist(5 * SECOND + 7, velocity=(1.0, -0.5, 0.25), covariance=covariance), 0)
    assert (sample.stamp_ns, sample.velocity) == (5 * SECOND + 7, (1.0, -0.5, 0.25))
    assert np.array_equal(sample.covariance, np.diag([0.01, 0.02, 0.03]))


@pytest.mark.parametrize(
    ("velocity", "variance"),
    [((np.nan, 0, 0), 0.0), ((0, np.inf, 0), 0.0), ((99.0, 0, 0), 0.0), ((1, 0, 0), -2.0), ((1, 0, 0), np.nan)],
)
@pytest.mark.parametrize("stream", ["dvl", "reference"])
def test_what_no_sensor_can_mean_is_counted_as_invalid(stream, velocity, variance):
    feed = Feed()
    take = feed.feed.dvl if stream == "dvl" else feed.feed.reference
    covariance = np.diag([0.1, variance, 0.1, 0, 0, 0]).ravel()
    take(twist(SECOND, "dvl_link" if stream == "dvl" else "base_link", velocity, covariance), 0)
    assert feed.counts(stream)["invalid"] == feed.counts(stream)["received"] == 1
    assert not feed.said


@pytest.mark.parametrize("frame_id", ["dvl_link", "auv/dvl", "nucleus", ""])
def test_the_first_dvl_frame_is_taken_for_the_dvls_own(frame_id):
    feed = Feed()
    assert feed.feed.dvl(twist(SECOND, frame_id), 0) is not None
    assert feed.feed.dvl(twist(2 * SECOND, "other"), 0) is None
    assert feed.counts("dvl")["wrong_frame"] == 1 and feed.counts("dvl")["accepted"] == 1
    assert len(feed.said) == 1 and "dvl_frame" in feed.said[0] and "'other'" in feed.said[0]


@pytest.mark.parametrize("frame_id", ["base_link", "/base_link", "map", "odom", "ENU", "ned", "world"])
def test_dvl_data_in_a_body_or_earth_frame_is_refused_with_the_remedy(frame_id):
    feed = Feed()
    assert feed.feed.dvl(twist(SECOND, frame_id), 0) is None
    assert feed.counts("dvl")["wrong_frame"] == 1
    assert "let the driver publish in the DVL's own frame" in feed.said[0]
    assert Feed(dvl_frame=frame_id).feed.dvl(twist(SECOND, frame_id), 0) is not None  # unless the user insists


@pytest.mark.parametrize(
    ("frame_id", "frame"),
    [
        ("base_link", VelocityFrame.BODY), ("/base_link", VelocityFrame.BODY), ("enu", VelocityFrame.ENU),
        ("map", VelocityFrame.ENU), ("odom", VelocityFrame.ENU), ("/world", VelocityFrame.ENU),
        ("ENU", VelocityFrame.ENU), ("ned", VelocityFrame.NED), ("NED", VelocityFrame.NED),
    ],
)  # fmt: skip
def test_the_frame_of_a_reference_is_told_by_its_frame_id(frame_id, frame):
    assert Feed().feed.reference(twist(SECOND, frame_id), 0).frame is frame


@pytest.mark.parametrize("frame_id", ["gnss", "", "antenna", "dvl_link"])
def test_a_reference_in_a_frame_that_says_nothing_is_refused_until_gnss_frame_is_set(frame_id):
    feed = Feed()
    assert feed.feed.reference(twist(SECOND, frame_id), 0) is None
    assert feed.counts("reference")["wrong_frame"] == 1
    assert "set gnss_frame to body, enu or ned" in feed.said[0]
    for frame in VelocityFrame:
        assert Feed(gnss_frame=frame.value).feed.reference(twist(SECOND, frame_id), 0).frame is frame


def test_a_body_frame_of_another_name_is_known_by_base_frame():
    feed = Feed(base_frame="auv/base")
    assert feed.feed.reference(twist(SECOND, "auv/base"), 0).frame is VelocityFrame.BODY
    assert feed.feed.reference(twist(SECOND, "base_link"), 0) is None


@pytest.mark.parametrize(
    ("first", "has_orientation", "has_rate"),
    [((0.0, 0.0), True, True), ((-1.0, 0.0), False, True), ((0.0, -1.0), True, False), ((-1.0, -1.0), False, False)],
)
def test_a_covariance_of_minus_one_says_that_an_imu_has_no_such_data(first, has_orientation, has_rate):
    feed = Feed()
    sample = feed.feed.imu(imu(SECOND, first=first), 0)
    assert sample.orientation == ((0.0, 0.0, 0.6, 0.8) if has_orientation else None)
    assert sample.angular_velocity == ((0.0, 0.0, 0.1) if has_rate else None)
    assert feed.counts("imu")["invalid"] == (not has_orientation and not has_rate)


def test_an_imu_in_a_frame_of_its_own_is_used_and_said_once():
    feed = Feed()
    for second in range(1, 5):
        feed.feed.imu(imu(second * SECOND, "imu_link"), 0)
    assert feed.counts("imu")["received"] == 4
    assert len(feed.said) == 1 and "imu_link" in feed.said[0]


def test_a_zero_stamp_is_replaced_by_the_time_of_reception_and_said_once_per_stream():
    feed = Feed()
    for second in (11, 12):
        assert feed.feed.dvl(twist(0), second * SECOND).stamp_ns == second * SECOND
        assert feed.feed.reference(twist(0, "base_link"), second * SECOND).stamp_ns == second * SECOND
        assert feed.feed.imu(imu(0), second * SECOND).stamp_ns == second * SECOND
    assert feed.feed.decoder.zero_stamps == 6
    assert [sentence.split(":")[0] for sentence in feed.said] == ["dvl", "reference", "imu"]


def test_ever_new_wrong_frames_and_garbage_are_counted_but_told_of_once():
    feed = Feed(dvl_frame="dvl_link")
    for i in range(50):
        feed.feed.dvl(twist(SECOND + i, f"frame{i % 2}"), 0)
        feed.feed.reference(twist(SECOND + i, f"frame{i}"), 0)
        refusal = feed.feed.decoder.undecodable(Stream.DVL, f"byte {i}")
        feed.feed.calibrator.refuse("dvl", refusal.reason)
    assert feed.counts("dvl")["wrong_frame"] == feed.counts("reference")["wrong_frame"] == 50
    assert feed.counts("dvl")["invalid"] == 50
    assert len(feed.said) == 3
    assert "frame1" in str(feed.feed.decoder.problems["dvl frame"])  # the newest is kept for the diagnostics
