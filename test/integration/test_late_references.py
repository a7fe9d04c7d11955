"""A reference whose stamps are seconds late is the same cause of the same size to doctor, replay and diagnose."""

from __future__ import annotations

import heapq
import re

import numpy as np
import pytest
from io_fixtures import write_bag

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame

START_NS = 1_700_000_000_000_000_000
ENU = VelocityFrame.ENU
# One round: seconds, m/s, degrees/s
LEGS = np.array(
    [(30, 1.4, 0), (10, 1.4, 9), (25, 0.8, 0), (20, 0.8, -9), (35, 1.4, 0), (10, 1.4, -9), (20, 0.8, 0), (10, 0.8, 9)]
)


def bag_of(folder, reference_s=0.0, dvl_s=0.0, arm_m=0.0, hz=5):
    """Write seven minutes of a level vehicle that turns to both sides at two speeds. arm_m: DVL ahead of the GNSS."""
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 420.0, 0.01)
    ends = np.cumsum(LEGS[:, 0])
    legs = LEGS[np.searchsorted(ends, time % ends[-1], side="right")]
    inertia = np.ones(300) / 300
    speed, rate = (np.convolve(np.pad(legs[:, i], (150, 149), "edge"), inertia, "valid") for i in (1, 2))
    rate = np.radians(rate)
    yaw = 0.01 * np.cumsum(rate)

    def at(offset_s, step, start=0):
        return [(i, START_NS + round(1e9 * (time[i] + offset_s))) for i in range(start, len(time), step)]

    def noisy(velocity, std):
        return tuple((velocity + rng.normal(0.0, std, 3)).tolist())

    imu = [
        ImuSample(stamp, (0.0, 0.0, float(np.sin(yaw[i] / 2)), float(np.cos(yaw[i] / 2))), (0.0, 0.0, float(rate[i])))
        for i, stamp in at(0.0, 5)
    ]
    dvl = [DvlSample(ns, noisy([1.005 * speed[i], arm_m * rate[i], 0.0], 0.01)) for i, ns in at(dvl_s, 100 // hz)]
    gnss = [
        ReferenceSample(ns, noisy([speed[i] * np.cos(yaw[i]), speed[i] * np.sin(yaw[i]), 0.0], 0.05), None, ENU)
        for i, ns in at(reference_s, 100 // hz, 3)
    ]
    return write_bag(folder / "late", heapq.merge(imu, gnss, dvl, key=lambda sample: sample.stamp_ns))


@pytest.mark.slow
def test_doctor_replay_and_diagnose_agree_on_how_late_a_reference_is(tmp_path, capsys):
    """Diagnose could not tell the clock from a lever arm, which registration rules out by a chi-square of 300."""
    seconds = 7.5
    bag = bag_of(tmp_path, reference_s=seconds)
    print(dc.doctor(bag))
    text = " ".join(capsys.readouterr().out.split())
    found = re.search(r"the reference's stamps are (\S+) ± (\S+) s late against DVL and IMU", text)
    assert found is not None and abs(float(found[1]) - seconds) < 2.0 * float(found[2]), text
    run = dc.replay(bag, history=False)
    assert run.verdict == "accept"
    assert run.replayed.result.parameters["reference_time_offset"] == pytest.approx(seconds, abs=0.03)
    diagnosed = dc.diagnose(bag)
    (effect,) = diagnosed.effects
    assert diagnosed.verdict.value == "known"
    assert effect.name == "reference_time_offset" and effect.equivalent_to == ()
    _, low, high = effect.parameters["seconds"]
    assert low < seconds < high and high - low < 0.1


@pytest.mark.slow
def test_an_arm_that_one_sample_a_second_hardly_shows_is_not_ruled_out_by_the_clock(tmp_path):
    """The likelihood calls for the arm, the scatter of blocks does not: the clock alone would be wrong."""
    diagnosed = dc.diagnose(bag_of(tmp_path, reference_s=2.5, arm_m=0.3, hz=1))
    assert "lever_arm" in {name for each in diagnosed.effects for name in (each.name, *each.equivalent_to)}
