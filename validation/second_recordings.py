"""Recordings of four vehicles by rigid-body dynamics, with effects in the clean signals and noise on the instruments.

Nothing here was taken from the diagnosis or from the package's simulation: docs/reference.md has the effects with their
signs and units. Body axes are forward-left-up, the earth's east-north-up, pitch positive bow down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

Array = np.ndarray
Effects = Mapping[str, Mapping[str, float]]
STEP_S = 0.02
# Motion before the first and after the last stamp, for streams that are late or early by seconds
MARGIN_S = 15.0
GRAVITY_MPS2 = 9.81
START_S = 1_800_000_000
# Four beams of a Janus DVL, 30 degrees from the vertical
BEAMS = np.array([[0.5, 0, -0.866], [-0.5, 0, -0.866], [0, 0.5, -0.866], [0, -0.5, -0.866]])
TYPES = get_typestore(Stores.ROS2_JAZZY)
TWIST, IMU = "geometry_msgs/msg/TwistWithCovarianceStamped", "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class Hull:
    """Vehicle with masses (added mass included) in kg and kg m², drag in N per m/s and per (m/s)², and its waves.

    The torpedo has the coefficients of a REMUS 100 (Prestero, 2001), the hovering vehicle has published ones of a
    BlueROV2, the boat is a catamaran of 85 kg. `wave` is the share of the surface's motion that reaches it.
    """

    missions: tuple[str, ...]
    mass: tuple[float, float, float]
    inertia: float
    linear: tuple[float, float, float]
    quadratic: tuple[float, float, float]
    yaw_drag: tuple[float, float]
    rudder: float  # N m per rad and (m/s)²; 0: thrusters turn it
    munk: float
    righting: float  # N m
    wave: tuple[float, float]


HULLS = {
    "torpedo": Hull(("lawn mower", "yo-yo", "spiral"), (31.4, 66.0, 66.0), 8.33, (0.0, 15.0, 15.0),
                    (3.9, 131.0, 131.0), (2.0, 94.0), 6.15, 24.0, 5.9, (0.05, 0.25)),
    "glider": Hull(("yo-yo", "spiral"), (60.0, 110.0, 110.0), 25.0, (1.0, 40.0, 60.0),
                   (7.0, 150.0, 300.0), (12.0, 110.0), 14.0, 20.0, 14.0, (0.0, 0.05)),
    "hovering": Hull(("inspection", "station keeping"), (17.0, 24.0, 26.0), 0.4, (13.7, 10.0, 33.0),
                     (141.0, 217.0, 190.0), (0.3, 1.6), 0.0, 0.0, 6.0, (0.1, 0.4)),
    "boat": Hull(("lawn mower", "zigzag"), (90.0, 150.0, 200.0), 42.0, (20.0, 120.0, 200.0),
                 (25.0, 150.0, 300.0), (60.0, 40.0), 0.0, 0.0, 300.0, (0.5, 1.0)),
}  # fmt: skip


@dataclass(frozen=True)
class Noise:
    """Noise of the instruments: standard deviations in m/s or rad, memories in s, and ratios that are claimed."""

    kind: str
    dvl: float
    reference: float
    vertical: tuple[float, float]  # of DVL and reference, relative to the horizontal
    slow_dvl: float = 0.0
    slow_reference: float = 0.0
    slow_heading: float = 0.0
    memory_s: float = 30.0
    tails: tuple[bool, bool] = (False, False)
    gaps: tuple[int, int] = (0, 0)
    claims: tuple[float, float] = (1.0, 1.0)


@dataclass(frozen=True)
class Case:
    """Vehicle, mission, instruments, noise and effects of one recording."""

    seed: tuple[int, ...]
    hull: str
    mission: str
    seconds: float
    rates_hz: tuple[float, float, float]  # of DVL, reference, IMU
    mounting_rpy: tuple[float, float, float]  # configured, rad
    arm_m: tuple[float, float, float]  # configured
    misalignment_rad: tuple[float, float, float]
    scale: float
    noise: Noise
    effects: Effects = field(default_factory=dict)

    @property
    def calibration(self) -> Array:
        """Return the matrix from body velocity to DVL velocity."""
        turned = Rotation.from_rotvec(np.negative(self.misalignment_rad)).inv().as_matrix()
        mounted = Rotation.from_euler("xyz", self.mounting_rpy).as_matrix().T
        matrix: Array = (1.0 + self.scale) * turned @ mounted
        return matrix


def _plan(rng: np.random.Generator, mission: str, seconds: float) -> Array:
    """Draw the commanded surge, sway, heave (m/s), turn rate (rad/s) and pitch (rad) at each step (n, 5)."""
    rows: list[Array] = []
    side, leg, wanted = int(rng.choice([-1, 1])), 0, round((seconds + 2 * MARGIN_S) / STEP_S)
    speeds = (rng.uniform(0.7, 1.2), rng.uniform(1.4, 2.0))

    def go(duration: float, *command: float) -> None:
        rows.append(np.tile(command, (max(round(duration / STEP_S), 1), 1)))

    while sum(map(len, rows)) < wanted:
        speed, rate = speeds[leg % 2] * rng.uniform(0.95, 1.05), np.radians(rng.uniform(4.0, 9.0))
        if mission == "lawn mower":
            go(rng.uniform(25, 60), speed, 0, 0, 0, 0)
            for rest in (rng.uniform(8, 15), 0.0):
                go(np.pi / 2 / rate, speed, 0, 0, side * rate, 0)
                go(rest, speed, 0, 0, 0, 0)
            side = -side
        elif mission == "yo-yo":
            steep = np.radians(rng.uniform(12, 25))
            for pitch in (steep, -steep):
                go(rng.uniform(18, 40), speed, 0, 0, 0, pitch)
            go(rng.uniform(0.8, 2.2) / rate, speed, 0, 0, rng.choice([-1, 1]) * rate, 0)
        elif mission == "spiral":
            steep = np.radians(rng.uniform(4, 12))
            go(rng.uniform(40, 90), speed, 0, 0, side * rate, steep * (-1) ** leg)
            go(rng.uniform(10, 30), speeds[int(rng.integers(2))], 0, 0, 0, 0)
            side = -side
        elif mission == "zigzag":
            go(rng.uniform(15, 40), speed * rng.uniform(0.8, 1.3), 0, 0, 0, 0)
            go(rng.uniform(0.7, 2.6) / (2 * rate), speed, 0, 0, rng.choice([-1, 1]) * 2 * rate, 0)
        elif mission == "inspection":
            turn = rng.choice([0.0, -1.0, 1.0]) * rng.uniform(1, 2.5) * rate
            go(rng.uniform(8, 20), rng.uniform(-0.2, 0.8), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), turn, 0)
        else:
            go(rng.uniform(15, 40), 0, 0, 0, 0, 0)
            go(rng.uniform(0.5, 1.6) / rate, 0, 0, 0, rng.choice([-1, 1]) * rate, 0)
            go(rng.uniform(5, 12), rng.uniform(0.3, 0.6), rng.uniform(-0.2, 0.2), 0, 0, 0)
        leg += 1
    return np.vstack(rows)[:wanted]


def _drive(hull: Hull, plan: Array, current: Array) -> tuple[Array, Array, Array]:
    """Integrate the vehicle: velocity through the water, roll, pitch and yaw (n, 3), and thrust in N (n)."""
    u = v = w = p = q = r = roll = pitch = force = side = lift = fin = plane = 0.0
    course = np.cumsum(plan[:, 3]) * STEP_S
    yaw, (mu, mv, mw), fins = float(course[0]), hull.mass, hull.rudder > 0
    velocity, angles, thrust = np.empty((len(plan), 3)), np.empty((len(plan), 3)), np.empty(len(plan))
    (a1, a2, a3), (b1, b2, b3), dt = hull.linear, hull.quadratic, STEP_S
    for k, (uc, vc, wc, _, pc) in enumerate(plan.tolist()):
        if not fins:  # hold the commanded velocity over ground
            east, north = current.tolist()
            uc -= np.cos(yaw) * east + np.sin(yaw) * north
            vc -= -np.sin(yaw) * east + np.cos(yaw) * north
        error = course[k] - yaw
        # thrusters follow in 0.3 s, fins in 0.2 s
        force += dt / 0.3 * (min(max(a1 * uc + b1 * uc * abs(uc) + 1.5 * mu * (uc - u), -9.0 * mu), 9.0 * mu) - force)
        turn = min(max(2.0 * error - 1.5 * r, -0.35), 0.35)
        fin += dt / 0.2 * (turn - fin)
        plane += dt / 0.2 * (min(max(2.5 * (pc - pitch) - 1.2 * q, -0.35), 0.35) - plane)
        if not fins:
            side += dt / 0.3 * (min(max(a2 * vc + b2 * vc * abs(vc) + 1.5 * mv * (vc - v), -4.0 * mv), 4.0 * mv) - side)
            lift += dt / 0.3 * (a3 * wc + b3 * wc * abs(wc) + 1.5 * mw * (wc - w) - lift)
        moment = hull.rudder * u * u * fin if fins else 4.0 * hull.inertia * fin
        du = (force - a1 * u - b1 * u * abs(u) + mv * v * r - mw * w * q) / mu
        dv = (side - (a2 + 20.0 * fins * abs(u)) * v - b2 * v * abs(v) - mu * u * r - 9.6 * fins * u * u * fin) / mv
        dw = (lift - (a3 + 20.0 * fins * abs(u)) * w - b3 * w * abs(w) + mu * u * q) / mw
        dr = (moment - hull.yaw_drag[0] * r - hull.yaw_drag[1] * r * abs(r) - hull.munk * u * v) / hull.inertia
        dq = (hull.rudder * u * u * plane - hull.righting * np.sin(pitch) - 3.0 * (1.0 + abs(u)) * q * hull.inertia / 8
              - 0.008 * (not fins) * force) / hull.inertia  # fmt: skip
        dp = -9.0 * np.sin(roll) - 2.5 * p + 0.02 * force / mu - 1.2 * u * r + 0.3 * dv
        u, v, w, p, q, r = u + dt * du, v + dt * dv, w + dt * dw, p + dt * dp, q + dt * dq, r + dt * dr
        roll, pitch, yaw = roll + dt * p, pitch + dt * q, yaw + dt * (r / max(np.cos(pitch), 0.3))
        velocity[k], angles[k], thrust[k] = (u, v, w), (roll, pitch, yaw), force
    return velocity, angles, thrust


@dataclass(frozen=True)
class Motion:
    """Motion without noise on a uniform grid of times in s: body velocity, angles, rates, force, earth velocity."""

    time: Array
    velocity: Array
    angles: Array  # roll, pitch, yaw, not wrapped
    rate: Array
    force: Array  # acceleration and gravity in the body, m/s²
    earth: Array
    depth: Array
    thrust: Array  # relative to its rms

    def at(self, times: Array) -> Motion:
        """Return the motion at other times."""
        values = [getattr(self, each.name) for each in fields(self)]
        return Motion(*(np.stack([np.interp(times, self.time, column) for column in each.T], -1) if each.ndim == 2
                        else np.interp(times, self.time, each) for each in values))  # fmt: skip


def rotation(angles: Array) -> Rotation:
    """Return the rotation from body to earth of roll, pitch and yaw (n, 3)."""
    return Rotation.from_euler("ZYX", angles[:, ::-1])


def motion_of(case: Case) -> Motion:
    """Integrate the vehicle of a case through its mission, in waves and a current."""
    rng, hull = np.random.default_rng([*case.seed, 1]), HULLS[case.hull]
    heading, drift = rng.uniform(-np.pi, np.pi, 2)
    current = rng.uniform(0.0, 0.3) * np.array([np.cos(drift), np.sin(drift)])
    body_current = rotation(np.array([[0.0, 0.0, -heading]])).apply(np.r_[current, 0.0])[0, :2]
    velocity, angles, thrust = _drive(hull, _plan(rng, case.mission, case.seconds), body_current)
    angles[:, 2] += heading
    time = np.arange(len(thrust)) * STEP_S - MARGIN_S
    # a short-crested sea of fourteen waves of 3 to 10 s
    omega = 2 * np.pi * rng.uniform(0.1, 0.33, 14)
    amplitude = rng.rayleigh(1.0, 14) * (0.14 / omega) ** 1.2 * rng.uniform(0.3, 1.0) * rng.uniform(*hull.wave)
    amplitude = np.minimum(amplitude, 0.12)
    phase = omega * time[:, None] + rng.uniform(0, 2 * np.pi, 14)
    to = drift + rng.normal(0.0, 0.5, 14)
    orbit = amplitude * omega * np.sin(phase)
    waves = np.c_[orbit @ np.cos(to), orbit @ np.sin(to), (amplitude * omega * np.cos(phase)).sum(1)]
    slope, relative = amplitude * omega**2 / GRAVITY_MPS2 * np.sin(phase), to - angles[:, 2:]
    angles[:, 0] += 1.6 * (slope * np.sin(relative)).sum(1)
    angles[:, 1] -= 1.2 * (slope * np.cos(relative)).sum(1)
    turned = rotation(angles)
    earth = turned.apply(velocity) + waves + np.r_[current, 0.0]
    if case.hull == "boat":
        earth[:, 2] = waves[:, 2]
    middle = (turned[:-2].inv() * turned[2:]).as_rotvec() / (2 * STEP_S)
    rate = np.vstack([middle[:1], middle, middle[-1:]])
    force = turned.inv().apply(np.gradient(earth, STEP_S, axis=0) + np.array([0.0, 0.0, GRAVITY_MPS2]))
    depth = 30.0 - np.cumsum(earth[:, 2]) * STEP_S
    return Motion(time, turned.inv().apply(earth), angles, rate, force, earth, depth, thrust / np.std(thrust))


def _delay(effects: Effects, since: Array) -> Array:
    """Return by how many seconds DVL stamps are late, at times since the first (n,)."""
    jump = effects.get("time_offset_jump", {})
    late: Array = (
        effects.get("dvl_time_offset", {}).get("seconds", 0.0)
        + effects.get("clock_drift", {}).get("seconds_per_hour", 0.0) * since / 3600.0
        + jump.get("seconds", 0.0) * (since >= jump.get("at_s", np.inf))
        + jump.get("again_seconds", 0.0) * (since >= jump.get("again_at_s", np.inf))
    )
    return late


def _three(effects: Effects, name: str, *keys: str) -> Array:
    return np.array([effects.get(name, {}).get(key, 0.0) for key in keys])


def dvl_velocity(case: Case, motion: Motion, effects: Effects) -> Array:
    """Return what the DVL measures without noise at the times of `motion` (n, 3), on its own axes."""
    e, t = effects, motion.time
    arm = np.add(case.arm_m, _three(e, "lever_arm", "x_m", "y_m", "z_m"))
    body = motion.velocity + np.cross(motion.rate, arm)
    speed = np.linalg.norm(motion.velocity, axis=1)
    body[:, 1] += (e.get("sideslip", {}).get("coefficient_s", 0.0) * motion.rate[:, 2]
                   * np.linalg.norm(motion.velocity[:, :2], axis=1))  # fmt: skip
    tilt = e.get("tilt_coupling", {})
    for axis, angle, key in ((0, 1, "x_per_pitch"), (2, 1, "z_per_pitch"), (1, 0, "y_per_roll"), (2, 0, "z_per_roll")):
        body[:, axis] += tilt.get(key, 0.0) * motion.angles[:, angle]
    if "water_lock" in e:
        lock = e["water_lock"]
        inside = (t >= lock.get("from_s", -np.inf)) & (t <= lock.get("to_s", np.inf))
        earth = inside[:, None] * _three(e, "water_lock", "east_mps", "north_mps", "up_mps")
        body += rotation(motion.angles).inv().apply(earth)
    body[:, 0] += e.get("thrust_bias", {}).get("mps", 0.0) * motion.thrust
    body[:, 0] += e.get("roll_rate_coupling", {}).get("m", 0.0) * motion.rate[:, 0]
    hours = t[:, None] / 3600.0
    flexed = speed[:, None] * _three(e, "mount_flexure", *(f"{axis}_rad_per_mps" for axis in "xyz"))
    drifted = hours * _three(e, "misalignment_drift", *(f"{axis}_rad_per_hour" for axis in "xyz"))
    seen = Rotation.from_rotvec(flexed + drifted).apply(body @ case.calibration.T)
    fast = np.linalg.norm(seen, axis=1)[:, None]
    xy, xz, yz = _three(e, "axis_nonorthogonality", "xy_rad", "xz_rad", "yz_rad")
    shear = np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
    depth = motion.depth[:, None] - 30.0
    velocity: Array = (
        seen
        + seen @ shear
        + seen * hours * e.get("scale_drift", {}).get("rate_per_hour", 0.0)
        + seen * fast * e.get("quadratic_scale", {}).get("coefficient_s_per_m", 0.0)
        + seen * depth * e.get("sound_speed_layer", {}).get("ratio_per_m", 0.0)
        + _three(e, "velocity_bias", "x_mps", "y_mps", "z_mps")
    )
    beam = e.get("switched_beam", {})
    if beam:
        on = np.sin(2 * np.pi * (t / beam["period_s"] + beam["phase"])) > 0.3
        velocity += on[:, None] * beam["mps"] * np.linalg.pinv(BEAMS)[:, int(beam["beam"])]
    return velocity


def reference_velocity(motion: Motion, effects: Effects) -> Motion:
    """Return the motion with the earth velocity that the reference stamps at each time."""
    earth = motion.earth
    lag = effects.get("reference_lag", {}).get("time_constant_s", 0.0)
    if lag > 0:
        a = float(np.exp(-STEP_S / lag))
        earth = lfilter([1 - a], [1, -a], earth, axis=0, zi=a * earth[:1])[0]
    late = effects.get("reference_time_offset", {}).get("seconds", 0.0)
    return replace(motion, earth=replace(motion, earth=earth).at(motion.time - late).earth)


def attitude(motion: Motion, effects: Effects, times: Array) -> Motion:
    """Return the motion with angles and rates as the IMU stamps them at `times`."""
    seen = motion.at(times - effects.get("attitude_time_offset", {}).get("seconds", 0.0))
    angles, error = seen.angles.copy(), effects.get("heading_error", {})
    yaw = seen.angles[:, 2]
    angles[:, 2] += error.get("sin_rad", 0.0) * np.sin(yaw) + error.get("cos_rad", 0.0) * np.cos(yaw)
    passage = effects.get("magnetic_passage", {})
    if passage:
        angles[:, 2] += passage["rad"] * np.exp(-0.5 * ((times - passage["at_s"]) / passage["width_s"]) ** 2)
    return replace(seen, angles=angles)


def residual(case: Case, motion: Motion, effects: Effects, stamps: Array) -> Array:
    """Return the DVL less reference and attitude without noise, at DVL stamps (n, 3), at the true calibration."""
    dvl = dvl_velocity(case, motion.at(stamps - _delay(effects, stamps - stamps[0])), effects)
    imu = attitude(motion, effects, stamps)
    earth = reference_velocity(motion, effects).at(stamps).earth
    body = rotation(imu.angles).inv().apply(earth) + np.cross(imu.rate, case.arm_m)
    difference: Array = dvl - body @ case.calibration.T
    return difference


@dataclass(frozen=True)
class Stream:
    """Stamps in s (n,), the true times, values without noise and their noise (n, k), and the claimed variance."""

    stamps: Array
    measured: Array
    clean: Array
    noise: Array
    variance: Array


def gauss_markov(rng: np.random.Generator, times: Array, memory_s: float, columns: int) -> Array:
    """Draw a first-order Gauss-Markov process of unit variance at increasing times (n, columns)."""
    grid = np.arange(times[0], times[-1] + 1.0, 0.1)
    a = float(np.exp(-0.1 / memory_s))
    white = rng.normal(0.0, np.sqrt(1 - a * a), (len(grid), columns))
    white[0] = rng.normal(0.0, 1.0, columns)
    slow = lfilter([1.0], [1.0, -a], white, axis=0)
    return np.stack([np.interp(times, grid, each) for each in slow.T], -1)


def streams_of(case: Case, motion: Motion) -> tuple[Stream, Stream, Stream]:
    """Return DVL, reference and IMU as recorded; the IMU's values are roll, pitch, yaw, rates and forces."""
    rng, noise, effects = np.random.default_rng([*case.seed, 2]), case.noise, case.effects
    found = []
    for which in range(3):
        period = 1.0 / case.rates_hz[which]
        times = np.arange(0.01 * which, case.seconds, period)
        times += rng.uniform(-0.05, 0.05, len(times)) * period
        keep = rng.random(len(times)) > (0.02 if which < 2 and noise.kind == "gaps" else 0.0)
        for _ in range(noise.gaps[which] if which < 2 else 0):
            begin = rng.uniform(10.0, case.seconds - 30.0)
            keep &= (times < begin) | (times > begin + rng.uniform(3.0, 20.0))
        found.append(times[keep])
    at_dvl, at_reference, at_imu = found

    def velocity_noise(times: Array, which: int, std: float, slow: float) -> Array:
        shape = (len(times), 3)
        white = rng.standard_t(3, shape) / np.sqrt(3.0) if noise.tails[which] else rng.normal(size=shape)
        each = std * white + slow * gauss_markov(rng, times, noise.memory_s, 3)
        return each * [1.0, 1.0, noise.vertical[which]]

    def claimed(which: int, std: float) -> Array:
        return (noise.claims[which] * std * np.array([1.0, 1.0, noise.vertical[which]])) ** 2

    dvl = Stream(at_dvl + _delay(effects, at_dvl - at_dvl[0]), at_dvl, dvl_velocity(case, motion.at(at_dvl), effects),
                 velocity_noise(at_dvl, 0, noise.dvl, noise.slow_dvl), claimed(0, noise.dvl))  # fmt: skip
    reference = Stream(at_reference, at_reference, reference_velocity(motion, effects).at(at_reference).earth,
                       velocity_noise(at_reference, 1, noise.reference, noise.slow_reference),
                       claimed(1, noise.reference))  # fmt: skip
    seen = attitude(motion, effects, at_imu)
    white = np.r_[np.radians([0.01, 0.01, 0.02]), [1e-3] * 3, [0.03] * 3]
    error = rng.normal(size=(len(at_imu), 9)) * white
    error[:, 2] += noise.slow_heading * gauss_markov(rng, at_imu, noise.memory_s, 1)[:, 0]
    imu = Stream(at_imu, at_imu, np.c_[seen.angles, seen.rate, seen.force], error, white**2)
    return dvl, reference, imu


def write(case: Case, path: Path) -> None:
    """Write the bag of a case to a new folder."""
    types, streams = TYPES.types, streams_of(case, motion_of(case))
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]

    def header(stamp: float, frame: str) -> Any:
        seconds = int(np.floor(stamp))
        time = types["builtin_interfaces/msg/Time"](sec=START_S + seconds, nanosec=int((stamp - seconds) * 1e9))
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    rows: list[tuple[float, str, str, Any]] = []
    for stream, topic, frame in zip(streams[:2], ("dvl/twist", "gnss/twist"), ("dvl_link", "enu"), strict=True):
        covariance = np.zeros(36)
        covariance[[0, 7, 14]] = stream.variance
        for stamp, true, values in zip(stream.stamps, stream.measured, stream.clean + stream.noise, strict=True):
            twist = types["geometry_msgs/msg/Twist"](linear=vector(*values.tolist()), angular=vector(0.0, 0.0, 0.0))
            body = types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=covariance)
            rows.append((max(stamp, true), topic, TWIST, types[TWIST](header=header(stamp, frame), twist=body)))
    imu = streams[2]
    values = imu.clean + imu.noise
    quaternions = rotation(values[:, :3]).as_quat().tolist()
    small = [np.diag(each).ravel() for each in imu.variance.reshape(3, 3)]
    for stamp, turned, each in zip(imu.stamps, quaternions, values[:, 3:].tolist(), strict=True):
        rows.append((stamp, "imu/data", IMU, types[IMU](
            header=header(stamp, "base_link"), orientation=quaternion(*turned), orientation_covariance=small[0],
            angular_velocity=vector(*each[:3]), angular_velocity_covariance=small[1],
            linear_acceleration=vector(*each[3:]), linear_acceleration_covariance=small[2])))  # fmt: skip
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=TYPES)
                       for topic, kind in (("dvl/twist", TWIST), ("gnss/twist", TWIST), ("imu/data", IMU))}  # fmt: skip
        for logged, topic, kind, message in sorted(rows, key=lambda row: row[0]):
            bag.write(connections[topic], int((START_S + logged + 0.02) * 1e9), TYPES.serialize_cdr(message, kind))
