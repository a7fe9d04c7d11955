"""What the vehicles of the trial measure, free of noise, with and without faults.

A fault is an effect of the library as its documentation states it, or one that no library knows (`Oddity`); the names
of faults and of their parameters are the documentation's, the physics is written anew.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .motion import HELD_OUT_KINDS, RATE_HZ, TUNING_KINDS, Floats, Motion, State, attitude, lagged

Values = Mapping[str, float]
Faults = Mapping[str, Values]
"""Name of a fault -> its parameters, for one recording or several (`in_recording`)."""
HOUR_S = 3600.0
# A vehicle that turns faster than this is in a turn
TURNING_RAD_S = 0.04


@dataclass(frozen=True)
class Fault:
    """typical: a size of each parameter worth knowing of. largest: beyond it, no vehicle would go unnoticed.

    positive: parameters that are not negative. Parameters that are times of the run (from_s, to_s, at_s) are drawn by
    the case. between: shows between recordings only.
    """

    typical: Values
    largest: float
    positive: bool = False
    between: bool = False


def _axes(suffix: str, typical: float) -> Values:
    return {f"{axis}_{suffix}": typical for axis in "xyz"}


# largest: times typical
FAULTS: Mapping[str, Fault] = {
    "lever_arm": Fault(_axes("m", 0.3), 10.0),
    "dvl_time_offset": Fault({"seconds": 0.1}, 8.0),
    "reference_time_offset": Fault({"seconds": 0.1}, 8.0),
    "reference_lag": Fault({"time_constant_s": 0.2}, 8.0, positive=True),
    "velocity_bias": Fault(_axes("mps", 0.02), 10.0),
    "quadratic_scale": Fault({"coefficient_s_per_m": 0.005}, 10.0),
    "scale_drift": Fault({"rate_per_hour": 0.03}, 12.0),
    "misalignment_drift": Fault(_axes("rad_per_hour", 0.05), 12.0),
    "mount_flexure": Fault(_axes("rad_per_mps", 0.005), 10.0),
    "axis_nonorthogonality": Fault({"xy_rad": 0.01, "xz_rad": 0.01, "yz_rad": 0.01}, 12.0),
    "water_lock": Fault({"east_mps": 0.1, "north_mps": 0.1}, 6.0),
    "heading_error": Fault({"sin_rad": 0.02, "cos_rad": 0.02}, 10.0),
    "sideslip": Fault({"coefficient_s": 0.1}, 10.0),
    "tilt_coupling": Fault({"x_per_pitch": 0.5, "z_per_pitch": 0.5, "y_per_roll": 0.5, "z_per_roll": 0.5}, 12.0),
    "attitude_time_offset": Fault({"seconds": 0.1}, 8.0),
    "time_offset_jump": Fault({"seconds": 0.2}, 8.0),
    "clock_drift": Fault({"seconds_per_hour": 1.0}, 36.0),
    "mounting_moved": Fault(_axes("rad", 0.02), 5.0, between=True),
    "sound_speed_moved": Fault({"ratio": 0.005}, 5.0, between=True),
}
# What a reference in the body's frame cannot show
NEED_ATTITUDE = frozenset({"heading_error", "attitude_time_offset"})


def of_one_recording(in_body: bool) -> list[str]:
    """Names of the faults that a single recording can show."""
    return [name for name, fault in FAULTS.items() if not fault.between and not (in_body and name in NEED_ATTITUDE)]


def in_recording(faults: Faults, number: int) -> Faults:
    """The faults that are there in a recording of several, the first being 0.

    "seconds@1" is a parameter of recording 1 alone; a fault with from_recording is not there before.
    """
    return {
        name: {
            each.split("@")[0]: value
            for each, value in values.items()
            if "@" not in each or each.endswith(f"@{number}")
        }
        for name, values in faults.items()
        if values.get("from_recording", 0) <= number
    }


# ------------------------------------------------------------------ what no library knows


@dataclass(frozen=True)
class Oddity:
    """A fault outside the library.

    added: state, elapsed s, shape parameters -> (N, 3) m/s on the DVL's axes, of unit size. typical: its size, of which
    it has at most `largest` times as much. shape: low and high of each shape parameter. kinds: of trajectory on which
    the library does not look like it.
    """

    added: Callable[[State, Floats, Values], Floats]
    typical: float
    shape: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    kinds: tuple[str, ...] = (*TUNING_KINDS, *HELD_OUT_KINDS)
    largest: float = 20.0


def _on(axis: int, values: Floats) -> Floats:
    return np.outer(values, np.eye(3)[axis])


def _beam_bursts(state: State, elapsed: Floats, shape: Values) -> Floats:
    lost = np.mod(elapsed, shape["period_s"]) < shape["share"] * shape["period_s"]
    return np.outer(lost, [np.cos(shape["azimuth"]), np.sin(shape["azimuth"]), 0.3])


def _roll_rate_surge(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(0, state.rates[:, 0])


def _slow_heave(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(2, np.sin(2 * np.pi * elapsed / shape["period_s"] + shape["phase"]))


def _thruster_wash(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(1, np.abs(np.gradient(state.speed, elapsed)))


def _turn_stall(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(0, np.abs(state.rates[:, 2]) * state.speed)


def _bias_step(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(int(shape["axis"]), elapsed > shape["share"] * elapsed[-1])


def _turn_hysteresis(state: State, elapsed: Floats, shape: Values) -> Floats:
    """The side of the last turn, until a turn to the other side."""
    turning = np.where(np.abs(state.rates[:, 2]) > TURNING_RAD_S, np.sign(state.rates[:, 2]), 0.0)
    last = np.maximum.accumulate(np.where(turning != 0.0, np.arange(len(turning)), 0))
    return _on(1, turning[last])


def _speed_resonance(state: State, elapsed: Floats, shape: Values) -> Floats:
    """At one speed, in the middle of those that the vehicle goes at."""
    slow, fast = np.quantile(state.speed, [0.05, 0.95])
    at = slow + shape["share"] * (fast - slow)
    return _on(0, np.exp(-0.5 * ((state.speed - at) / max(0.08 * (fast - slow), 0.02)) ** 2))


def _third_harmonic(state: State, elapsed: Floats, shape: Values) -> Floats:
    return _on(1, np.sin(3.0 * state.euler[:, 0] + shape["phase"]))


ODDITIES: Mapping[str, Oddity] = {
    "beam_bursts": Oddity(_beam_bursts, 0.02, {"period_s": (20.0, 90.0), "share": (0.2, 0.5), "azimuth": (0.0, 6.283)}),
    "roll_rate_surge": Oddity(_roll_rate_surge, 0.3, kinds=("lawnmower", "zigzag", "free", "spiral")),
    "slow_heave": Oddity(_slow_heave, 0.02, {"period_s": (50.0, 150.0), "phase": (0.0, 6.283)}),
    "thruster_wash": Oddity(_thruster_wash, 0.2),
    "turn_stall": Oddity(_turn_stall, 0.1, kinds=("figure8", "zigzag", "free")),
    "third_harmonic": Oddity(_third_harmonic, 0.02, {"phase": (0.0, 6.283)}),
    "bias_step": Oddity(_bias_step, 0.02, {"axis": (0.0, 3.0), "share": (0.25, 0.75)}),
    "turn_hysteresis": Oddity(_turn_hysteresis, 0.02),
    "speed_resonance": Oddity(_speed_resonance, 0.05, {"share": (0.3, 0.7)}),
}


# ------------------------------------------------------------------ instruments


@dataclass(frozen=True)
class Vehicle:
    """A vehicle and its DVL, as they are.

    mounting_rpy: nominal, as a URDF origin. misalignment: (3,) rad rotation vector in the DVL's frame, turns the
    velocity. sound_speed_error: relative. beam_angle: rad from the vertical, and its error. azimuth: rad of the first
    beam.
    """

    mounting_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sound_speed_error: float = 0.0
    beam_angle: float = np.deg2rad(30.0)
    beam_angle_error: float = 0.0
    azimuth: float = 0.0

    @property
    def dvl_from_body(self) -> Rotation:
        """The nominal T."""
        return Rotation.from_euler("xyz", self.mounting_rpy).inv()

    def beams(self, angle_error: float = 0.0) -> Floats:
        """(4, 3) directions in which the beams take the velocity."""
        angle = self.beam_angle + angle_error
        azimuths = self.azimuth + np.arange(4) * np.pi / 2
        return np.column_stack(
            [np.cos(azimuths) * np.sin(angle), np.sin(azimuths) * np.sin(angle), np.full(4, np.cos(angle))]
        )

    @property
    def axes_from_beams(self) -> Floats:
        """(3, 4) as the DVL's maker thinks."""
        return np.asarray(np.linalg.pinv(self.beams()), dtype=np.float64)


def dvl_stamps(times: Floats, faults: Faults) -> Floats:
    """How the DVL stamps what it measured at times (N,) s, of which the first is that of its first sample."""
    since = times - times[0]
    late = np.full(len(times), faults.get("dvl_time_offset", {}).get("seconds", 0.0))
    if jump := faults.get("time_offset_jump"):
        late += jump["seconds"] * (since >= jump["at_s"])
        late += jump.get("again_seconds", 0.0) * (since >= jump.get("again_at_s", 0.0))
    gain = faults.get("clock_drift", {}).get("seconds_per_hour", 0.0) / HOUR_S  # per hour of its own
    return np.asarray(times + late + gain / (1.0 - gain) * since)


def dvl_velocity(motion: Motion, vehicle: Vehicle, faults: Faults, times: Floats) -> Floats:
    """What the DVL measures at times (N,) s, free of noise: (N, 3) m/s in its own frame."""
    return dvl_velocity_of(motion.at(times), vehicle, faults)


def dvl_velocity_of(state: State, vehicle: Vehicle, faults: Faults) -> Floats:
    """What the DVL measures of a motion at N times, free of noise: (N, 3) m/s in its own frame."""
    nominal = vehicle.dvl_from_body
    moved = _velocity_at_dvl(state, faults)
    turned = _mounting(state, vehicle, faults).apply(nominal.apply(moved))
    radial = turned @ _beams_as_they_are(vehicle, faults).T
    factor = np.full(len(state.time), 1.0 + vehicle.sound_speed_error)
    factor += faults.get("sound_speed_moved", {}).get("ratio", 0.0)
    factor += faults.get("quadratic_scale", {}).get("coefficient_s_per_m", 0.0) * state.speed
    factor += faults.get("scale_drift", {}).get("rate_per_hour", 0.0) / HOUR_S * state.time
    added = nominal.apply(_tilt_leak(state, faults)) + _constant(faults, "velocity_bias", "mps")
    for name, values in faults.items():
        if name in ODDITIES:
            added += values["size"] * ODDITIES[name].added(state, state.time, values)
    radial = radial * factor[:, None] + added @ vehicle.beams().T
    return np.asarray(radial @ vehicle.axes_from_beams.T)


def _constant(faults: Faults, name: str, suffix: str) -> Floats:
    values = faults.get(name, {})
    return np.array([values.get(f"{axis}_{suffix}", 0.0) for axis in "xyz"])


def _velocity_at_dvl(state: State, faults: Faults) -> Floats:
    """(N, 3) m/s in the body of what the DVL looks at, where it sits."""
    velocity = state.velocity_body + np.cross(state.rates, _constant(faults, "lever_arm", "m"))
    if slip := faults.get("sideslip"):
        along = np.hypot(*state.velocity_body[:, :2].T)
        velocity[:, 1] += slip["coefficient_s"] * state.rates[:, 2] * along
    if lock := faults.get("water_lock"):
        locked = (state.time >= lock["from_s"]) & (state.time < lock["to_s"])
        drift_enu = np.outer(locked, [lock["east_mps"], lock["north_mps"], 0.0])
        velocity += state.attitude.apply(drift_enu, inverse=True)
    return velocity


def _mounting(state: State, vehicle: Vehicle, faults: Faults) -> Rotation:
    turn = np.tile(vehicle.misalignment, (len(state.time), 1)) + _constant(faults, "mounting_moved", "rad")
    turn += np.outer(state.time / HOUR_S, _constant(faults, "misalignment_drift", "rad_per_hour"))
    turn += np.outer(state.speed, _constant(faults, "mount_flexure", "rad_per_mps"))
    return Rotation.from_rotvec(turn)


def _beams_as_they_are(vehicle: Vehicle, faults: Faults) -> Floats:
    lacks = faults.get("axis_nonorthogonality", {})
    xy, xz, yz = (lacks.get(name, 0.0) for name in ("xy_rad", "xz_rad", "yz_rad"))
    shear = np.array([[1.0, xy, xz], [xy, 1.0, yz], [xz, yz, 1.0]])
    return vehicle.beams(vehicle.beam_angle_error) @ shear


def _tilt_leak(state: State, faults: Faults) -> Floats:
    leak = np.zeros((len(state.time), 3))
    if gains := faults.get("tilt_coupling"):
        _, pitch, roll = state.euler.T
        leak[:, 0] = gains["x_per_pitch"] * pitch
        leak[:, 1] = gains["y_per_roll"] * roll
        leak[:, 2] = gains["z_per_pitch"] * pitch + gains["z_per_roll"] * roll
    return leak


def reference_velocity(motion: Motion, faults: Faults, stamps: Floats, in_body: bool) -> Floats:
    """What the reference reports at its stamps (N,) s, free of noise: (N, 3) m/s in the body or east-north-up."""
    time_constant = faults.get("reference_lag", {}).get("time_constant_s", 0.0)
    times = stamps - faults.get("reference_time_offset", {}).get("seconds", 0.0)
    if not time_constant:
        state = motion.at(times)
        return state.velocity_body if in_body else state.velocity_enu
    full = motion.at(motion.time).velocity_body if in_body else motion.velocity_enu
    filtered = lagged(full, time_constant)
    # a discrete filter answers a ramp one sample's half early
    return np.column_stack([np.interp(times, motion.time + 0.5 / RATE_HZ, column) for column in filtered.T])


def attitude_state(motion: Motion, faults: Faults, stamps: Floats) -> State:
    """The motion that the inertial unit stamps with stamps (N,) s."""
    return motion.at(stamps - faults.get("attitude_time_offset", {}).get("seconds", 0.0))


def recorded_attitude(state: State, faults: Faults) -> Rotation:
    """Attitude as the inertial unit has it, with the compass's error."""
    euler = state.euler.copy()
    if swing := faults.get("heading_error"):
        euler[:, 0] += swing["sin_rad"] * np.sin(euler[:, 0]) + swing["cos_rad"] * np.cos(euler[:, 0])
    return attitude(euler)
