"""Schema of all parameters: name, default, type, unit, range and description, in SI units and radians.

It generates the node's declarations and descriptors, the offline validation of YAML files, the table in
docs/reference.md and `config/calibration.yaml`.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..numerics.frames import Array, rotation_from_rpy, rpy_from_rotation
from ..numerics.samples import VelocityFrame
from . import MODELS
from .base import ASSUMPTIONS


class ParameterError(ValueError):
    """Unknown parameter or unusable value; the message names it and the accepted values."""


@dataclass(frozen=True)
class ParameterSpec:
    """Specification of a parameter apart from its name."""

    default: Any
    description: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True

    @property
    def kind(self) -> str:
        """ROS 2 type: string, bool, double or double_array."""
        names = {str: "string", bool: "bool", float: "double", tuple: "double_array"}
        return names[type(self.default)]

    @property
    def length(self) -> int:
        """Number of elements of an array."""
        return len(self.default)

    def check(self, name: str, value: Any) -> Any:
        """Return the value in its own type (integers as doubles, arrays as tuples), or raise ParameterError."""
        if self.kind == "double_array":
            if isinstance(value, str | bytes) or not hasattr(value, "__len__") or len(value) != self.length:
                raise ParameterError(f"{name}: expected an array of {self.length} numbers, got {value!r}")
            return tuple(self._number(f"{name}[{i}]", element) for i, element in enumerate(value))
        if self.kind == "double":
            return self._number(name, value)
        if self.kind == "bool":
            if not isinstance(value, bool):
                raise ParameterError(f"{name}: expected true or false, got {value!r}")
            return value
        if not isinstance(value, str):
            raise ParameterError(f"{name}: expected text, got {value!r}")
        if self.choices and value not in self.choices:
            raise ParameterError(f"{name}: {value!r} is not one of {', '.join(self.choices)}")
        return value

    def _number(self, name: str, value: Any) -> float:
        """Return a value as a float within the limits. Raises ParameterError."""
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise ParameterError(f"{name}: expected a number, got {value!r}")
        try:
            number = float(value)
        except OverflowError:
            raise ParameterError(f"{name}: the whole number is too large") from None
        if not math.isfinite(number):
            raise ParameterError(f"{name}: {number} is not finite")
        if (self.low is not None and number < self.low) or (self.high is not None and number > self.high):
            raise ParameterError(f"{name}: {number:g} is outside {self.low:g} .. {self.high:g} {self.unit}".rstrip())
        return number


def _parameter(default: Any, description: str, within: tuple[float, float] | None = None, **known: Any) -> Any:
    """Return the field of a parameter. within: its smallest and largest value."""
    low, high = within or (None, None)
    spec = ParameterSpec(default, description, low=low, high=high, **known)
    return dataclasses.field(default=default, metadata={"spec": spec})


AUTO = "auto"
IAC = "iac"
FROM_FRAME_ID = "from_frame_id"
UNKNOWN, TOLD, FROM_REFERENCE = "unknown", "told", "from_reference"
FROM_MESSAGE, FLU, FRD = "from_message", "flu", "frd"
# North-west-up, a world frame in addition to VelocityFrame
NWU = "nwu"
IMU_ENU, IMU_NED = "enu", "ned"
XYZ, XY = "xyz", "xy"


@dataclass(frozen=True)
class Parameters:
    """Validated parameters of a calibration. The constructor raises ParameterError."""

    model: str = _parameter(
        AUTO,
        "Published model: auto (recommended), iac (the paper's selection), or a name.",
        choices=(AUTO, IAC, *MODELS),
        read_only=False,
    )
    gnss_model: str = _parameter("M3", "Model of iac with GNSS (IAC-G).", choices=("M3", "M4"), read_only=False)
    gnss_free_model: str = _parameter(
        "M7", "Model of iac without GNSS (IAC-GF).", choices=("M5", "M6", "M7"), read_only=False
    )
    gnss_timeout: float = _parameter(
        2.0,
        "Age of the last paired reference sample from which GNSS counts as lost; longest interpolated gap.",
        unit="s",
        within=(0.05, 60.0),
    )
    gnss_hysteresis: float = _parameter(
        3.0,
        "How long GNSS must be present (or absent) before it counts as available (or lost).",
        unit="s",
        within=(0.0, 600.0),
        read_only=False,
    )
    gnss_frame: str = _parameter(
        FROM_FRAME_ID,
        "Frame of the reference velocity; body: base_axes; flu, frd: body with other axes. from_frame_id: "
        "base_frame is body; enu, map, odom, world: ENU; ned, nwu; or by ending: _enu, _ned, _nwu, _flu, "
        "_frd.",
        choices=(FROM_FRAME_ID, *(frame.value for frame in VelocityFrame), FLU, FRD, NWU),
    )
    gnss_axes: str = _parameter(
        AUTO,
        "Axes that the reference measures. auto: xy while its vertical velocity is exactly 0. A variance of -1, or "
        "1000 (m/s)² and more, marks an axis as not measured.",
        choices=(AUTO, XYZ, XY),
    )
    base_frame: str = _parameter("base_link", "Name of the body frame.")
    base_axes: str = _parameter(
        FLU, "Axes of base_frame and all results: forward-left-up (REP-103) or forward-right-down.", choices=(FLU, FRD)
    )
    use_transforms: bool = _parameter(
        True, "Take default mounting_rpy, lever_arm and imu_rpy from /tf_static or robot_description."
    )
    publish_tf: bool = _parameter(
        False, "Broadcast ~/mounting as a static transform (needs tf2_ros), if no other node does so."
    )
    dvl_frame: str = _parameter(
        "", "frame_id that DVL messages must carry. Empty: the first one that is neither body nor earth."
    )
    dvl_axes: str = _parameter(
        FROM_MESSAGE,
        "Axes of the DVL's data. from_message: by a frame_id ending in _frd or _flu, else by message type.",
        choices=(FROM_MESSAGE, FLU, FRD),
    )
    dvl_type: str = _parameter("geometry_msgs/msg/TwistWithCovarianceStamped", "Message type of the DVL's topic, live.")
    dvl_fields: str = _parameter(
        "",
        "Fields of an unlisted message type: velocity=vel.x,vel.y,vel.z,valid=lock; or beams=list,direction,velocity; "
        "also variance, stamp, frame.",
    )
    gnss_type: str = _parameter(
        "geometry_msgs/msg/TwistWithCovarianceStamped", "Message type of the reference's topic, live."
    )
    position_window: float = _parameter(
        1.0,
        "Time between two positions that are differenced to a velocity. Longer: less noise, wrong in turns.",
        unit="s",
        within=(0.1, 30.0),
    )
    mounting_rpy: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Nominal orientation of the DVL in the body, as in a URDF origin.",
        unit="rad",
        within=(-2 * math.pi, 2 * math.pi),
    )
    lever_arm: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Position of the DVL from the reference point, body frame; compensated with the angular velocity.",
        unit="m",
        within=(-100.0, 100.0),
    )
    reference_position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Position of the reference point (antenna, INS) in base_frame. The DVL is at this plus lever_arm.",
        unit="m",
        within=(-100.0, 100.0),
    )
    dvl_position: str = _parameter(
        UNKNOWN,
        "The DVL's position in base_frame: reference_position plus the estimated (from_reference) or "
        "configured (told) lever arm; unknown: none is written.",
        choices=(UNKNOWN, TOLD, FROM_REFERENCE),
    )
    imu_rpy: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Orientation of the IMU's axes in the body, as in a URDF origin. Forward-right-down: pi 0 0.",
        unit="rad",
        within=(-2 * math.pi, 2 * math.pi),
    )
    imu_frame: str = _parameter(
        IMU_ENU,
        "Frame of the IMU's orientation: yaw 0 is east (enu, REP-103), or north, clockwise (ned) or counter-clockwise "
        "(nwu).",
        choices=(IMU_ENU, IMU_NED, NWU),
    )
    heading_offset: float = _parameter(
        0.0,
        "Added to the heading of the IMU's orientation, counter-clockwise: minus the declination of a compass, or the "
        "heading at which a gyro started.",
        unit="rad",
        within=(-2 * math.pi, 2 * math.pi),
    )
    restamp: str = _parameter("", "Topics whose stamps are replaced by recording times, separated by commas. log: all.")
    dvl_time_offset: float = _parameter(
        0.0, "Delay of DVL stamps (positive: late), corrected before pairing.", unit="s", within=(-60.0, 60.0)
    )
    reference_time_offset: float = _parameter(
        0.0, "As dvl_time_offset, for the reference.", unit="s", within=(-60.0, 60.0)
    )
    reference_velocity_offset: tuple[float, ...] = _parameter(
        (0.0, 0.0),
        "Constant error (east, north) of a reference in ENU or NED, or a current in water track. Corrected.",
        unit="m/s",
        within=(-5.0, 5.0),
    )
    imu_time_offset: float = _parameter(0.0, "As dvl_time_offset, for the IMU.", unit="s", within=(-60.0, 60.0))
    dvl_clock_drift: float = _parameter(
        0.0,
        "Growth of the delay of DVL stamps per second since the first. Corrected.",
        unit="s/s",
        within=(-0.01, 0.01),
    )
    dvl_time_jump: float = _parameter(
        0.0, "Additional delay of DVL stamps from dvl_time_jump_at on. Corrected.", unit="s", within=(-10.0, 10.0)
    )
    dvl_time_jump_at: float = _parameter(
        0.0, "DVL stamp (s since 1970) at which dvl_time_jump begins.", unit="s", within=(0.0, 2.0**31)
    )
    initial_std_misalignment: float = _parameter(
        0.05, "Prior σ of each misalignment angle.", unit="rad", within=(1e-6, 1.0)
    )
    initial_std_scale: float = _parameter(0.006, "Prior σ of the scale error.", within=(1e-7, 0.5))
    initial_std_lever_arm: float = _parameter(
        2.0,
        "Prior σ of the lever arm (full). A configured arm has σ 0.05 m, or this with probability 0.1.",
        unit="m",
        within=(1e-4, 100.0),
    )
    initial_std_time_offset: float = _parameter(
        1.0, "Prior σ of the DVL's delay (full, within 3.2 s).", unit="s", within=(1e-4, 10.0)
    )
    process_std_misalignment: float = _parameter(
        0.0, "Random walk of each misalignment angle.", unit="rad/√s", within=(0.0, 0.1)
    )
    process_std_scale: float = _parameter(0.0, "Random walk of the scale error.", unit="1/√s", within=(0.0, 0.1))
    use_message_covariance: bool = _parameter(True, "Take R of the GNSS models from the covariances in messages.")
    gnss_aided_std: float = _parameter(
        0.2, "σ per axis of R of the GNSS models, if the reference has no covariance.", unit="m/s", within=(1e-4, 10.0)
    )
    gnss_free_std: float = _parameter(
        0.025,
        "σ per axis of R of the GNSS-free models, and of a DVL without covariance.",
        unit="m/s",
        within=(1e-4, 10.0),
    )
    motion_std: float = _parameter(
        ASSUMPTIONS.motion_std,
        "σ of sway and heave about the model, straight ahead (unaided).",
        unit="m/s",
        within=(1e-4, 10.0),
    )
    motion_correlation_time: float = _parameter(
        ASSUMPTIONS.motion_correlation_time,
        "Correlation time of sway and heave (unaided). 0: none.",
        unit="s",
        within=(0.0, 600.0),
    )
    heave_offset_std: float = _parameter(
        ASSUMPTIONS.heave_offset_std,
        "Prior σ of a constant heave, such as trim (unaided).",
        unit="m/s",
        within=(1e-6, 10.0),
    )
    reference_offset_std: float = _parameter(
        0.005,
        "Prior σ per axis of a constant error of an earth-frame reference (full).",
        unit="m/s",
        within=(1e-6, 10.0),
    )
    heading_deviation_std: float = _parameter(
        math.radians(0.5),
        "Prior σ of the heading error, one and two cycles (compass). 0: exact.",
        unit="rad",
        within=(0.0, 0.5),
    )
    dvl_bias_std: float = _parameter(
        0.008, "Prior σ of the DVL's velocity bias per axis (full). 0: no bias.", unit="m/s", within=(0.0, 1.0)
    )
    day_std_heading: float = _parameter(
        math.radians(0.1),
        "σ of the heading error that differs between days (0.1°: gyrocompass; magnetic compass: 1° and more).",
        unit="rad",
        within=(0.0, 0.5),
    )
    day_std_scale: float = _parameter(
        0.003,
        "σ of the scale difference between days (0.3 %: 4.5 m/s of the speed of sound, or 1.5 °C).",
        within=(0.0, 0.5),
    )
    current_std: float = _parameter(
        ASSUMPTIONS.current_std,
        "Prior σ of the current per axis (unaided). On one heading it sets the share of sway that counts as "
        "misalignment.",
        unit="m/s",
        within=(1e-6, 10.0),
    )
    prior_source: str = _parameter(
        "fixed",
        "Prior sway and heave of M5 and M6: prior_sway_heave, or the mean of prior_window of the DVL "
        "(gains nothing) or the reference (replay only).",
        choices=("fixed", "initial_window", "reference"),
    )
    prior_window: float = _parameter(2.0, "Window that prior_source averages.", unit="s", within=(0.1, 600.0))
    prior_sway_heave: tuple[float, ...] = _parameter(
        (0.0, 0.0), "Sway and heave of prior_source fixed, body frame.", unit="m/s", within=(-10.0, 10.0)
    )
    gate_probability: float = _parameter(
        0.999, "Share of good samples that pass the gate (chi-square). 0 or 1: off.", within=(0.0, 1.0)
    )
    min_speed: float = _parameter(0.3, "Slower samples are not used. 0: off.", unit="m/s", within=(0.0, 10.0))
    max_turn_rate: float = _parameter(
        0.0, "Samples that turn faster or lack angular velocity are not used. 0: off.", unit="rad/s", within=(0.0, 10.0)
    )
    max_repeats: float = _parameter(
        0.0,
        "A DVL velocity that repeats exactly more often in a row is not used. 0: off.",
        within=(0.0, 1e6),
        read_only=False,
    )
    max_speed: float = _parameter(
        10.0, "A DVL or reference velocity above this is invalid.", unit="m/s", within=(0.1, 100.0)
    )
    max_fom: float = _parameter(
        0.4, "A figure of merit above this is invalid (dvl_msgs/DVL).", unit="m/s", within=(0.0, 100.0)
    )
    imu_timeout: float = _parameter(
        1.5, "Longest gap between two IMU samples that is interpolated.", unit="s", within=(0.01, 60.0)
    )
    max_latency: float = _parameter(
        1.0,
        "Longest time that a DVL sample waits for a topic, by stamps; then it is used without that topic.",
        unit="s",
        within=(0.0, 600.0),
    )
    max_time_jump: float = _parameter(
        10.0,
        "A larger step between stamps is used if the next sample confirms it; backward it restarts the calibration.",
        unit="s",
        within=(0.1, 86400.0),
    )
    new_day_after: float = _parameter(
        3600.0,
        "DVL pause that starts a new recording, with its own delay, reference offset and current.",
        unit="s",
        within=(15.0, 1e9),
    )
    discover: bool = _parameter(
        True,
        "Look for DVL, reference and IMU while the DVL's topic is silent and not remapped; choose the reference's "
        "frame.",
    )
    target_drift: float = _parameter(
        2.0,
        "Predicted drift at which a calibration is good enough; up to five times this value is accepted.",
        unit="m/km",
        within=(0.01, 1000.0),
        read_only=False,
    )
    verification_block: float = _parameter(
        10.0, "Length of the blocks of hold-out verification.", unit="s", within=(0.1, 3600.0)
    )
    accept_misalignment: float = _parameter(
        math.radians(2.0), "A misalignment above this (2°) is marginal.", unit="rad", within=(0.0, math.pi)
    )
    reject_misalignment: float = _parameter(
        math.radians(5.0), "A misalignment of this (5°) or more is rejected.", unit="rad", within=(0.0, math.pi)
    )
    max_scale_error: float = _parameter(0.05, "A larger scale error is rejected.", within=(0.0, 1.0))
    max_error_ratio: float = _parameter(
        1.0,
        "A calibration is marginal if held-out error / predicted error is significantly above this.",
        within=(0.1, 100.0),
    )
    result_file: str = _parameter(
        "",
        "Result file (YAML) of ~/save and the end of the node. A running node accepts only a .yaml in the same folder.",
        read_only=False,
    )
    result_backups: float = _parameter(
        3.0,
        "Number of earlier results kept: .bak is the last, .bak.2 and higher are the best converged.",
        within=(1.0, 100.0),
        read_only=False,
    )
    initial_calibration: str = _parameter("", "Result file whose states and covariances are the prior.")

    def __post_init__(self) -> None:
        for name, spec in SCHEMA.items():
            object.__setattr__(self, name, spec.check(name, getattr(self, name)))

    @staticmethod
    def from_mapping(values: Mapping[str, Any]) -> Parameters:
        """Return parameters with these values, else defaults. Raise ParameterError for a bad name or value."""
        check_names(values)
        return Parameters(**values)

    def replace(self, **values: Any) -> Parameters:
        """Return a validated copy with these values."""
        check_names(values)
        return dataclasses.replace(self, **values)

    def as_dict(self) -> dict[str, Any]:
        """Return values by name with arrays as lists, for YAML and JSON."""
        return {name: list(value) if isinstance(value := getattr(self, name), tuple) else value for name in SCHEMA}

    @property
    def is_z_down(self) -> bool:
        """True if base_frame is forward-right-down."""
        return self.base_axes == FRD

    @property
    def body_axes(self) -> tuple[str, str, str]:
        """Directions of x, y and z of base_frame in words."""
        return ("ahead", "to starboard", "down") if self.is_z_down else ("ahead", "to port", "up")

    @property
    def up(self) -> float:
        """Sign of the upward vertical along z of base_frame: 1, or -1 if z is down."""
        return -1.0 if self.is_z_down else 1.0

    @cached_property
    def rotation_dvl_from_body(self) -> Array:
        """T (3, 3) of mounting_rpy."""
        return rotation_from_rpy(self.mounting_rpy).T


SCHEMA: Mapping[str, ParameterSpec] = {field.name: field.metadata["spec"] for field in dataclasses.fields(Parameters)}


def rpy_text(rotation: Array) -> str:
    """Return roll, pitch, yaw (rad) of a rotation (3, 3) as the value of a parameter."""
    return "[" + ", ".join(f"{angle + 0.0:.5g}" for angle in rpy_from_rotation(rotation).round(4)) + "]"


def check_names(names: Mapping[str, Any]) -> None:
    """Raise ParameterError for an unknown parameter name, with the nearest known one."""
    for name in names:
        if name not in SCHEMA:
            near = difflib.get_close_matches(str(name), SCHEMA, n=1)
            hint = f", did you mean {near[0]!r}?" if near else "; dvl-calib parameters lists them"
            raise ParameterError(f"{name}: no such parameter{hint}")
