"""Which clock is late: the DVL's, which full finds; the reference's or the IMU's, which is said and not averaged."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from runs import calibrate
from test_full import LEVER_ARM, NOISE, late

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.numerics.samples import ImuSample, ReferenceSample
from dvl_calib_ros.verdict.reasons import Reason


def stamped_late(samples, kind, seconds):
    """The same with one stream's stamps late."""
    shift_ns = round(seconds * 1e9)
    moved = (s._replace(stamp_ns=s.stamp_ns + shift_ns) if isinstance(s, kind) else s for s in samples)
    return sorted(moved, key=lambda sample: sample.stamp_ns)


@cache
def found(dvl: float = 0.0, reference: float = 0.0, imu: float = 0.0) -> Calibrator:
    """What is made of a run whose streams are late by so many seconds; not to be fed any more."""
    samples = stamped_late(stamped_late(late(dvl), ReferenceSample, reference), ImuSample, imu)
    return calibrate(samples, NOISE, verified=True)


def test_an_early_dvl_is_no_late_reference():
    assert found(dvl=-1.4).suggestion is None
    assert found(dvl=-1.4).verification("full").verdict.value == "accept"


def test_a_late_reference_is_named_and_bends_no_lever_arm():
    calibrator = found(reference=0.6)
    assert abs(calibrator.estimate("full").state[5] - LEVER_ARM[0]) < 0.1
    said = calibrator.suggestion
    assert said is not None and said.code == "CLOCK_LATE"
    assert said.numbers["whose"] == "the reference's" and said.numbers["way"] == "late"
    assert offset_named(said, "reference_time_offset") == pytest.approx(0.6, abs=0.05)
    verification = calibrator.verification("full")
    assert verification.verdict.value == "reject"
    assert verification.reasons[0].causes == (said,) and said.sentence in verification.reasons[0].sentence


def offset_named(said: Reason | None, parameter: str) -> float:
    assert said is not None and said.numbers["parameter"] == parameter
    return float(said.numbers["offset"])


def test_what_it_says_makes_the_calibration_right():
    samples = stamped_late(late(0.0), ReferenceSample, 0.6)
    offset = offset_named(found(reference=0.6).suggestion, "reference_time_offset")
    calibrator = calibrate(samples, NOISE.replace(reference_time_offset=offset), verified=True)
    assert calibrator.suggestion is None
    assert calibrator.verification("full").verdict.value == "accept"
    np.testing.assert_allclose(calibrator.estimate("full").state[5:7], LEVER_ARM[:2], atol=0.1)


def test_two_late_clocks_are_told_apart():
    said = found(dvl=-0.5, reference=0.6).suggestion
    assert said is not None and said.code == "CLOCKS_LATE" and said.numbers["dvl_way"] == "early"
    assert (said.numbers["seconds"], said.numbers["dvl_seconds"]) == pytest.approx((0.6, 0.5), abs=0.1)


def test_a_late_imu_is_not_put_down_to_the_two_others():
    said = found(imu=0.5).suggestion
    assert said is not None and said.code == "CLOCK_LATE" and said.numbers["way"] == "late"
    assert offset_named(said, "imu_time_offset") == pytest.approx(0.5, abs=0.05)


def test_a_reference_that_is_late_by_more_than_any_delay_of_the_dvl_is_named_as_well():
    """It was said to be 1.2 s late or more, or nothing."""
    assert offset_named(found(reference=30.0).suggestion, "reference_time_offset") == pytest.approx(30.0, abs=0.05)


@pytest.mark.slow
def test_how_samples_are_gathered_changes_nothing_about_clocks():
    samples = stamped_late(late(0.0), ReferenceSample, 0.6)
    assert calibrate(samples, NOISE, verified=True, block_size=400).suggestion == found(reference=0.6).suggestion
