"""What a calibration found, quantity by quantity, in the units and signs by which a DVL is mounted."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from ..filters.observability import OBSERVED_SHARE
from ..models import MODELS
from ..models.parameters import Parameters
from ..numerics.kalman import GaussianState
from .results import Result, corrected_rpy, rpy_std, scale_and_delay

# Axes of `observability` that only a recording with angular velocities can show.
_NEED_IMU = ("lever arm x", "lever arm y", "lever arm z", "time offset")


class Quantity(NamedTuple):
    """nominal, value, std: as configured, as found, and its σ, in this unit. shown: whether the recording shows it."""

    name: str
    nominal: float
    value: float
    std: float
    unit: str
    shown: bool

    def in_unit(self, number: float, signed: bool = False) -> str:
        """A number of this quantity as people read it, such as ``+0.27 %``."""
        return f"{round(number, 2) + 0.0:{'+' if signed else ''}.2f}{self.unit}"  # + 0.0: no minus before zero


def quantities(result: Result) -> list[Quantity]:
    """Roll, pitch, yaw of the DVL (°); of models that have them scale of motion ahead (%), lever arm (m), delay (s).

    Angles are those of a URDF's origin, within half a turn of the configured ones. One that no motion has told from
    what is known without data is not shown. Without an IMU there is neither lever arm nor delay.
    """
    estimate, parameters = result.estimate, Parameters.from_mapping(result.parameters)
    nominal = np.degrees(parameters.mounting_rpy)
    corrected = np.degrees(corrected_rpy(estimate.misalignment, parameters))
    std = np.degrees(rpy_std(estimate.misalignment, estimate.covariance, parameters))
    unknown = OBSERVED_SHARE * np.degrees(parameters.initial_std_misalignment)
    unseen = {entry.axis for entry in estimate.observability if not entry.observed}
    found = [
        Quantity(name, float(nominal[i]), float(corrected[i]), float(std[i]), "°", bool(std[i] <= unknown))
        for i, name in enumerate(("roll", "pitch", "yaw"))
    ]
    beside = scale_and_delay(MODELS[estimate.model], GaussianState(estimate.state, estimate.covariance), parameters)
    if beside.scale_std is not None:
        shown = "scale" not in unseen
        found.append(Quantity("scale", 0.0, 100.0 * beside.scale, 100.0 * beside.scale_std, " %", shown))
    if not _has_imu(result):
        return found
    arm_std = estimate.std_of("lever_arm_x", "lever_arm_y", "lever_arm_z")
    if arm_std is not None:
        arm = estimate.lever_arm(parameters.lever_arm)
        found += [
            Quantity(name, parameters.lever_arm[i], float(arm[i]), float(arm_std[i]), " m", name not in unseen)
            for i, name in enumerate(("lever arm x", "lever arm y", "lever arm z"))
        ]
    for delay in result.delays:
        of_day = "" if delay.day is None else f", {delay.day.name or date(delay.day.first_ns)}"
        found.append(
            Quantity(f"stamps late{of_day}", parameters.dvl_time_offset, delay.seconds, delay.std, " s", delay.shown)
        )
    return found


def not_shown(result: Result) -> dict[str, str]:
    """The axes that the data do not show, by what they lack.

    An angle is that about an axis of the vehicle, and says so where the DVL's own angle of the same name is shown: of a
    DVL that is mounted across, the vehicle's roll is the DVL's pitch. A scale across is none of the quantities, and
    few vehicles can show it.
    """
    shown = {each.name for each in quantities(result) if each.shown}
    causes: dict[str, dict[str, None]] = {}
    for entry in result.estimate.observability:
        if entry.axis in _NEED_IMU and not _has_imu(result):
            continue
        if entry.missing and entry.axis != "scale across":
            axis = f"the vehicle's {entry.axis} axis" if entry.axis in shown else entry.axis
            causes.setdefault(entry.missing, {})[axis] = None
    return {missing: " and ".join(axes) for missing, axes in causes.items()}


def _has_imu(result: Result) -> bool:
    return result.counts["imu"]["received"] > 0


def date(stamp_ns: int) -> str:
    """A stamp as people read it, UTC."""
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).strftime("%Y-%m-%d %H:%M")
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns * 1e-9:.0f} s"
