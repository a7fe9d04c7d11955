"""A configuration that is grossly wrong is rejected, and what would fit is named."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from runs import START_NS, calibrate

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import (
    ENU_FROM_NED,
    FLU_FROM_FRD,
    quaternion_from_rotation,
    rotation_from_rpy,
)
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.verdict.kinds import Severity

PARAMETERS = Parameters(gnss_aided_std=0.03)
SAME = np.eye(3)


@cache
def motion():
    """Stamps, body velocity, rotation and angular velocity of a box with rolling and pitching, at 5 Hz."""
    time = np.arange(0.0, 120.0, 0.2)
    yaw_rate = np.where(time % 30.0 > 20.0, np.pi / 20.0, 0.0)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (yaw_rate[1:] + yaw_rate[:-1]) * 0.2)])
    rpy = np.column_stack([0.05 * np.sin(time), 0.03 * np.sin(0.7 * time), yaw])
    body = np.column_stack([1.5 + 0.3 * np.sin(0.2 * time), 0.5 * np.sin(0.15 * time), np.zeros_like(time)])
    return [START_NS + i * 200_000_000 for i in range(len(time))], body, rotation_from_rpy(rpy), yaw_rate


def verdict(frame=VelocityFrame.ENU, reference=SAME, attitude=(SAME, SAME), dvl=SAME):
    """Return the verdict on `full` where the messages hold these linear functions of what they should."""
    rng = np.random.default_rng(0)
    stamps, body, rotation, yaw_rate = motion()
    samples = []
    for stamp, v, r, rate in zip(stamps, body, rotation, yaw_rate, strict=True):
        samples.append(ImuSample(stamp, quaternion_from_rotation(attitude[0] @ r @ attitude[1]), (0.0, 0.0, rate)))
        samples.append(
            ReferenceSample(stamp, tuple((reference @ r @ v + rng.normal(0, 0.02, 3)).tolist()), None, frame)
        )
        samples.append(DvlSample(stamp, tuple((dvl @ v + rng.normal(0, 0.005, 3)).tolist())))
    return calibrate(samples, PARAMETERS, verified=True).verification("full")


def test_a_right_configuration_is_accepted_and_nothing_is_suggested():
    found = verdict()
    assert found.verdict is Severity.ACCEPT
    assert [each.code for each in found.reasons] == ["HELD_OUT"]


def causes(found):
    """What its reasons hold, and what these do."""
    held = [cause for each in found.reasons for cause in each.causes]
    return [*held, *(cause for each in held for cause in each.causes)]


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("wrong", "code", "numbers"),
    [
        ({"dvl": rotation_from_rpy([0.0, 0.0, 0.785]).T}, "MOUNTING_FITS", {"roll": 0.0, "pitch": 0.0, "yaw": 0.785}),
        ({"reference": ENU_FROM_NED}, "REFERENCE_LOOKS", {"name": "NED", "frame": "ned"}),
        ({"frame": VelocityFrame.NED}, "REFERENCE_LOOKS", {"name": "ENU", "frame": "enu"}),
        (
            {"attitude": (ENU_FROM_NED, FLU_FROM_FRD)},
            "IMU_LOOKS_NED",
            {"name": "NED, forward-right-down", "frame": "ned", "rpy": "[3.1416, 0, 0]"},
        ),
        ({"dvl": FLU_FROM_FRD}, "DVL_AXES_TURNED", {"parameter": "mounting_rpy", "value": "[3.1416, 0, 0]"}),
    ],
    ids=["45 degrees", "NED called ENU", "ENU called NED", "attitude in NED", "flipped axes"],
)
def test_a_wrong_configuration_is_rejected_with_the_reason_that_names_it(wrong, code, numbers):
    found = verdict(**wrong)
    assert found.verdict is Severity.REJECT
    (cause,) = [each for each in causes(found) if each.code == code]
    assert cause.numbers == (pytest.approx(numbers, abs=1e-3) if "yaw" in numbers else numbers)


def test_a_large_misalignment_is_no_other_configuration():
    found = verdict(dvl=rotation_from_rpy([0.0, 0.0, np.radians(11.0)]).T)
    assert found.verdict is Severity.REJECT
    codes = [each.code for each in found.reasons]
    assert codes[0] == "MISALIGNMENT_LARGE" and "CONFIGURATION_WRONG" not in codes


def test_a_mounting_that_fits_is_named_in_rad():
    (named,) = causes(verdict(dvl=rotation_from_rpy([0.0, 0.0, 0.785]).T))
    assert "mounting_rpy to [0, 0, 0.785" in named.remedy


def straight_in_waves(late_s, dvl=SAME):
    """Verdict on a straight run in waves of 5 s, the DVL late by so much; dvl as in `verdict`."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 200.0, 0.2)

    def body(at):
        wave = 2.0 * np.pi * at / 5.0
        return np.stack([1.5 + 0.2 * np.sin(0.2 * at), 0.05 * np.sin(wave), 0.08 * np.cos(wave)], axis=-1)

    rotation = rotation_from_rpy([0.0, 0.0, 0.3])
    samples = []
    for at in time.tolist():
        stamp = START_NS + round(at * 1e9)
        samples.append(ImuSample(stamp, quaternion_from_rotation(rotation), tuple(rng.normal(0, 1e-3, 3).tolist())))
        seen = rotation @ body(at) + rng.normal(0, 0.02, 3)
        samples.append(ReferenceSample(stamp, tuple(seen.tolist()), None, VelocityFrame.ENU))
        samples.append(DvlSample(stamp, tuple((dvl @ body(at - late_s) + rng.normal(0, 0.005, 3)).tolist())))
    return calibrate(samples, PARAMETERS, verified=True).verification("full")


@pytest.mark.slow
def test_a_dvl_that_is_late_by_half_a_wave_is_not_taken_for_one_that_points_down():
    found = {each.code for each in causes(straight_in_waves(2.5))}
    assert found <= {"CLOCKS_NOT_TOLD_APART"}  # which they are, by more than a calibration finds
    flipped = straight_in_waves(2.5, FLU_FROM_FRD)
    assert flipped.verdict is Severity.REJECT
    assert "DVL_AXES_TURNED" in {each.code for each in causes(flipped)}


@pytest.mark.parametrize("seed", [0, 3])
def test_axes_that_hardly_show_are_not_said_to_be_turned_round(seed):
    """A DVL that is turned by little, in a vehicle that keeps level: either reading of its axes fits as well."""
    rng = np.random.default_rng(seed)
    turned = rotation_from_rpy(np.radians([0.5, -1.5, 1.0]))
    samples = []
    for at in np.arange(0.0, 300.0, 0.2):
        stamp, rate = START_NS + round(at * 1e9), np.pi / 40.0 if at % 60.0 > 40.0 else 0.0
        yaw = np.pi / 40.0 * (20.0 * (at // 60.0) + max(at % 60.0 - 40.0, 0.0))
        rotation = rotation_from_rpy([0.0, 0.0, float(yaw)])
        samples.append(ImuSample(stamp, quaternion_from_rotation(rotation), (0.0, 0.0, rate)))
        seen = rotation @ (1.5, 0.0, 0.0) + rng.normal(0.0, 0.03, 3)
        samples.append(ReferenceSample(stamp, tuple(seen.tolist()), None, VelocityFrame.ENU))
        samples.append(DvlSample(stamp, tuple((turned.T @ (1.5, 0.0, 0.0) + rng.normal(0.0, 0.01, 3)).tolist())))
    found = calibrate(samples, PARAMETERS, verified=True, models=("full",)).verification("full")
    assert not any("forward-right-down" in each.sentence for each in found.reasons), found.reasons
