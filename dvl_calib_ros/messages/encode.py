"""Conversion of samples to ROS messages in bags."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ..bags.writer import BagWriter
from ..calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, Sample, VelocityFrame
from .drivers import IMU_TYPE, TWIST_TYPE

FIX_TYPE = "sensor_msgs/msg/NavSatFix"
STRING_TYPE = "std_msgs/msg/String"
TEMPERATURE_TYPE, NUMBER_TYPE = "sensor_msgs/msg/Temperature", "std_msgs/msg/Float64"

FRAME_IDS = {VelocityFrame.ENU: "map", VelocityFrame.NED: "ned", VelocityFrame.BODY: "base_link"}


class SatelliteFix(NamedTuple):
    """A receiver's position, degrees, without height."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float


class WaterReading(NamedTuple):
    """A DVL's water properties.

    speed_of_sound: m/s, as used by the DVL.
    temperature: °C.
    salinity: PSU. nan if not measured.
    """

    stamp_ns: int
    speed_of_sound: float
    temperature: float
    salinity: float


# a joint whose origin has no xyz defines the DVL's orientation but not its position
_TURNED = (
    '<robot name="dvl"><link name="base_link"/><link name="dvl_link"/><joint name="dvl_joint" type="fixed">'
    '<parent link="base_link"/><child link="dvl_link"/><origin rpy="0 0 {yaw:.6f}"/></joint></robot>'
)
# one reading per second is enough for slow changes
_WATER_EVERY_NS = 1_000_000_000


class SampleWriter:
    """Writer of samples to a bag; the log time is the stamp."""

    def __init__(self, bag: BagWriter) -> None:
        self._bag = bag
        self._types: Any = bag.typestore.types
        # constant parts of messages are created once
        self._still = self._types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        self._exact, self._unknown = np.zeros(9), np.array([-1.0, *[0.0] * 8])

    def recording(self, *sensors: Iterable[Sample | SatelliteFix]) -> None:
        """Write the samples of any sensors, each in order of time, to the node's topics in order of time."""
        for sample in heapq.merge(*sensors, key=lambda sample: sample.stamp_ns):
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
        self._bag.message(topic, TWIST_TYPE, sample.stamp_ns, self._twist(sample, frame_id))

    def reference(self, topic: str, sample: ReferenceSample, frame_id: str) -> None:
        """Write a reference velocity as TwistWithCovarianceStamped."""
        self._bag.message(topic, TWIST_TYPE, sample.stamp_ns, self._twist(sample, frame_id))

    def fix(self, topic: str, fix: SatelliteFix) -> None:
        """Write a position as NavSatFix, without a covariance."""
        types = self._types
        message = types[FIX_TYPE](
            header=self._header(fix.stamp_ns, "gnss"),
            status=types["sensor_msgs/msg/NavSatStatus"](0, 1),
            latitude=fix.latitude_deg,
            longitude=fix.longitude_deg,
            altitude=0.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )
        self._bag.message(topic, FIX_TYPE, fix.stamp_ns, message)

    def imu(self, topic: str, sample: ImuSample, frame_id: str = "base_link") -> None:
        """Write attitude and angular velocity as Imu, with covariance -1 for missing ones."""
        quaternion, vector = self._types["geometry_msgs/msg/Quaternion"], self._types["geometry_msgs/msg/Vector3"]
        message = self._types[IMU_TYPE](
            header=self._header(sample.stamp_ns, frame_id),
            orientation=quaternion(*(sample.orientation or (0.0, 0.0, 0.0, 1.0))),
            orientation_covariance=self._exact if sample.orientation else self._unknown,
            angular_velocity=vector(*sample.angular_velocity) if sample.angular_velocity else self._still,
            angular_velocity_covariance=self._exact if sample.angular_velocity else self._unknown,
            linear_acceleration=self._still,
            linear_acceleration_covariance=self._unknown,
        )
        self._bag.message(topic, IMU_TYPE, sample.stamp_ns, message)

    def nominal_yaw(self, stamp_ns: int, yaw: float) -> None:
        """Write the DVL's nominal yaw (rad) in base_link as a robot_description."""
        message = self._types[STRING_TYPE](_TURNED.format(yaw=yaw))
        self._bag.message("robot_description", STRING_TYPE, stamp_ns, message)

    def water(self, readings: Iterable[WaterReading]) -> int:
        """Write a DVL's water readings, at most one per second. Return their number."""
        types, last_ns, written = self._types, 0, 0
        for reading in readings:
            if written and abs(reading.stamp_ns - last_ns) < _WATER_EVERY_NS:
                continue
            last_ns, written = reading.stamp_ns, written + 1
            if not math.isnan(reading.temperature):
                message = types[TEMPERATURE_TYPE](self._header(reading.stamp_ns, "dvl_link"), reading.temperature, 0.0)
                self._bag.message("dvl/temperature", TEMPERATURE_TYPE, reading.stamp_ns, message)
            for name, value in (("sound_speed", reading.speed_of_sound), ("salinity", reading.salinity)):
                if not math.isnan(value):
                    self._bag.message(f"dvl/{name}", NUMBER_TYPE, reading.stamp_ns, types[NUMBER_TYPE](value))
        return written

    def _twist(self, sample: DvlSample | ReferenceSample, frame_id: str) -> Any:
        """Return a velocity and its covariance as TwistWithCovarianceStamped."""
        types = self._types
        vector = types["geometry_msgs/msg/Vector3"]
        covariance = np.zeros((6, 6))
        if sample.covariance is not None:
            covariance[:3, :3] = sample.covariance
        twist = types["geometry_msgs/msg/Twist"](vector(*sample.velocity), self._still)
        inner = types["geometry_msgs/msg/TwistWithCovariance"](twist, covariance.ravel())
        return types[TWIST_TYPE](self._header(sample.stamp_ns, frame_id), inner)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
        return self._types["std_msgs/msg/Header"](time, frame_id)
