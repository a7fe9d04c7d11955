"""Bags of a dive whose recording tells of its water, and a DVL that was set to another speed of sound."""

from __future__ import annotations

from pathlib import Path

from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.checks.speed_of_sound import speed_of_sound
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.messages.encode import SampleWriter, WaterReading
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

TEMPERATURE, SALINITY = 12.1, 35.0
USED = 1.0124 * speed_of_sound(TEMPERATURE, SALINITY)


def dive(scale: float = 0.0124, day: int = 0):
    errors = DvlErrors((0.01, -0.01, 0.02), (scale,) * 3, beam_std=0.003)
    made = simulate(
        Scenario("figure8", 480.0, seed=1, errors=errors, gnss_std=0.02, gnss_frame=VelocityFrame.BODY, imu_rate=10.0)
    )
    late_ns = day * 86_400_000_000_000
    return tuple(
        [each._replace(stamp_ns=each.stamp_ns + late_ns) for each in samples]
        for samples in (made.imu, made.gnss, made.dvl)
    )


def with_water(path: Path, temperature: float = TEMPERATURE, salinity: float = SALINITY, day: int = 0) -> Path:
    imu, gnss, dvl = dive(day=day)
    with BagWriter(path) as bag:
        writer = SampleWriter(bag)
        writer.recording(imu, gnss, dvl)
        writer.water(WaterReading(each.stamp_ns, USED, temperature, salinity) for each in dvl)
    return path
