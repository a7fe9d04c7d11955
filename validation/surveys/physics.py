"""A survey drawn at random, by physics of its own: nothing here is shared with the simulator of the package.

A vehicle drives a manoeuvre in waves; DVL, reference and IMU measure it at their own places, by their own clocks, in
their own frames and messages. What was drawn is kept beside the bag, by name, so that misses can be sorted by it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

RATE_HZ, EPOCH_S = 50.0, 1_771_000_000
# m/s: the rms of the DVL's constant error that the beam biases of the published data make along an axis.
DVL_BIAS_STD = 0.008
# Degrees: up to here a heading is wrong by a constant that nobody has set, in three of ten surveys.
DECLINATION = 4.0
FLIP = Rotation.from_euler("x", np.pi)
NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
A50 = "dvl_msgs/msg/DVL"
A50_TEXT = (
    "std_msgs/Header header\nfloat64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\nfloat64 altitude\n"
    "dvl_msgs/DVLBeam[] beams\nbool velocity_valid\nint64 status\nstring form\n"
)
BEAM_TEXT = "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid\n"
TWIST, STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"
ODOMETRY, IMU, FIX, TF = (
    "nav_msgs/msg/Odometry",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/NavSatFix",
    "tf2_msgs/msg/TFMessage",
)
Vector = np.ndarray


@dataclass(frozen=True)
class Drawn:
    """What a survey is. Angles in degrees, lengths in m, times in s, bias in m/s along the DVL's axes."""

    seed: int
    manoeuvre: str
    seconds: float
    speed: float
    waves: bool
    mounting_yaw: float
    off_rpy: tuple[float, float, float]
    scale: float
    transform: bool
    arm: tuple[float, float, float]
    antenna: tuple[float, float, float]
    dvl_late: float
    reference_late: float
    compass: float
    lasting: bool
    outliers: float
    dvl_type: str
    reference: str
    reference_std: float
    dvl_bias: tuple[float, float, float]
    declination: float


def draw(seed: int, dvl_bias_std: float = 0.0, declination: float = 0.0) -> Drawn:
    """The survey of this seed, its DVL's bias being of this σ, m/s, and its heading wrong by up to so many degrees."""
    rng = np.random.default_rng(seed)

    def sometimes(share: float, value: Callable[[], float]) -> float:
        return float(value()) if rng.random() < share else 0.0

    def three(*bounds: float) -> tuple[float, float, float]:
        x, y, z = (float(rng.uniform(-each, each)) for each in bounds)
        return x, y, z

    def normal_three(std: float) -> tuple[float, float, float]:
        x, y, z = (float(each) for each in rng.normal(0.0, std, 3))
        return x, y, z

    return Drawn(
        seed,
        str(
            rng.choice(
                ["lawnmower", "box", "wander", "reciprocal", "circle", "stop and go"], p=[0.3, 0.2, 0.2, 0.1, 0.1, 0.1]
            )
        ),
        float(rng.uniform(240.0, 600.0)),
        float(rng.uniform(0.5, 1.8)),
        bool(rng.random() < 0.7),
        float(rng.choice([0.0, 45.0, 90.0, 180.0, 30.0], p=[0.45, 0.25, 0.1, 0.1, 0.1])),
        three(1.5, 2.0, 3.0),
        float(rng.normal(0.0, 0.006)),
        bool(rng.random() < 0.5),
        three(1.0, 0.3, 0.4),
        three(0.6, 0.2, 0.5) if rng.random() < 0.5 else (0.0, 0.0, 0.0),
        sometimes(0.25, lambda: rng.uniform(0.05, 0.8)),
        sometimes(0.25, lambda: rng.uniform(0.05, 1.5)),
        sometimes(0.2, lambda: rng.uniform(0.3, 2.0)),
        bool(rng.random() < 0.3),
        sometimes(0.2, lambda: rng.uniform(0.005, 0.04)),
        str(rng.choice([TWIST, STAMPED, A50])),
        str(rng.choice(["enu", "ned", "body", "fix", "enu without covariance"], p=[0.3, 0.15, 0.2, 0.15, 0.2])),
        float(rng.choice([0.02, 0.05, 0.1])),
        normal_three(dvl_bias_std),
        sometimes(0.3, lambda: rng.uniform(-declination, declination)),
    )


@dataclass
class Motion:
    """time (N,); attitude in ENU; velocity in the body and turn rate (N, 3); position east, north, up (N, 3)."""

    time: Vector
    attitude: Rotation
    body: Vector
    rates: Vector
    position: Vector

    def at(self, time: Vector) -> tuple[Rotation, Vector, Vector, Vector]:
        """Attitude, velocity, rate, position at other times."""
        time = np.clip(time, self.time[0], self.time[-1])
        each = (
            np.stack([np.interp(time, self.time, a[:, k]) for k in range(3)], 1)
            for a in (self.body, self.rates, self.position)
        )
        body, rates, position = each
        return Slerp(self.time, self.attitude)(time), body, rates, position


def turn_rates(drawn: Drawn, time: Vector, rng: np.random.Generator) -> Vector:
    """Rate of the heading, rad/s."""
    fast = np.deg2rad(rng.uniform(5.0, 12.0))
    if drawn.manoeuvre == "circle":
        return np.full(len(time), fast * 0.6)
    leg = {"reciprocal": 60.0, "stop and go": 40.0}.get(drawn.manoeuvre, float(rng.uniform(20.0, 45.0)))
    rate, at, k = np.zeros(len(time)), 15.0, 0
    while at < time[-1] - 10.0:
        sign = {"box": 1, "wander": int(rng.choice([-1, 1]))}.get(drawn.manoeuvre, 1 if k % 4 < 2 else -1)
        angle = {"box": 90.0, "wander": rng.uniform(30.0, 150.0), "reciprocal": 180.0}.get(drawn.manoeuvre, 90.0)
        seconds = np.deg2rad(angle) / fast
        rate[(time >= at) & (time < at + seconds)] = sign * fast
        short = drawn.manoeuvre == "lawnmower" and k % 2 == 0
        at, k = at + seconds + (8.0 if short else leg), k + 1
    return gaussian_filter1d(rate, 0.8 * RATE_HZ)


def motion_of(drawn: Drawn, rng: np.random.Generator) -> Motion:
    """What the vehicle does."""
    time = np.arange(0.0, drawn.seconds, 1.0 / RATE_HZ)
    rate = turn_rates(drawn, time, rng)
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(rate) / RATE_HZ
    ahead = drawn.speed * (1.0 + 0.2 * np.sin(2 * np.pi * time / rng.uniform(60.0, 130.0) + rng.uniform(0, 6)))
    if drawn.manoeuvre == "stop and go":
        ahead = ahead * gaussian_filter1d((time % 50.0 < 38.0).astype(float), 2.0 * RATE_HZ)
    ahead = ahead * np.clip(time / 8.0, 0.0, 1.0)
    sea = 1.0 if drawn.waves else 0.1
    swell = [2 * np.pi * time / rng.uniform(4.0, 8.0) + rng.uniform(0, 6) for _ in range(3)]
    roll = np.deg2rad(2.5) * sea * np.sin(swell[0]) + 0.4 * rate
    pitch = np.deg2rad(1.5) * sea * np.sin(swell[1]) + np.deg2rad(rng.uniform(-2.0, 2.0))
    sway = -rng.uniform(0.1, 0.4) * ahead * rate + 0.03 * sea * np.sin(swell[2])
    attitude = Rotation.from_euler("ZYX", np.c_[yaw, pitch, roll])
    body = np.c_[ahead, sway, np.zeros_like(ahead)]
    up = 0.05 * sea * np.sin(swell[1] + 1.0)  # it keeps its depth but for the waves
    body[:, 2] = (up - attitude.apply(body)[:, 2]) / attitude.as_matrix()[:, 2, 2]
    rates = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE_HZ
    position = np.cumsum(attitude.apply(body), axis=0) / RATE_HZ
    return Motion(time, attitude, body, np.vstack([rates, rates[-1]]), position)


def noise_of(rng: np.random.Generator, n: int, std: float, interval_s: float, lasting: bool) -> Vector:
    """Noise (n, 3); lasting: correlated over ten seconds."""
    white = rng.normal(0.0, std, (n, 3))
    if not lasting:
        return white
    keep = np.exp(-interval_s / 10.0)
    slow = np.zeros((n, 3))
    for k in range(1, n):
        slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(0.0, std, 3)
    return 0.7 * white + 0.7 * slow


class Bag:
    """Messages of a bag."""

    def __init__(self) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self.store.register(get_types_from_msg(BEAM_TEXT, "dvl_msgs/msg/DVLBeam"))
        self.store.register(get_types_from_msg(A50_TEXT, A50))
        self.rows: list[tuple[int, str, str, Any]] = []

    def new(self, kind: str, *values: Any, **fields: Any) -> Any:
        """A message, or part of one."""
        return self.store.types[kind](*values, **fields)

    def header(self, at_s: float, frame: str) -> Any:
        """Stamped at_s after the start."""
        ns = round(at_s * 1e9)
        stamp = self.new("builtin_interfaces/msg/Time", EPOCH_S + ns // 10**9, ns % 10**9)
        return self.new("std_msgs/msg/Header", stamp, frame)

    def vector(self, values: Vector) -> Any:
        """Three numbers."""
        return self.new("geometry_msgs/msg/Vector3", *map(float, values))

    def quaternion(self, rotation: Rotation) -> Any:
        """Of a rotation."""
        return self.new("geometry_msgs/msg/Quaternion", *rotation.as_quat().tolist())

    def add(self, log_s: float, topic: str, kind: str, message: Any) -> None:
        """Recorded at log_s after the start."""
        self.rows.append((EPOCH_S * 10**9 + round(log_s * 1e9), topic, kind, message))

    def velocity(self, kind: str, at_s: float, frame: str, velocity: Vector, std: float) -> Any:
        """Of any of the types."""
        header = self.header(at_s, "odom" if kind == ODOMETRY else frame)
        if kind == A50:
            return self.new(kind, header, 0.0, self.vector(velocity), float(std), 6.0, [], True, 0, "json_v3")
        twist = self.new("geometry_msgs/msg/Twist", self.vector(velocity), self.vector(np.zeros(3)))
        if kind == STAMPED:
            return self.new(kind, header, twist)
        whole = np.zeros((6, 6))
        whole[:3, :3] = std**2 * np.eye(3)
        inner = self.new("geometry_msgs/msg/TwistWithCovariance", twist, whole.ravel())
        if kind == TWIST:
            return self.new(kind, header, inner)
        point = self.new("geometry_msgs/msg/Point", 0.0, 0.0, 0.0)
        pose = self.new("geometry_msgs/msg/Pose", point, self.quaternion(Rotation.identity()))
        return self.new(
            kind, header, frame, self.new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)), inner
        )

    def write(self, path: Path) -> None:
        """To a new folder."""
        connections: dict[str, Any] = {}
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for log_ns, topic, kind, message in sorted(self.rows, key=lambda row: row[0]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], log_ns, self.store.serialize_cdr(message, kind))


def write_survey(drawn: Drawn, path: Path) -> dict[str, Any]:
    """Write the bag of a survey; returns its truth: rpy, its angle from what was meant, what was drawn."""
    rng = np.random.default_rng([drawn.seed, 1])
    motion, bag = motion_of(drawn, rng), Bag()
    nominal = Rotation.from_euler("z", drawn.mounting_yaw, degrees=True)
    off = Rotation.from_euler("xyz", drawn.off_rpy, degrees=True)
    mounted = nominal * off
    _write_dvl(drawn, motion, mounted, bag, rng)
    _write_reference(drawn, motion, bag, rng)
    _write_imu(drawn, motion, bag, rng)
    if drawn.transform:
        frames = [("dvl_link", drawn.arm, nominal), ("gnss_link", drawn.antenna, Rotation.identity())]
        transforms = [
            bag.new("geometry_msgs/msg/TransformStamped", bag.header(0.0, "base_link"), name,
                    bag.new("geometry_msgs/msg/Transform", bag.vector(np.array(at)), bag.quaternion(turn)))
            for name, at, turn in frames
        ]  # fmt: skip
        bag.add(0.0, "/tf_static", TF, bag.new(TF, transforms))
    bag.write(path)
    # a constant of the heading cannot be told from the yaw of a DVL that is found against it
    turned = 0.0 if drawn.reference == "body" else -drawn.declination
    mounted = Rotation.from_euler("z", turned, degrees=True) * mounted
    misalignment = float(np.degrees((nominal.inv() * mounted).magnitude()))
    return {"rpy_deg": mounted.as_euler("xyz", degrees=True).tolist(), "misalignment_deg": misalignment,
            "drawn": asdict(drawn)}  # fmt: skip


def _write_dvl(drawn: Drawn, motion: Motion, mounted: Rotation, bag: Bag, rng: np.random.Generator) -> None:
    times = np.arange(1.0, drawn.seconds - 2.0, 0.2)
    _, body, rates, _ = motion.at(times)
    measured = mounted.inv().apply(body + np.cross(rates, drawn.arm)) * (1.0 + drawn.scale)
    measured += rng.normal(0.0, 0.01, measured.shape) + drawn.dvl_bias
    wild = rng.random(len(times)) < drawn.outliers
    measured[wild] += rng.normal(0.0, 1.0, (int(wild.sum()), 3))
    if drawn.dvl_type == A50:
        measured = FLIP.apply(measured)
    for at, velocity in zip(times.tolist(), measured, strict=True):
        late = at + drawn.dvl_late
        bag.add(
            late + 0.02, "/dvl/velocity", drawn.dvl_type, bag.velocity(drawn.dvl_type, late, "dvl_link", velocity, 0.01)
        )


def _write_reference(drawn: Drawn, motion: Motion, bag: Bag, rng: np.random.Generator) -> None:
    times = np.arange(0.5, drawn.seconds - 2.0, 0.2)
    attitude, body, rates, position = motion.at(times)
    std = drawn.reference_std
    frame = "gnss_link" if drawn.transform else "map"
    if drawn.reference == "fix":
        at = position + attitude.apply(drawn.antenna) + noise_of(rng, len(times), 0.2 * std, 0.2, drawn.lasting)
        for time, (east, north, up) in zip(times.tolist(), at.tolist(), strict=True):
            stamped = time + drawn.reference_late
            status = bag.new("sensor_msgs/msg/NavSatStatus", 2, 1)
            covariance = ((0.2 * std) ** 2 * np.eye(3)).ravel()
            latitude, longitude = (
                52.0 + north / 111_267.0,
                13.0 + east / (111_320.0 * np.cos(np.deg2rad(52.0)) * 1.0021),
            )
            message = bag.new(FIX, bag.header(stamped, frame), status, latitude, longitude, up, covariance, 2)
            bag.add(stamped + 0.05, "/gnss/fix", FIX, message)
        return
    velocity = body + np.cross(rates, drawn.antenna)
    if drawn.reference != "body":
        velocity = attitude.apply(velocity)
    velocity = velocity + noise_of(rng, len(times), std, 0.2, drawn.lasting)
    if drawn.reference == "ned":
        velocity, frame = NED.inv().apply(velocity), "ned"
    kind = {"body": ODOMETRY, "enu without covariance": STAMPED}.get(drawn.reference, TWIST)
    if drawn.reference == "body":
        frame = "gnss_link_flu"
    if drawn.reference in ("enu", "enu without covariance") and not drawn.transform:
        frame = "map"
    for time, each in zip(times.tolist(), velocity, strict=True):
        stamped = time + drawn.reference_late
        bag.add(stamped + 0.05, "/ins/velocity", kind, bag.velocity(kind, stamped, frame, each, std))


def _write_imu(drawn: Drawn, motion: Motion, bag: Bag, rng: np.random.Generator) -> None:
    times = np.arange(0.2, drawn.seconds - 1.0, 0.05)
    attitude, _, rates, _ = motion.at(times)
    yaw = attitude.as_euler("ZYX")[:, 0]
    off = np.deg2rad(drawn.declination) + np.deg2rad(drawn.compass) * np.sin(yaw + rng.uniform(0.0, 2.0 * np.pi))
    seen = Rotation.from_rotvec(np.c_[np.zeros((len(off), 2)), off]) * attitude
    seen = seen * Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, 0.05, (len(off), 3))))
    gravity = attitude.inv().apply(np.tile([0.0, 0.0, 9.81], (len(off), 1)))
    rates = rates + rng.normal(0.0, 0.002, rates.shape)
    covariances = [(variance * np.eye(3)).ravel() for variance in (1e-6, 4e-6, 1e-3)]
    turned = seen.as_quat().tolist()  # one by one takes as long as all else
    for time, quaternion, rate, pull in zip(times.tolist(), turned, rates, gravity, strict=True):
        orientation = bag.new("geometry_msgs/msg/Quaternion", *quaternion)
        message = bag.new(
            IMU, bag.header(time, "base_link"), orientation, covariances[0], bag.vector(rate),
            covariances[1], bag.vector(pull), covariances[2],
        )  # fmt: skip
        bag.add(time + 0.005, "/imu/data", IMU, message)
