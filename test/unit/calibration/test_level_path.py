"""A vertical error of the reference is no pitch of the DVL, and a dive is no error of the reference."""

from __future__ import annotations

import math

import numpy as np
import pytest
from runs import START_NS, calibrate

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame

STEP_S, SPEED = 0.2, 1.4
ROLL, PITCH, YAW = (math.radians(each) for each in (0.5, -1.0, 2.0))


def pitch_found(climb, error_up: float) -> tuple[float, float]:
    """Return error and σ of the pitch, degrees, of legs to four courses. climb: m/s of times (N,) s."""
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 480.0, STEP_S)
    course = np.convolve(np.radians(90.0) * (time // 60.0), np.ones(20) / 20.0, "same")
    up = climb(time)
    roll = 0.02 * np.sin(1.2 * time)
    pitch = 0.02 * np.sin(time) - np.arcsin(up / SPEED)
    turns = np.array([rotation_from_rpy(each) for each in zip(roll, pitch, course, strict=True)])
    earth = np.column_stack([SPEED * np.cos(course), SPEED * np.sin(course), up])
    body = np.einsum("nji,nj->ni", turns, earth)
    change = np.einsum("nji,njk->nik", turns[:-1], turns[1:]) / STEP_S
    rates = np.column_stack([change[:, 2, 1], change[:, 0, 2], change[:, 1, 0]])
    rates = np.vstack([rates, rates[-1:]])
    dvl = body @ rotation_from_rpy((ROLL, PITCH, YAW)) + rng.normal(0.0, 0.01, body.shape)
    reference = earth + np.array([0.0, 0.0, error_up]) + rng.normal(0.0, 0.02, earth.shape)
    samples: list[DvlSample | ReferenceSample | ImuSample] = []
    for at in range(len(time)):
        stamp = START_NS + round(1e9 * time[at])
        samples.append(ImuSample(stamp, quaternion_from_rotation(turns[at]), tuple(rates[at])))
        samples.append(ReferenceSample(stamp, tuple(reference[at]), None, VelocityFrame.ENU))
        samples.append(DvlSample(stamp + 1000, tuple(dvl[at])))
    calibrator = calibrate(samples, Parameters())
    calibrator.finish()
    estimate = calibrator.result().estimate
    return math.degrees(-estimate.misalignment[1] - PITCH), math.degrees(estimate.recording_std[1])


def test_a_vertical_error_of_the_reference_does_not_turn_a_level_vehicles_pitch():
    off, std = pitch_found(lambda time: 0.0 * time, 0.06)
    assert abs(off) < min(2.0 * std, 0.5) and std < 0.7  # of 0.06 m/s it would be 2.5 degrees


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    "climb",
    [
        pytest.param(lambda time: np.where(time < 60.0, -0.17, 0.0), id="dives, then level"),
        pytest.param(lambda time: 0.15 * np.sin(0.03 * time), id="yo-yo"),
    ],
)
def test_a_vehicle_that_dives_keeps_its_pitch(climb):
    off, std = pitch_found(climb, 0.0)
    assert abs(off) < 2.0 * std and abs(off) < 1.0
