"""Quantities of a calibration in the units and signs used to mount a DVL."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from ..filters.observability import OBSERVED_SHARE
from ..models import MODELS
from ..models.parameters import Parameters
from ..numerics.kalman import GaussianState
from .results import Estimate, Result, corrected_rpy, rpy_std, scale_and_delay

# Axes of `observability` that need angular velocities.
_NEED_IMU = ("lever arm x", "lever arm y", "lever arm z", "time offset")
# name of the DVL's delay
LATE = "DVL late against IMU"


class Quantity(NamedTuple):
    """Configured (nominal) and estimated value, its σ, the unit, and whether the quantity is observable (shown)."""

    name: str
    nominal: float
    value: float
    std: float
    unit: str
    shown: bool

    def in_unit(self, number: float, signed: bool = False) -> str:
        """Return a number of this quantity for display, such as ``+0.27 %``."""
        return f"{round(number, 2) + 0.0:{'+' if signed else ''}.2f}{self.unit}"  # + 0.0 avoids -0.00


def quantities(result: Result) -> list[Quantity]:
    """Return roll, pitch, yaw of the DVL (°), and by model scale of motion ahead (%), lever arm (m), delay (s).

    Angles are those of a URDF origin, within half a turn of the configured ones. An angle is not shown if its σ is near
    the prior. Lever arm and delay need an IMU.
    """
    estimate, parameters = result.estimate, Parameters.from_mapping(result.parameters)
    nominal = np.degrees(parameters.mounting_rpy)
    corrected = np.degrees(corrected_rpy(estimate.misalignment, parameters))
    std = np.degrees(rpy_std(estimate.misalignment, estimate.covariance, parameters))
    max_std = OBSERVED_SHARE * np.degrees(parameters.initial_std_misalignment)
    not_observable = {entry.axis for entry in estimate.observability if not entry.observed}
    found = [
        Quantity(name, float(nominal[i]), float(corrected[i]), float(std[i]), "°", bool(std[i] <= max_std))
        for i, name in enumerate(("roll", "pitch", "yaw"))
    ]
    others = scale_and_delay(MODELS[estimate.model], GaussianState(estimate.state, estimate.covariance), parameters)
    if others.scale_std is not None:
        shown = "scale" not in not_observable
        found.append(Quantity("scale", 0.0, 100.0 * others.scale, 100.0 * others.scale_std, " %", shown))
    if not _has_imu(result):
        return found
    arm_std = estimate.std_of("lever_arm_x", "lever_arm_y", "lever_arm_z")
    if arm_std is not None:
        arm = estimate.lever_arm(parameters.lever_arm)
        found += [
            Quantity(name, parameters.lever_arm[i], float(arm[i]), float(arm_std[i]), " m", name not in not_observable)
            for i, name in enumerate(("lever arm x", "lever arm y", "lever arm z"))
        ]
    for delay in result.delays:  # one per recording, or one for all
        name = LATE if delay.day is None else f"{LATE}, {delay.day.name or date(delay.day.first_ns)}"
        found.append(Quantity(name, parameters.dvl_time_offset, delay.seconds, delay.std, " s", delay.shown))
    return found


def not_shown(result: Result) -> dict[str, str]:
    """Return the axes that are not observable, by the missing motion or sensor.

    Angles are about axes of the vehicle. The text says so if the DVL angle of the same name is observable: with a DVL
    mounted across, roll of the vehicle is pitch of the DVL. The scale across is omitted, because few vehicles can
    observe it.
    """
    shown = {quantity.name for quantity in quantities(result) if quantity.shown}
    causes: dict[str, dict[str, None]] = {}
    for entry in result.estimate.observability:
        if entry.axis in _NEED_IMU and not _has_imu(result):
            continue
        if entry.missing and entry.axis != "scale across":
            axis = f"the vehicle's {entry.axis} axis" if entry.axis in shown else entry.axis
            causes.setdefault(entry.missing, {})[axis] = None
    for name in ("roll", "pitch", "yaw"):
        if name not in shown.union(*causes.values()):
            causes.setdefault(missing_for(name, result.estimate), {})[name] = None
    return {missing: " and ".join(axes).replace("time offset", LATE) for missing, axes in causes.items()}


def missing_for(name: str, estimate: Estimate) -> str:
    """Return what makes a quantity observable. Roll and pitch need the same if a turned DVL mixes them."""
    missing = {entry.axis: entry.missing for entry in estimate.observability if entry.missing}
    other = missing.get({"roll": "pitch", "pitch": "roll"}.get(name, ""))
    return missing.get(name) or other or MODELS[estimate.model].shown_by[name]


def _has_imu(result: Result) -> bool:
    return result.counts["imu"]["received"] > 0


def date(stamp_ns: int) -> str:
    """Return a stamp as date and time for display, UTC."""
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).strftime("%Y-%m-%d %H:%M")
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns * 1e-9:.0f} s"
