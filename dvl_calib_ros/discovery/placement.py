"""Mounting, lever arm and the IMU's orientation from transforms, for a node that hears frames and transforms live."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np

from ..calibration.frames import Array, rpy_from_rotation
from ..calibration.parameters import FLU, FROM_MESSAGE, FROM_REFERENCE, TOLD, Parameters
from .transforms import FrameTree

# The range of parameter lever_arm, m: more is a transform in another unit.
FARTHEST = 100.0


class Frames(NamedTuple):
    """frame_ids of the streams' messages, '' where none has come. points_down: the DVL's data are
    forward-right-down. reference_in_body: the reference is the velocity of the body's own frame.
    """

    dvl: str
    reference: str
    imu: str
    points_down: bool
    reference_in_body: bool = False


class Placement(NamedTuple):
    """Values of parameters that transforms give, and what to say of them."""

    values: dict[str, Any]
    said: str


def not_default(parameters: Parameters) -> frozenset[str]:
    """Names of the parameters that somebody has set to another value than the default."""
    default = Parameters()
    return frozenset(name for name in default.as_dict() if getattr(parameters, name) != getattr(default, name))


def placement(tree: FrameTree, frames: Frames, parameters: Parameters, given: Collection[str]) -> Placement | None:
    """What transforms say of mounting_rpy, lever_arm and imu_rpy, unless given; None if they do not place the DVL."""
    placed = tree.placed(frames.dvl, parameters.base_frame)
    if placed is None or not placed.source:
        return None
    values: dict[str, Any] = {}
    said = []
    if "mounting_rpy" not in given:
        values["mounting_rpy"] = _numbers(rpy_from_rotation(placed.rotation))
        said.append("mounting " + " ".join(f"{math.degrees(angle):.4g}°" for angle in values["mounting_rpy"]))
        if frames.points_down and placed.rotation[2, 2] < 0.0 and parameters.dvl_axes == FROM_MESSAGE:
            values["dvl_axes"] = FLU  # the transform is of the driver's own axes, which the data are in
    if "lever_arm" not in given:
        reference = tree.placed(frames.reference, parameters.base_frame) if frames.reference else None
        at = np.zeros(3) if reference is None else reference.position
        position = placed.position - at
        if np.abs(position).max() <= FARTHEST:
            values["lever_arm"] = _numbers(position)
            if "dvl_position" not in given:
                known = frames.reference_in_body or (reference is not None and bool(reference.source))
                values["dvl_position"] = FROM_REFERENCE if known else TOLD
                if "reference_position" not in given and at.any():
                    values["reference_position"] = _numbers(at)
            said.append("lever arm " + " ".join(f"{value:.3g}" for value in values["lever_arm"]) + " m")
    imu = tree.placed(frames.imu, parameters.base_frame) if frames.imu else None
    if imu is not None and imu.source and "imu_rpy" not in given and not np.allclose(imu.rotation, np.eye(3)):
        values["imu_rpy"] = _numbers(rpy_from_rotation(imu.rotation))
        said.append("imu_rpy " + " ".join(f"{math.degrees(angle):.4g}°" for angle in values["imu_rpy"]))
    if "base_frame" not in given and placed.base != parameters.base_frame.strip("/"):
        values["base_frame"] = placed.base
    return Placement(values, f"{', '.join(said)}: {placed.frame} in {placed.base}, from {placed.source}")


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple((values + 0.0).tolist())
