"""Samples to ROS messages, in bags."""

from __future__ import annotations

import heapq
import math
import struct
from collections.abc import Iterable
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from ..bags.writer import BagWriter
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample, Sample, VelocityFrame
from .drivers import IMU_TYPE, TWIST_TYPE

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
TEMPERATURE_TYPE, NUMBER_TYPE = "sensor_msgs/msg/Temperature", "std_msgs/msg/Float64"

FRAME_IDS = {VelocityFrame.ENU: "map", VelocityFrame.NED: "ned", VelocityFrame.BODY: "base_link"}


class SatelliteFix(NamedTuple):
    """A position of a receiver, degrees; its height is not known."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float


class WaterReading(NamedTuple):
    """What a DVL says of its water. speed_of_sound: m/s, that it counts with. temperature: °C; salinity: PSU; nan where
    no sensor measures it."""

    stamp_ns: int
    speed_of_sound: float
    temperature: float
    salinity: float


# CDR of what a recording has by the ten thousand: little-endian, numbers at multiples of their size behind four bytes
_CDR = b"\0\1\0\0"
_THREE, _FOUR = struct.Struct("<3d"), struct.Struct("<4d")
_NO_VECTOR, _NO_COVARIANCE, _NO_TWIST_COVARIANCE = bytes(24), bytes(72), bytes(288)
_UNKNOWN = struct.pack("<9d", -1.0, *[0.0] * 8)
# What is written of each second is enough of what changes slowly
_WATER_EVERY_NS = 1_000_000_000


class SampleWriter:
    """Writes samples to a bag, log time is the stamp."""

    def __init__(self, bag: BagWriter) -> None:
        self._bag = bag
        self._types: Any = bag.typestore.types

    def recording(self, *sensors: Iterable[Sample | SatelliteFix]) -> None:
        """Write the samples of any sensors, each in order of time, to the node's topics in order of time."""
        for sample in heapq.merge(*sensors, key=attrgetter("stamp_ns")):
            if isinstance(sample, DvlSample):
                self.dvl("dvl/twist", sample)
            elif isinstance(sample, ReferenceSample):
                self.reference("gnss/twist", sample, FRAME_IDS[sample.frame])
            elif isinstance(sample, SatelliteFix):
                self.fix("gnss/fix", sample)
            else:
                self.imu("imu/data", sample)

    def dvl(self, topic: str, sample: DvlSample, frame_id: str = "dvl_link") -> None:
        """Write a DVL velocity as TwistWithCovarianceStamped."""
        self._bag.serialised(topic, TWIST_TYPE, sample.stamp_ns, _twist(sample, frame_id))

    def reference(self, topic: str, sample: ReferenceSample, frame_id: str) -> None:
        """Write a reference velocity as TwistWithCovarianceStamped."""
        self._bag.serialised(topic, TWIST_TYPE, sample.stamp_ns, _twist(sample, frame_id))

    def fix(self, topic: str, fix: SatelliteFix, frame_id: str = "gnss") -> None:
        """Write a position as NavSatFix, without a covariance."""
        types = self._types
        message = types[FIX_TYPE](
            header=self._header(fix.stamp_ns, frame_id),
            status=types["sensor_msgs/msg/NavSatStatus"](0, 1),
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=0.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )
        self._bag.message(topic, FIX_TYPE, fix.stamp_ns, message)

    def imu(self, topic: str, sample: ImuSample, frame_id: str = "base_link") -> None:
        """Write attitude and angular velocity as Imu, with covariance -1 where there is none."""
        data = (
            _header(sample.stamp_ns, frame_id),
            _FOUR.pack(*(sample.orientation or (0.0, 0.0, 0.0, 1.0))),
            _NO_COVARIANCE if sample.orientation else _UNKNOWN,
            _THREE.pack(*sample.angular_velocity) if sample.angular_velocity else _NO_VECTOR,
            _NO_COVARIANCE if sample.angular_velocity else _UNKNOWN,
            _NO_VECTOR,
            _UNKNOWN,
        )
        self._bag.serialised(topic, IMU_TYPE, sample.stamp_ns, b"".join(data))

    def water(self, readings: Iterable[WaterReading]) -> int:
        """Write what a DVL says of its water, at most one reading a second; how many were written."""
        types, last_ns, written = self._types, 0, 0
        for each in readings:
            if written and abs(each.stamp_ns - last_ns) < _WATER_EVERY_NS:
                continue
            last_ns, written = each.stamp_ns, written + 1
            if not math.isnan(each.temperature):
                message = types[TEMPERATURE_TYPE](self._header(each.stamp_ns, "dvl_link"), each.temperature, 0.0)
                self._bag.message("dvl/temperature", TEMPERATURE_TYPE, each.stamp_ns, message)
            for name, value in (("sound_speed", each.speed_of_sound), ("salinity", each.salinity)):
                if not math.isnan(value):
                    self._bag.message(f"dvl/{name}", NUMBER_TYPE, each.stamp_ns, types[NUMBER_TYPE](value))
        return written

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
        return self._types["std_msgs/msg/Header"](time, frame_id)


def _header(stamp_ns: int, frame_id: str) -> bytes:
    """The beginning of a message with a header, up to where numbers of eight bytes go on."""
    layout, text = _behind_header(frame_id)
    return layout.pack(_CDR, *divmod(stamp_ns, 1_000_000_000), len(text), text)


@cache
def _behind_header(frame_id: str) -> tuple[struct.Struct, bytes]:
    text = frame_id.encode() + b"\0"
    return struct.Struct(f"<4siII{len(text)}s{-(12 + len(text)) % 8}x"), text


def _twist(sample: DvlSample | ReferenceSample, frame_id: str) -> bytes:
    """A TwistWithCovarianceStamped, serialised."""
    covariance = _NO_TWIST_COVARIANCE
    if sample.covariance is not None:
        whole = np.zeros((6, 6), dtype="<f8")
        whole[:3, :3] = sample.covariance
        covariance = whole.tobytes()
    return b"".join((_header(sample.stamp_ns, frame_id), _THREE.pack(*sample.velocity), _NO_VECTOR, covariance))
