"""What gravity says against an IMU while the node runs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from remedies import changes

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.node.diagnostics import GravitySeen


def message(at_s, *, sign=1.0, unit=9.81, inverted=False):
    """Of an IMU on a vehicle that rolls and pitches."""
    turned = rotation_from_rpy((0.1 * np.sin(at_s), 0.06 * np.cos(1.3 * at_s), 0.05 * at_s))
    x, y, z, w = quaternion_from_rotation(turned.T if inverted else turned)
    ax, ay, az = sign * unit * turned[2]
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=int(at_s))),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        linear_acceleration=SimpleNamespace(x=ax, y=ay, z=az),
    )


@pytest.mark.parametrize(
    ("given", "parameters", "code"),
    [
        ({}, Parameters(), None),
        ({"sign": -1.0}, Parameters(), "GRAVITY_SIGN"),
        ({"unit": 1.0}, Parameters(), "GRAVITY_IN_G"),
        ({"inverted": True}, Parameters(), "GRAVITY_FITS_INVERTED"),
        ({}, Parameters(imu_frame="ned"), "GRAVITY_UPSIDE_DOWN"),
        ({}, Parameters(imu_rpy=(np.pi, 0.0, 0.0)), "GRAVITY_UPSIDE_DOWN"),
    ],
)
def test_gravity_is_held_against_the_orientation_by_a_message_a_second(given, parameters, code):
    seen = GravitySeen()
    for at_s in np.arange(0.0, 19.0, 0.1):
        seen.add(message(at_s, **given))
    assert seen.problems("imu/data", parameters) == []  # too few to tell
    for at_s in np.arange(19.0, 60.0, 0.1):
        seen.add(message(at_s, **given))
    problems = seen.problems("imu/data", parameters)
    assert [each.code for each in problems] == ([code] if code else [])
    if code == "GRAVITY_UPSIDE_DOWN":
        typed = changes(problems[0].remedy, parameters)
        assert seen.problems("imu/data", parameters.replace(**typed)) == []
