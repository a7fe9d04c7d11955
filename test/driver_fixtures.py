"""Recordings as the drivers of real DVLs make them, written from the drivers' message definitions."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from io_fixtures import Sample, storage_file
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dvl_calib_ros.calibration.numerics.samples import DvlSample, ReferenceSample, VelocityFrame

TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
MARINE = "marine_acoustic_msgs/msg/Dvl"
A50 = "dvl_msgs/msg/DVL"
IMU = "sensor_msgs/msg/Imu"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
TYPES = (TWIST, TWIST_STAMPED, VECTOR, ODOMETRY, MARINE, A50)

# marine_acoustic_msgs 2.1.0
MARINE_DEFINITION = """
uint8 DVL_MODE_BOTTOM=1
uint8 DVL_MODE_WATER=2
uint8 DVL_TYPE_PISTON=0
uint8 DVL_TYPE_PHASED_ARRAY=1
std_msgs/Header header
uint8 velocity_mode
uint8 dvl_type
geometry_msgs/Vector3 velocity
float64[9] velocity_covar
float64 altitude
float64 course_gnd
float64 speed_gnd
uint8 num_good_beams
float32 sound_speed
bool beam_ranges_valid
bool beam_velocities_valid
geometry_msgs/Vector3[4] beam_unit_vec
float64[4] range
float32[4] range_covar
float32[4] beam_quality
float32[4] beam_velocity
float32[4] beam_velocity_covar
"""
BEAM_DEFINITION = "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid\n"
_HEAD = "std_msgs/Header header\nfloat64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\n"
_TIMES = "int64 time_of_validity\nint64 time_of_transmission\n"
# the versions of dvl_msgs that drivers are built with
A50_DEFINITIONS = {
    "first": f"{_HEAD}float64 altitude\nDVLBeam[] beams\nbool velocity_valid\nint64 status\nstring form\n",
    "covariance": f"{_HEAD}float64[] covariance\nfloat64 altitude\nDVLBeam[] beams\nbool velocity_valid\nint64 status\n"
    f"{_TIMES}string form\n",
    "fixed sizes": f"{_HEAD}float64[9] covariance\nfloat64 altitude\nDVLBeam[4] beams\nbool velocity_valid\n"
    f"int64 status\n{_TIMES}string form\n",
}
FLIP = np.array([1.0, -1.0, -1.0])
Change = Callable[[Any], None]


class Maker:
    """Makes messages of all types, valid ones, as their drivers fill them. version: of dvl_msgs."""

    def __init__(self, version: str = "first") -> None:
        self.version = version
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.store.register(get_types_from_msg(MARINE_DEFINITION, MARINE))
        self.store.register(get_types_from_msg(BEAM_DEFINITION, "dvl_msgs/msg/DVLBeam"))
        self.store.register(get_types_from_msg(A50_DEFINITIONS[version], A50))

    def _new(self, name: str, *values: Any, **fields: Any) -> Any:
        return self.store.types[name](*values, **fields)

    def vector(self, velocity: Iterable[float] = (0.0, 0.0, 0.0)) -> Any:
        return self._new("geometry_msgs/msg/Vector3", *map(float, velocity))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self._new("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self._new("std_msgs/msg/Header", time, frame_id)

    def velocity(self, kind: str, sample: DvlSample | ReferenceSample, frame_id: str = "dvl_link") -> Any:
        """A message with the velocity and covariance of a sample (forward-left-up)."""
        header = self.header(sample.stamp_ns, frame_id)
        covariance = np.zeros((3, 3)) if sample.covariance is None else sample.covariance
        if kind == MARINE:
            return self._marine(header, sample.velocity * FLIP, covariance * np.outer(FLIP, FLIP))
        if kind == A50:
            return self._a50(header, sample.velocity * FLIP, covariance * np.outer(FLIP, FLIP))
        if kind == VECTOR:
            return self._new(kind, header, self.vector(sample.velocity))
        twist = self._new("geometry_msgs/msg/Twist", self.vector(sample.velocity), self.vector())
        if kind == TWIST_STAMPED:
            return self._new(kind, header, twist)
        whole = np.zeros((6, 6))
        whole[:3, :3] = covariance
        inner = self._new("geometry_msgs/msg/TwistWithCovariance", twist, whole.ravel())
        if kind == TWIST:
            return self._new(kind, header, inner)
        pose = self._new(
            "geometry_msgs/msg/Pose",
            self._new("geometry_msgs/msg/Point", 0.0, 0.0, 0.0),
            self._new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        )
        header.frame_id = "odom"
        return self._new(
            kind, header, frame_id, self._new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)), inner
        )

    def _marine(self, header: Any, velocity: np.ndarray, covariance: np.ndarray) -> Any:
        four = np.full(4, 10.8)
        return self._new(
            MARINE,
            header=header,
            velocity_mode=1,
            dvl_type=0,
            velocity=self.vector(velocity),
            velocity_covar=covariance.ravel(),
            altitude=10.0,
            course_gnd=float(np.arctan2(velocity[1], velocity[0])),
            speed_gnd=float(np.hypot(*velocity[:2])),
            num_good_beams=4,
            sound_speed=1500.0,
            beam_ranges_valid=True,
            beam_velocities_valid=True,
            beam_unit_vec=[self.vector() for _ in range(4)],
            range=four,
            **{
                name: four.astype(np.float32)
                for name in ("range_covar", "beam_quality", "beam_velocity", "beam_velocity_covar")
            },
        )

    def _a50(self, header: Any, velocity: np.ndarray, covariance: np.ndarray) -> Any:
        beams = [self._new("dvl_msgs/msg/DVLBeam", i, 0.1, 10.8, -30.0, -90.0, True) for i in range(4)]
        fields = {
            "header": header,
            "time": 106.4,
            "velocity": self.vector(velocity),
            "fom": float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])),
            "altitude": 10.0,
            "beams": beams,
            "velocity_valid": True,
            "status": 0,
            "form": "json_v3.1",
        }
        if self.version != "first":
            fields |= {"covariance": covariance.ravel(), "time_of_validity": 1, "time_of_transmission": 2}
        return self._new(A50, **fields)

    def imu(self, sample: Any) -> Any:
        return self._new(
            IMU,
            header=self.header(sample.stamp_ns, "base_link"),
            orientation=self._new("geometry_msgs/msg/Quaternion", *sample.orientation),
            orientation_covariance=np.zeros(9),
            angular_velocity=self.vector(sample.angular_velocity),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(),
            linear_acceleration_covariance=np.zeros(9),
        )


def write_driver_bag(
    path: Path,
    samples: Iterable[Sample],
    dvl_type: str,
    reference_type: str = TWIST,
    *,
    maker: Maker | None = None,
    dvl_topic: str = "dvl/twist",
    dvl_frame: str = "dvl_link",
    changes: Mapping[int, Change] | None = None,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """A bag with DVL and reference in these types. changes: done to the DVL messages of these numbers."""
    maker = maker or Maker()
    frames = {VelocityFrame.ENU: "map", VelocityFrame.NED: "ned", VelocityFrame.BODY: "base_link"}
    connections: dict[str, Any] = {}
    n_dvl = 0
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for sample in samples:
            if isinstance(sample, DvlSample):
                topic, kind, message = dvl_topic, dvl_type, maker.velocity(dvl_type, sample, dvl_frame)
                (changes or {}).get(n_dvl, lambda _: None)(message)
                n_dvl += 1
            elif isinstance(sample, ReferenceSample):
                message = maker.velocity(reference_type, sample, frames[sample.frame])
                topic, kind = "gnss/twist", reference_type
            else:
                topic, kind, message = "imu/data", IMU, maker.imu(sample)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=maker.store)
            writer.write(connections[topic], sample.stamp_ns, maker.store.serialize_cdr(message, kind))
    return path


def forget_definitions(bag: Path) -> Path:
    """Make an SQLite bag one of before ROS 2 Iron, which embeds no message definitions."""
    with closing(sqlite3.connect(storage_file(bag))) as connection, connection:
        connection.execute("DROP TABLE message_definitions")
        connection.execute("UPDATE schema SET schema_version = 3")
    return bag


def as_plain(message: Any) -> Any:
    """A message with nothing but its fields, as duck-typed as can be."""
    if hasattr(message, "__dataclass_fields__"):
        names = [name for name in message.__dataclass_fields__ if not name.startswith("__")]
        return SimpleNamespace(**{name: as_plain(getattr(message, name)) for name in names})
    if isinstance(message, list):
        return [as_plain(each) for each in message]
    return message
