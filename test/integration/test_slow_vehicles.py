"""Vehicles near the slowest speed that a calibration uses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stacks import LEVER_ARM, TWIST, Told, motion

import dvl_calib_ros as dc

SCALE = 0.015


@pytest.mark.spread(1)
@pytest.mark.parametrize("speed", [0.305, 0.15])
def test_a_vehicle_near_and_below_min_speed_gets_the_scale_of_its_dvl(tmp_path, speed):
    """Of samples selected by the reference's noise the scale was too small by several σ; 0.15 m/s were rejected."""
    m = motion()
    course = 2.0 * np.pi * m.time / 53.0
    slow = speed * np.column_stack([np.cos(course), np.sin(course), np.zeros(len(course))])
    told = Told(motion=replace(m, velocity_body=slow))
    told.dvl("/dvl/velocity", TWIST, "dvl_link")
    for *_, message in told.rows:
        v = message.twist.twist.linear
        v.x, v.y, v.z = (1.0 + SCALE) * np.array([v.x, v.y, v.z])
    told.imu("/imu/data", "base_link")
    told.reference("/ins/velocity", TWIST, "base_link", "body", std=0.01)
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))
    calibration = dc.replay(told.write(tmp_path / "bag"), history=False)
    assert calibration.verdict == "accept" and dc.doctor(tmp_path / "bag").verdict == "yes"
    estimate = calibration.replayed.result.estimates["full"]
    at = [estimate.state_names.index(name) for name in ("delta_k_x", "delta_k_y")]
    found, std = estimate.state[at], np.sqrt(np.diag(estimate.recording_covariance)[at])
    assert (np.abs(found - SCALE) < 2.0 * std).all() and (std < 0.01).all()
