"""A DVL that sits ahead of the reference point, or whose stamps are late, is not taken for one that is turned."""

from __future__ import annotations

import heapq
import re

import numpy as np
import pytest
from io_fixtures import write_bag
from report_fixtures import drawn
from runs import START_NS

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame

SECONDS, RATE_HZ = 120.0, 5.0
CLAIMED = 0.02**2 * np.eye(3)


def motion(time, waves_mps):
    """Turn rate (N,), heading (N,) and body velocity (N, 3): turns to both sides, in which the stern swings out."""
    speed, pace = 1.5 + 0.2 * np.sin(0.1 * time), 2.0 * np.pi / 40.0
    rate = 0.25 * np.sin(pace * time)
    heading = 0.25 / pace * (1.0 - np.cos(pace * time))
    wave = 2.0 * np.pi * time / 5.0
    sway = -0.3 * rate * speed + waves_mps * np.sin(wave)
    return rate, heading, np.stack([speed, sway, waves_mps * np.cos(wave)], axis=-1)


def circle(time, waves_mps):
    """The same of a vehicle that turns at one rate for ever."""
    rate, speed, wave = np.full_like(time, 0.12), 0.9 + 0.02 * np.sin(0.1 * time), 2.0 * np.pi * time / 5.0
    return rate, 0.12 * time, np.stack([speed, waves_mps * np.sin(wave), waves_mps * np.cos(wave)], axis=-1)


def spike(rng, share):
    return rng.normal(0, 1.5, 3) if rng.random() < share else 0.0


def recorded(
    path, lever_arm, late_s, mounting_rpy=(0.0, 0.0, 0.0), waves_mps=0.02, claimed=CLAIMED, spikes=0.0, motion=motion
):
    """A bag of it, as a DVL measures that sits, is late and is turned so; nothing in it says where the DVL is.

    spikes: share of samples of DVL and reference that are off by metres per second.
    """
    rng = np.random.default_rng(5)
    time = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)
    dvl_from_body = rotation_from_rpy(mounting_rpy).T
    samples = []
    for at in time.tolist():
        stamp = START_NS + round(at * 1e9)
        rate, heading, body = motion(np.array(at), waves_mps)
        rotation = rotation_from_rpy([0.0, 0.0, float(heading)])
        samples.append(ImuSample(stamp, quaternion_from_rotation(rotation), (0.0, 0.0, float(rate))))
        seen = rotation @ body + rng.normal(0, 0.02, 3)
        seen += spike(rng, spikes)
        samples.append(ReferenceSample(stamp, tuple(seen.tolist()), claimed, VelocityFrame.ENU))
        rate, _, body = motion(np.array(at - late_s), waves_mps)
        there = dvl_from_body @ (body + np.cross([0.0, 0.0, rate], lever_arm)) + rng.normal(0, 0.005, 3)
        there += spike(rng, spikes)
        samples.append(DvlSample(stamp, tuple(there.tolist())))
    return write_bag(path, tuple(heapq.merge(samples, key=lambda sample: sample.stamp_ns)))


@pytest.mark.parametrize(
    ("lever_arm", "late_s", "waves_mps"),
    [((1.0, 0.2, 0.0), 2.5, 0.15), pytest.param((1.3, -0.3, 0.0), -2.2, 0.02, marks=pytest.mark.slow)],
    ids=["ahead and late by half a wave", "ahead and early"],
)
def test_a_dvl_that_is_displaced_or_late_is_not_taken_for_one_that_is_turned(tmp_path, lever_arm, late_s, waves_mps):
    calibration = dc.replay(recorded(tmp_path / "bag", lever_arm, late_s, waves_mps=waves_mps), history=False)
    mounting = calibration.mounting
    assert mounting.nominal_rpy_deg == (0.0, 0.0, 0.0) and calibration.verdict != "reject", calibration.reasons
    np.testing.assert_allclose(mounting.xyz_m[:2], lever_arm[:2], atol=0.05)
    assert mounting.time_offset_s == pytest.approx(late_s, abs=0.05)
    np.testing.assert_allclose(mounting.rpy_deg[1:], 0.0, atol=0.5)


@pytest.mark.spread(1)
@pytest.mark.parametrize("ahead_m", [-0.3, 1.9])
def test_on_a_circle_a_displaced_dvl_is_not_taken_for_a_turned_one_and_its_yaw_is_not_claimed(tmp_path, ahead_m):
    calibration = dc.replay(recorded(tmp_path / "bag", (ahead_m, 0.0, 0.0), 0.0, motion=circle), history=False)
    assert calibration.mounting.nominal_rpy_deg == (0.0, 0.0, 0.0)
    yaw_deg, std_deg = calibration.mounting.rpy_deg[2], calibration.mounting.std_deg[2]
    assert calibration.verdict == "reject" or abs(yaw_deg) < 3.0 * std_deg, (yaw_deg, std_deg, calibration.reasons)


def test_spikes_of_both_streams_cost_no_calibration_and_are_counted(tmp_path):
    late_s = 1.3
    calibration = dc.replay(
        recorded(tmp_path / "bag", (1.3, 0.2, 0.0), late_s, waves_mps=0.1, spikes=0.03), history=False
    )
    assert calibration.model == "full" and calibration.verdict != "reject", calibration.reasons
    np.testing.assert_allclose(calibration.mounting.xyz_m[:2], (1.3, 0.2), atol=0.05)
    assert calibration.mounting.time_offset_s == pytest.approx(late_s, abs=0.05)
    assert calibration.replayed.result.estimate.gated >= 20


@pytest.mark.slow
def test_the_report_says_where_the_dvl_is_and_how_late(tmp_path, monkeypatch):
    drawn(monkeypatch)  # the page is read, its pictures are not
    calibration = dc.replay(recorded(tmp_path / "bag", (1.3, 0.2, 0.0), -2.2))
    page = calibration.report(tmp_path / "report.html").read_text().replace("\N{MINUS SIGN}", "-")
    ahead, to_port, late = (
        float(re.search(rf"<span>{name}</span><b>([+-]?[\d.]+)&nbsp;", page)[1])
        for name in ("lever arm, ahead", "lever arm, to port", "DVL late against IMU")
    )
    np.testing.assert_allclose((ahead, to_port, late), (1.3, 0.2, -2.2), atol=0.05)
    assert re.search(r"<span>lever arm, up</span><b>.*not observable in this data", page)


@pytest.mark.slow
def test_a_reference_that_claims_no_noise_is_not_suspected_for_being_better_than_the_parameters_say(tmp_path):
    calibration = dc.replay(recorded(tmp_path / "bag", (1.3, 0.0, 0.0), 0.0, claimed=None), history=False)
    assert calibration.model == "full" and calibration.verdict == "accept", calibration.reasons


def test_a_dvl_that_is_turned_and_displaced_is_found_to_be_turned(tmp_path):
    bag = recorded(tmp_path / "bag", (1.0, 0.0, 0.0), 2.0, (0.0, 0.0, np.pi / 2.0))
    mounting = dc.replay(bag, history=False).mounting
    np.testing.assert_allclose(mounting.nominal_rpy_deg, (0.0, 0.0, 90.0), atol=1e-9)
    np.testing.assert_allclose(mounting.xyz_m[:2], (1.0, 0.0), atol=0.05)


def test_axes_that_point_down_are_not_hidden_by_a_lever_arm(tmp_path):
    bag = recorded(tmp_path / "bag", (-1.0, 0.0, 0.0), 1.0, (np.pi, 0.0, 0.0), 0.15)
    calibration = dc.replay(bag, history=False)
    assert calibration.discovery.parameters.dvl_axes == "frd"
    assert abs(calibration.mounting.xyz_m[0] + 1.0) < 0.05 and abs(calibration.mounting.rpy_deg[0]) < 1.0
