"""Tiny recordings of a fleet, on days of their own."""

from __future__ import annotations

import shutil
from functools import cache
from pathlib import Path

from io_fixtures import write_bag

from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

DAY_NS = 86_400_000_000_000


@cache
def dive(yaw: float, seed: int) -> tuple[DvlSample | ReferenceSample | ImuSample, ...]:
    """Two minutes of boxes. yaw: rad, of the DVL's misalignment."""
    errors = DvlErrors((0.01, -0.01, yaw), (0.002,) * 3, beam_std=0.003)
    made = simulate(
        Scenario(seconds=120.0, seed=seed, errors=errors, gnss_std=0.02, gnss_frame=VelocityFrame.BODY, imu_rate=10.0)
    )
    return tuple(sorted((*made.imu, *made.gnss, *made.dvl), key=lambda sample: sample.stamp_ns))


def write_dive(path: Path, day: int, yaw: float = 0.02, seed: int = 0, storage: str = "mcap") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    late = day * DAY_NS
    return write_bag(path, (each._replace(stamp_ns=each.stamp_ns + late) for each in dive(yaw, seed)), storage)


def write_fleet(place: Path) -> Path:
    """auv1 on three days, moved by 3° before the third; auv2 on one; a file that is cut and one that is no bag."""
    for day, yaw in enumerate((0.02, 0.02, 0.075)):
        write_dive(place / "auv1" / f"dive{day}", day, yaw, seed=day)
    write_dive(place / "auv2" / "late" / "dive", 1, 0.01, seed=3, storage="sqlite3")
    (place / "auv2" / "no.mcap").write_text("no bag\n")
    return place


def copies(place: Path, source: Path, count: int) -> Path:
    """So many folders that hold one recording."""
    for number in range(count):
        shutil.copytree(source, place / f"auv{number % 5}" / f"dive{number:04d}" / source.name)
    return place
