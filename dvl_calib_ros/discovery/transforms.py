"""Mounting, lever arm and IMU orientation from /tf_static or /robot_description, recorded or live."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..calibration.models.parameters import FLU, FROM_MESSAGE, FROM_REFERENCE, TOLD, Parameters
from ..calibration.numerics.frames import Array, rotation_from_quaternion, rotation_from_rpy, rpy_from_rotation
from ..errors import InputError
from ..files.urdf import parse_urdf
from ..verdict.reasons import Reason, finding

# frames above the vehicle, on which no sensor is mounted
EARTH_NAMES = ("map", "odom", "world", "earth", "enu", "ned", "utm")
# a longer chain of transforms is a circle
LONGEST_CHAIN = 100


class Placed(NamedTuple):
    """A frame's pose in another. rotation: (3, 3) ``rotation_base_from_frame``. position: (3,) m, in the base.

    is_located: whether the position is known; a URDF joint whose origin has only rpy does not define it.
    """

    base: str
    frame: str
    rotation: Array
    position: Array
    source: str
    is_located: bool = True


@dataclass
class FrameTree:
    """Tree of fixed transforms, by child. Names have no leading slash."""

    _parents: dict[str, tuple[str, Array, Array, str]] = field(default_factory=dict)
    problems: list[Reason] = field(default_factory=list)

    @staticmethod
    def of(transforms: Iterable[Any], descriptions: Iterable[str]) -> FrameTree:
        """Build from messages (geometry_msgs/TransformStamped), which take precedence, and texts of URDFs."""
        tree = FrameTree()
        for text in descriptions:
            tree._add_urdf(text)
        for transform in transforms:
            t, q = transform.transform.translation, transform.transform.rotation
            quaternion = np.array([q.x, q.y, q.z, q.w])
            length = float(np.linalg.norm(quaternion))
            if not 0.5 < length < 2.0 or not np.isfinite([t.x, t.y, t.z]).all():
                tree.problems.append(finding("TRANSFORM_NOT_ROTATION", frame=transform.child_frame_id))
                continue
            rotation = rotation_from_quaternion(quaternion / length)
            parent, child = _plain(transform.header.frame_id), _plain(transform.child_frame_id)
            tree._parents[child] = (parent, rotation, np.array([t.x, t.y, t.z]), "/tf_static")
        return tree

    def _add_urdf(self, text: str) -> None:
        """Add the fixed joints of a robot description; a missing xyz makes the position nan."""
        try:
            urdf = parse_urdf(Path("/robot_description"), text.encode())
        except InputError as error:
            self.problems.append(finding("URDF_NOT_READ", reason=error))
            return
        for joint in urdf.joints:
            if joint.kind == "fixed":
                rotation, position = rotation_from_rpy(joint.rpy), np.array(joint.xyz)
                if joint.origin is not None and b"xyz" not in urdf.content[slice(*joint.origin)]:
                    position = np.full(3, np.nan)
                self._parents[_plain(joint.child)] = (_plain(joint.parent), rotation, position, "/robot_description")

    def as_urdf(self, description: str = "") -> str:
        """Return a description (URDF) with the transforms of /tf_static as additional fixed joints."""
        from html import escape

        joints = [
            f'<link name="{escape(child)}"/><joint name="{escape(child)}_fixed" type="fixed">'
            f'<parent link="{escape(parent)}"/><child link="{escape(child)}"/>'
            f'<origin xyz="{_exactly(position)}" rpy="{_exactly(rpy_from_rotation(rotation))}"/></joint>'
            for child, (parent, rotation, position, source) in self._parents.items()
            if source == "/tf_static" and f"{child}{parent}".isprintable()
        ]
        head, end, tail = (description or '<robot name="recorded"></robot>').rpartition("</robot>")
        return "".join([head, *joints, end, tail])

    @property
    def frames(self) -> set[str]:
        """All frames that have a parent."""
        return set(self._parents)

    def named(self, frame_id: str) -> str | None:
        """Return the frame as spelled in the tree, with or without a namespace; None if unknown."""
        name = _plain(frame_id)
        known = {*self._parents, *(parent for parent, *_ in self._parents.values())}
        if name in known:
            return name
        last = _last_part(name)
        same = [other for other in known if last and _last_part(other) == last]
        return same[0] if len(same) == 1 else None

    def body_above(self, frame: str, wanted: str) -> str | None:
        """Return the body frame above a frame; None if there is none.

        This is the frame named `wanted`, in any namespace, else the highest one that is no earth frame.
        """
        name = frame
        above: list[str] = []
        while name in self._parents and len(above) < LONGEST_CHAIN:
            name = self._parents[name][0]
            above.append(name)
        for link in above:
            if _same(link, wanted):
                return link
        of_vehicle = [link for link in above if _last_part(link).lower() not in EARTH_NAMES]
        return of_vehicle[-1] if of_vehicle else None

    def placed(self, frame_id: str, base_frame: str) -> Placed | None:
        """Return the pose of a frame in the body; None if the transforms do not connect them."""
        frame = self.named(frame_id)
        if frame is None:
            return None
        base = self.body_above(frame, base_frame)
        if base is None:
            return Placed(frame, frame, np.eye(3), np.zeros(3), "") if _same(frame, base_frame) else None
        rotation, position, sources = np.eye(3), np.zeros(3), []
        name = frame
        while name != base:
            name, above, offset, source = self._parents[name]
            rotation, position = above @ rotation, above @ position + offset
            sources.append(source)
        is_located = bool(np.isfinite(position).all())
        source = " and ".join(dict.fromkeys(sources))
        return Placed(base, frame, rotation, position if is_located else np.zeros(3), source, is_located)

    def only_named_like(self, words: Iterable[str]) -> str | None:
        """Return the only frame whose name has one of these words, for a frame_id that is not in the tree."""
        found = [frame for frame in sorted(self._parents) if any(word in frame.lower() for word in words)]
        return found[0] if len(found) == 1 else None


def _exactly(values: Array) -> str:
    return " ".join(map(repr, values.tolist()))


def _plain(frame_id: str) -> str:
    return frame_id.strip("/")


def _last_part(frame: str) -> str:
    """Return the name of a frame without its namespace."""
    return frame.rsplit("/", 1)[-1]


def _same(frame: str, base: str) -> bool:
    """Return whether two names are one frame, but for namespaces."""
    return _last_part(frame) == _last_part(_plain(base))


# range of parameter lever_arm, m; a larger value is a transform in another unit
FARTHEST = 100.0


class Frames(NamedTuple):
    """frame_ids of the streams' messages, '' before the first one.

    points_down: the DVL's data are forward-right-down. reference_in_body: the reference measures the velocity of the
    body frame's origin.
    """

    dvl: str
    reference: str
    imu: str
    points_down: bool
    reference_in_body: bool = False


class Placement(NamedTuple):
    """Parameters from transforms, and a sentence that describes them."""

    values: dict[str, Any]
    said: str


def placement(tree: FrameTree, frames: Frames, parameters: Parameters, given: Collection[str]) -> Placement | None:
    """Return mounting_rpy, lever_arm and imu_rpy from transforms, unless given; None if they do not place the DVL."""
    placed = tree.placed(frames.dvl, parameters.base_frame)
    if placed is None or not placed.source:
        return None
    values: dict[str, Any] = {}
    parts = []
    if "mounting_rpy" not in given:
        values["mounting_rpy"] = _numbers(rpy_from_rotation(placed.rotation))
        parts.append(f"mounting {in_degrees(values['mounting_rpy'])}")
        is_drivers = frames.points_down and placed.rotation[2, 2] < 0.0 and not parameters.is_z_down
        if is_drivers and parameters.dvl_axes == FROM_MESSAGE:
            values["dvl_axes"] = FLU  # the transform describes the driver's own axes, in which the data are
    if "lever_arm" not in given and placed.is_located:
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
            parts.append(f"lever arm {in_metres(values['lever_arm'])} m")
    imu = tree.placed(frames.imu, parameters.base_frame) if frames.imu else None
    if imu is not None and imu.source and "imu_rpy" not in given and not np.allclose(imu.rotation, np.eye(3)):
        values["imu_rpy"] = _numbers(rpy_from_rotation(imu.rotation))
        parts.append(f"imu_rpy {in_degrees(values['imu_rpy'])}")
    if "base_frame" not in given and placed.base != parameters.base_frame.strip("/"):
        values["base_frame"] = placed.base
    return Placement(values, f"{', '.join(parts)}: {placed.frame} in {placed.base}, from {placed.source}")


def in_degrees(rpy: Iterable[float]) -> str:
    """Return roll, pitch, yaw (rad) as text in degrees."""
    return " ".join(f"{round(math.degrees(angle), 2) + 0.0:g}°" for angle in rpy)


def in_metres(position: Iterable[float]) -> str:
    """Return a position (m) as text."""
    return " ".join(f"{value + 0.0:.3g}" for value in position)


def _numbers(values: Array) -> tuple[float, ...]:
    return tuple((values + 0.0).tolist())
