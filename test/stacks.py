"""Recordings as fourteen realistic vehicles make them, written from the message definitions of their drivers.

One simulated run, of which the truth is known, told by each vehicle in its own words: its topics, types, frames, axes
and transforms. The DVL sits at `LEVER_ARM` with a mounting of each stack's own, and is misaligned by `MISALIGNMENT`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from driver_fixtures import Maker
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NED, FLU_FROM_FRD, Array, cross, rotation_from_rpy
from dvl_calib_ros.simulation.trajectories import Motion, make_motion

START_NS = 1_760_000_000_000_000_000
SECONDS = 150.0
MISALIGNMENT = (0.012, -0.017, 0.026)  # rad: 0.7, -1.0, 1.5 degrees
LEVER_ARM = (-0.6, 0.15, -0.3)
DVL_STD, GNSS_STD = 0.01, 0.05
LATITUDE, LONGITUDE, METRES_PER_DEGREE = 43.08, 10.9, 111_194.9
MARINE, A50 = "marine_acoustic_msgs/msg/Dvl", "dvl_msgs/msg/DVL"
TWIST, TWIST_STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"
ODOMETRY, IMU, FIX = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
TF, STRING = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"
Row = tuple[int, str, str, Any]
"""Log time (ns), topic, type, message."""


@cache
def motion() -> Motion:
    """The vehicle's motion at 100 Hz, and where it is."""
    rng = np.random.default_rng(11)
    return make_motion("free", SECONDS, 100.0, rng)


def positions(m: Motion | None = None) -> Array:
    """East, north, up (N, 3) m at a motion's times, of `motion` if none is given."""
    m = m or motion()
    velocity = np.einsum("nij,nj->ni", m.rotation_enu_from_body, m.velocity_body)
    return np.cumsum(velocity, axis=0) * 0.01


@dataclass
class Told:
    """Writes one vehicle's messages. version: of dvl_msgs. motion: at 100 Hz."""

    version: str = "first"
    rows: list[Row] = field(default_factory=list)
    seed: int = 5
    motion: Motion = field(default_factory=motion)

    def __post_init__(self) -> None:
        self.make = Maker(self.version)
        self.rng = np.random.default_rng(self.seed)

    def types(self, name: str, *values: Any, **fields: Any) -> Any:
        return self.make.store.types[name](*values, **fields)

    def every(self, rate_hz: float, phase_s: float = 0.0) -> list[tuple[int, int]]:
        """Places in the motion and stamps of a sensor."""
        step = round(100.0 / rate_hz)
        return [(i, START_NS + i * 10_000_000) for i in range(round(phase_s * 100), len(self.motion.time), step)]

    def say(self, stamp_ns: int, topic: str, kind: str, message: Any, late_ns: int = 3_000_000) -> None:
        self.rows.append((stamp_ns + late_ns, topic, kind, message))

    def said(self, name: str) -> list[Any]:
        """The messages of a topic, or of a type."""
        return [message for _, topic, kind, message in self.rows if name in (topic, kind)]

    # ------------------------------------------------------------------ sensors

    def dvl_velocities(self, places: list[int], mounting_rpy: tuple[float, ...]) -> Array:
        """What the DVL measures in its forward-left-up axes, (N, 3) m/s."""
        m = self.motion
        at_dvl = m.velocity_body[places] + cross(m.angular_velocity[places], np.array(LEVER_ARM))
        return at_dvl @ true_mounting(mounting_rpy) + self.rng.normal(0.0, DVL_STD, (len(places), 3))

    def dvl_velocity(self, i: int, mounting_rpy: tuple[float, ...]) -> Array:
        return self.dvl_velocities([i], mounting_rpy)[0]

    def dvl(
        self,
        topic: str,
        kind: str,
        frame: str,
        mounting_rpy: tuple[float, ...] = (0.0, 0.0, 0.0),
        rate_hz: float = 5.0,
        frd: bool = False,
    ) -> None:
        """A DVL; the driver types turn to forward-right-down themselves. frd: this one does so in any type."""
        each = self.every(rate_hz)
        velocities = self.dvl_velocities([i for i, _ in each], mounting_rpy)
        if frd:
            velocities = velocities @ FLU_FROM_FRD.T
        for (_, stamp), velocity in zip(each, velocities, strict=True):
            sample = Sample(stamp, velocity, DVL_STD**2 * np.eye(3))
            self.say(stamp, topic, kind, self.make.velocity(kind, sample, frame))

    def reference(
        self,
        topic: str,
        kind: str,
        frame: str,
        axes: str,
        rate_hz: float = 5.0,
        covariance: bool = True,
        std: float = GNSS_STD,
        antenna: tuple[float, ...] = (0.0, 0.0, 0.0),
        claimed: float | None = None,
    ) -> None:
        """The velocity of a point of the body (m), axes: enu, ned or body. claimed: the std it says, if not its own."""
        m = self.motion
        each = self.every(rate_hz, 0.04)
        places = [i for i, _ in each]
        velocities = m.velocity_body[places] + cross(m.angular_velocity[places], np.array(antenna))
        if axes != "body":
            velocities = np.einsum("nij,nj->ni", m.rotation_enu_from_body[places], velocities)
        if axes == "ned":
            velocities = velocities @ ENU_FROM_NED
        velocities = velocities + self.rng.normal(0.0, std, velocities.shape)
        for (_, stamp), velocity in zip(each, velocities, strict=True):
            sample = Sample(stamp, velocity, (claimed or std) ** 2 * np.eye(3) if covariance else None)
            self.say(stamp, topic, kind, self.make.velocity(kind, sample, frame))

    def imu(
        self,
        topic: str,
        frame: str,
        mounting: Array | None = None,
        world: str = "enu",
        rate_hz: float = 20.0,
        orientation: bool = True,
    ) -> None:
        """An IMU. mounting: rotation_body_from_imu of the axes in which it gives its data."""
        m = self.motion
        body_from_imu = np.eye(3) if mounting is None else mounting
        world_from_enu = ENU_FROM_NED.T if world == "ned" else np.eye(3)
        each = self.every(rate_hz)
        places = [i for i, _ in each]
        rotations = world_from_enu @ m.rotation_enu_from_body[places] @ body_from_imu
        quaternions = Rotation.from_matrix(rotations).as_quat()  # one by one takes as long as all else
        rates = m.angular_velocity[places] @ body_from_imu
        gravity = (world_from_enu @ [0.0, 0.0, 9.81]) @ rotations
        for (_, stamp), *measured in zip(each, quaternions.tolist(), rates.tolist(), gravity.tolist(), strict=True):
            message = self.make.imu(Oriented(stamp, *measured[:2]))
            message.header.frame_id = frame
            message.linear_acceleration = self.make.vector(measured[2])
            if not orientation:
                message.orientation_covariance = np.array([-1.0, *[0.0] * 8])
            self.say(stamp, topic, IMU, message)

    def fixes(
        self, topic: str, frame: str, rate_hz: float, std: float, antenna: tuple[float, ...] = (0.0, 0.0, 0.0)
    ) -> None:
        """Positions of satellites. antenna: m, body."""
        east_m = METRES_PER_DEGREE * math.cos(math.radians(LATITUDE))
        places = positions(self.motion) + self.motion.rotation_enu_from_body @ np.array(antenna)
        for i, stamp in self.every(rate_hz, 0.04):
            east, north, up = places[i] + self.rng.normal(0.0, std, 3)
            status = self.types("sensor_msgs/msg/NavSatStatus", 2, 1)
            message = self.types(
                FIX,
                header=self.make.header(stamp, frame),
                status=status,
                latitude=LATITUDE + north / METRES_PER_DEGREE,
                longitude=LONGITUDE + east / east_m,
                altitude=float(up),
                position_covariance=(std**2 * np.eye(3)).ravel(),
                position_covariance_type=2,
            )
            self.say(stamp, topic, FIX, message)

    # ------------------------------------------------------------------ where things are

    def transform(self, parent: str, child: str, rpy: tuple[float, ...], xyz: tuple[float, ...]) -> Any:
        quaternion = Rotation.from_matrix(rotation_from_rpy(rpy)).as_quat()
        inner = self.types(
            "geometry_msgs/msg/Transform",
            self.make.vector(xyz),
            self.types("geometry_msgs/msg/Quaternion", *quaternion.tolist()),
        )
        return self.types("geometry_msgs/msg/TransformStamped", self.make.header(START_NS, parent), child, inner)

    def tf_static(self, *transforms: Any) -> None:
        self.say(START_NS, "/tf_static", TF, self.types(TF, list(transforms)))

    def robot_description(self, text: str) -> None:
        self.say(START_NS, "/robot_description", STRING, self.types(STRING, text))

    def write(self, path: Path) -> Path:
        connections: dict[str, Any] = {}
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for log_ns, topic, kind, message in sorted(self.rows, key=lambda row: row[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.make.store)
                writer.write(connections[topic], log_ns, self.make.store.serialize_cdr(message, kind))
        return path


@dataclass(frozen=True)
class Sample:
    stamp_ns: int
    velocity: Array
    covariance: Array | None


@dataclass(frozen=True)
class Oriented:
    stamp_ns: int
    orientation: Array
    angular_velocity: Array


@cache
def true_mounting(mounting_rpy: tuple[float, ...]) -> Array:
    """rotation_body_from_dvl of the axes forward-left-up, misalignment and all."""
    return rotation_from_rpy(mounting_rpy) @ rotation_from_rpy(MISALIGNMENT)


@dataclass(frozen=True)
class Stack:
    """A vehicle. tell: makes its messages. mounting_rpy: nominal, rad. missing: what the answer must say instead.

    turned: the frame of the DVL's messages is forward-right-down, so that is whose mounting is told.
    """

    tell: Callable[[Told], None]
    mounting_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    missing: str = ""
    version: str = "first"

    def write(self, path: Path) -> Path:
        told = Told(self.version)
        self.tell(told)
        return told.write(path)


YAW_45 = (0.0, 0.0, math.radians(45.0))
YAW_MINUS_90 = (0.0, 0.0, math.radians(-90.0))
URDF_45 = f"""<robot name="auv">
  <link name="base_link"/><link name="dvl_link"/><link name="imu_link"/>
  <joint name="dvl_joint" type="fixed"><parent link="base_link"/><child link="dvl_link"/>
    <origin xyz="{LEVER_ARM[0]} {LEVER_ARM[1]} {LEVER_ARM[2]}" rpy="0 0 {YAW_45[2]}"/></joint>
  <joint name="imu_joint" type="fixed"><parent link="base_link"/><child link="imu_link"/>
    <origin xyz="0.1 0 0" rpy="0 0 0"/></joint>
</robot>
"""


def water_linked_a50(told: Told) -> None:
    """dvl-a50 with a u-blox receiver and an IMU, transforms by static_transform_publisher."""
    told.dvl("/dvl/data", A50, "dvl_a50_link", rate_hz=10.0)
    told.reference("/ublox_gps_node/fix_velocity", TWIST, "gps", "enu")
    told.imu("/imu/data", "imu_link")
    told.tf_static(
        told.transform("base_link", "dvl_a50_link", (0.0, 0.0, 0.0), LEVER_ARM),
        told.transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)),
    )


def water_linked_driver_at_45_degrees(told: Told) -> None:
    """waterlinked_dvl with a URDF, and an INS that gives its velocity in NED."""
    told.dvl("/waterlinked_dvl/dvl", MARINE, "dvl_link", YAW_45, rate_hz=10.0)
    told.reference("/ins/velocity", TWIST, "ned", "ned")
    told.imu("/ins/imu", "base_link")
    told.robot_description(URDF_45)


def bluerov_with_mavros(told: Told) -> None:
    """ArduSub: mavros' satellite velocity without covariance, its filter's odometry beside it, no transform at all."""
    told.dvl("/dvl/velocity", TWIST, "dvl")
    told.reference("/mavros/global_position/raw/gps_vel", TWIST_STAMPED, "map", "enu", covariance=False)
    told.reference("/mavros/local_position/velocity_body", TWIST_STAMPED, "base_link", "body", covariance=False)
    told.imu("/mavros/imu/data", "base_link")
    told.imu("/mavros/imu/data_raw", "base_link", orientation=False)


def marine_instruments(told: Told) -> None:
    """DVL, IMU and reference in the marine way: forward-right-down, north-east-down, frames named after devices."""
    told.dvl("/nav/dvl", TWIST, "dvl_frd", frd=True)
    told.reference("/nav/gnss_vel", TWIST, "gnss", "ned")
    told.imu("/nav/imu", "imu", FLU_FROM_FRD, "ned")


def transform_of_the_drivers_own_axes(told: Told) -> None:
    """dvl_msgs with a transform whose z points down, as the sensor's own axes do."""
    told.dvl("/dvl/data", A50, "dvl", YAW_MINUS_90)
    told.reference("/gnss/twist", TWIST, "map", "enu")
    told.imu("/imu/data", "base_link")
    frd = Rotation.from_matrix(rotation_from_rpy(YAW_MINUS_90) @ FLU_FROM_FRD).as_euler("xyz")
    told.tf_static(told.transform("base_link", "dvl", tuple(frd), LEVER_ARM))


def imu_on_its_side(told: Told) -> None:
    """An IMU that is mounted turned, as its transform says; names in a namespace."""
    side = (math.pi / 2, 0.0, math.pi / 2)
    told.dvl("/auv/dvl/twist", TWIST, "auv/dvl_link")
    told.reference("/auv/gnss/vel", TWIST, "auv/gnss_link", "enu")
    told.imu("/auv/imu/data", "auv/imu_link", rotation_from_rpy(side))
    told.tf_static(
        told.transform("auv/base_link", "auv/dvl_link", (0.0, 0.0, 0.0), LEVER_ARM),
        told.transform("auv/base_link", "auv/imu_link", side, (0.0, 0.0, 0.1)),
        told.transform("auv/base_link", "auv/gnss_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )


def ins_odometry_in_the_body(told: Told) -> None:
    """nav_msgs/Odometry as REP-103 wants it, of an INS without the DVL; the DVL at 45 degrees and nothing says so."""
    told.dvl("/dvl", TWIST, "dvl_link", YAW_45)
    told.reference("/ins/odometry", ODOMETRY, "base_link", "body")
    told.imu("/ins/imu", "base_link")


def odometry_in_the_world(told: Told) -> None:
    """nav_msgs/Odometry whose twist is in ENU though child_frame_id says base_link, as some INS drivers send it."""
    told.dvl("/dvl/twist", TWIST, "dvl_link")
    told.reference("/sbg/odometry", ODOMETRY, "base_link", "enu")
    told.imu("/sbg/imu", "base_link")
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))


def simulator_with_truth(told: Told) -> None:
    """A simulator: the DVL, a filter's output beside it, and the truth as odometry."""
    told.dvl("/sim/dvl", TWIST, "sim/dvl_link", YAW_45)
    told.reference("/odometry/filtered", ODOMETRY, "base_link", "body")
    told.reference("/sim/ground_truth", ODOMETRY, "base_link", "body", rate_hz=20.0, std=0.001)
    told.reference("/cmd_vel", TWIST_STAMPED, "base_link", "body", std=0.3, covariance=False)
    told.imu("/sim/imu", "base_link")
    told.tf_static(told.transform("base_link", "sim/dvl_link", YAW_45, LEVER_ARM))


def rtk_positions_only(told: Told) -> None:
    """Satellite positions at 5 Hz and nothing else of a reference."""
    told.dvl("/dvl/twist", TWIST, "dvl_link")
    told.fixes("/rtk/fix", "gnss_link", 5.0, 0.014)
    told.imu("/imu/data", "base_link")
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))


def course_and_speed(told: Told) -> None:
    """nmea_navsat_driver: course and speed as a TwistStamped, east and north, frame of the receiver."""
    told.dvl("/dvl/twist", TWIST, "dvl_link")
    told.reference("/vel", TWIST_STAMPED, "gps", "enu", rate_hz=1.0, covariance=False)
    for message in told.said(TWIST_STAMPED):
        message.twist.linear.z = 0.0
    told.imu("/imu/data", "base_link")
    told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))


def no_attitude(told: Told) -> None:
    """Satellite velocity in ENU, and an IMU that gives rates alone."""
    told.dvl("/dvl/twist", TWIST, "dvl_link")
    told.reference("/gps/vel", TWIST, "enu", "enu")
    told.imu("/imu/data_raw", "base_link", orientation=False)


def no_reference(told: Told) -> None:
    """A dive: DVL and IMU, the DVL at 45 degrees."""
    told.dvl("/dvl/data", A50, "dvl_link", YAW_45)
    told.imu("/imu/data", "base_link")


def no_dvl(told: Told) -> None:
    """The recording forgot the DVL."""
    told.reference("/gps/vel", TWIST, "enu", "enu")
    told.imu("/imu/data", "base_link")


STACKS = {
    "water_linked_a50": Stack(water_linked_a50),
    "water_linked_driver_at_45_degrees": Stack(water_linked_driver_at_45_degrees, YAW_45),
    "bluerov_with_mavros": Stack(bluerov_with_mavros),
    "marine_instruments": Stack(marine_instruments),
    "transform_of_the_drivers_own_axes": Stack(transform_of_the_drivers_own_axes, YAW_MINUS_90),
    "imu_on_its_side": Stack(imu_on_its_side),
    "ins_odometry_in_the_body": Stack(ins_odometry_in_the_body, YAW_45),
    "odometry_in_the_world": Stack(odometry_in_the_world),
    "simulator_with_truth": Stack(simulator_with_truth, YAW_45),
    "rtk_positions_only": Stack(rtk_positions_only),
    "course_and_speed": Stack(course_and_speed),
    "no_attitude": Stack(no_attitude, missing="attitude"),
    "no_reference": Stack(no_reference, YAW_45),
    "no_dvl": Stack(no_dvl, missing="no topic looks like a DVL's"),
}
