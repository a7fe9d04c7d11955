"""Drivers whose clocks differ by more than any delay that a model looks for."""

from __future__ import annotations

import re

import pytest
from io_fixtures import rewrite
from runs import MatchedRun, make_samples

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame

RUN = MatchedRun(phi=(0.02, -0.03, 0.04), dvl_std=0.01, gnss_std=0.05, frame=VelocityFrame.ENU, seconds=60.0)


def with_stamps_ahead(path, topic, seconds):
    """A recording of a minute; stamps of one topic are ahead by so many seconds of what the log says."""

    def change(name, message):
        if name.lstrip("/") == topic:
            message.header.stamp.sec += seconds
        return message

    return rewrite(path, change, make_samples(RUN))


@pytest.mark.parametrize(
    ("topic", "seconds", "said"),
    [
        ("gnss/twist", 18, "the reference's stamps are 18.* s ahead .*GPS time, without its leap seconds"),
        ("gnss/twist", -37, "the reference's stamps are 3[67].* s behind .*TAI"),
        ("gnss/twist", 20, "the reference's stamps are (19|20).* s ahead"),
        ("imu/data", 6, "the IMU's stamps are [56].* s ahead"),
    ],
)
@pytest.mark.spread(1)
def test_clocks_that_differ_by_more_than_any_delay_are_named_and_nothing_is_accepted(tmp_path, topic, seconds, said):
    bag = with_stamps_ahead(tmp_path / "bag", topic, seconds)
    calibration = dc.replay(bag, history=False)
    assert calibration.verdict == "reject"
    assert any(re.search(said, reason) for reason in calibration.reasons), calibration.reasons
    assert calibration.mounting.nominal_rpy_deg == (0.0, 0.0, 0.0)
    assert not any("-p mounting_rpy" in note for note in calibration.replayed.notes)


def test_clocks_that_are_one_are_not_spoken_of(tmp_path):
    calibration = dc.replay(with_stamps_ahead(tmp_path / "bag", "gnss/twist", 0), history=False)
    assert "CLOCKS_APART" not in calibration.codes


def test_a_clock_that_is_wrong_as_the_parameters_say_is_no_objection(tmp_path):
    bag = with_stamps_ahead(tmp_path / "bag", "gnss/twist", 6)
    assert "CLOCKS_APART" in dc.replay(bag, history=False).codes
    told = dc.replay(bag, reference_time_offset=6.0, history=False)
    assert "CLOCKS_APART" not in told.codes
