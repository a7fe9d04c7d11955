"""What the data do not show is named so that it does not contradict the angles beside it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.results.mounting_quantities import not_shown, quantities
from dvl_calib_ros.calibration.results.results import Result


@cache
def straight(yaw: int) -> Result:
    """`full` on a straight leg, whose vehicle does not roll, with a DVL that is mounted with this yaw (degrees)."""
    rpy = (0.0, 0.0, float(np.radians(yaw)))
    run = MatchedRun("straight", 60.0, dvl_std=0.01, gnss_std=0.01, mounting_rpy=rpy)
    result = calibrate(make_samples(run), Parameters(mounting_rpy=rpy), models=("full",)).result()
    return replace(result, selected="full")


@pytest.mark.parametrize("yaw", [0, 30, 45, 90, 180])
def test_an_axis_that_is_not_shown_is_the_vehicles_where_the_angle_of_that_name_is_shown(yaw):
    shown = {each.name: each.shown for each in quantities(straight(yaw))}
    named = " and ".join(not_shown(straight(yaw)).values()).split(" and ")
    assert ("roll" in named, "the vehicle's roll axis" in named) == (not shown["roll"], shown["roll"])
    assert "pitch" not in named  # the vehicle's, which a straight leg shows


def test_of_a_dvl_mounted_across_it_is_the_pitch_that_a_straight_leg_does_not_show():
    shown = {each.name: each.shown for each in quantities(straight(90))}
    assert shown["roll"] and not shown["pitch"]
    assert not {each.name: each.shown for each in quantities(straight(0))}["roll"]


def test_a_scale_across_is_not_asked_for():
    missing = {entry.axis for entry in straight(0).estimate.observability if entry.missing}
    named = " and ".join(not_shown(straight(0)).values()).split(" and ")
    assert "scale across" in missing and "scale across" not in named and "roll" in named
