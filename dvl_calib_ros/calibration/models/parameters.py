"""Every parameter, once: name, default, type, unit, range and description.

From this schema come the node's declarations and descriptors, the validation of YAML files offline, the table in the
docs/reference.md and `config/calibration.yaml`. All in SI units and radians.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..numerics.frames import Array, rotation_from_rpy
from ..numerics.samples import VelocityFrame
from . import MODELS
from .base import ASSUMPTIONS
from .parameter_spec import ParameterError, ParameterSpec, _parameter

AUTO = "auto"
IAC = "iac"
FROM_FRAME_ID = "from_frame_id"
UNKNOWN, TOLD, FROM_REFERENCE = "unknown", "told", "from_reference"
FROM_MESSAGE, FLU, FRD = "from_message", "flu", "frd"
# Axes of a world: north-west-up beside VelocityFrame's
NWU = "nwu"
IMU_ENU, IMU_NED = "enu", "ned"
XYZ, XY = "xyz", "xy"


_AIDED = tuple(name for name, model in MODELS.items() if model.aided)
_UNAIDED = tuple(name for name, model in MODELS.items() if not model.aided)


@dataclass(frozen=True)
class Parameters:
    """The parameters of a calibration, checked when made. Raises ParameterError."""

    model: str = _parameter(
        AUTO,
        "Model whose estimate is published: auto (what we recommend), iac (the published selection: IAC-G, M3 or M4, "
        "with GNSS, IAC-GF, M5-M7, without), or a model's name.",
        choices=(AUTO, IAC, *MODELS),
        read_only=False,
    )
    gnss_model: str = _parameter(
        "full",
        "Model that auto runs while GNSS is available. Under iac it is M3, unless this says M4.",
        choices=_AIDED,
        read_only=False,
    )
    gnss_free_model: str = _parameter(
        "F1",
        "Model that auto runs while GNSS is not available. F1 gives way to A1 once there is attitude and several "
        "headings show the current. Under iac it is M7, unless this says M5 or M6.",
        choices=_UNAIDED,
        read_only=False,
    )
    gnss_timeout: float = _parameter(
        2.0,
        "Age of the last paired reference sample at which GNSS counts as lost; also the longest gap between two "
        "reference samples that is interpolated across.",
        unit="s",
        low=0.05,
        high=60.0,
    )
    gnss_hysteresis: float = _parameter(
        3.0,
        "How long GNSS must be present (or absent) before auto changes the model.",
        unit="s",
        low=0.0,
        high=600.0,
        read_only=False,
    )
    gnss_frame: str = _parameter(
        FROM_FRAME_ID,
        "Frame of the reference velocity; body: of the body, in base_axes; frd: of the body, forward-right-down. "
        "from_frame_id: base_frame is body; "
        "enu, map, odom, world are ENU; ned is NED; nwu: north-west-up; a name that ends in _enu, _ned, _nwu, _flu "
        "or _frd says so; anything else is refused.",
        choices=(FROM_FRAME_ID, *(frame.value for frame in VelocityFrame), FRD, NWU),
    )
    gnss_axes: str = _parameter(
        AUTO,
        "Axes of its frame that the reference measures: xyz, xy (no vertical velocity), or auto: xy as long as its "
        "vertical velocity has been exactly 0. An axis whose variance is -1, or 1000 (m/s)² and more, never counts.",
        choices=(AUTO, XYZ, XY),
    )
    base_frame: str = _parameter(
        "base_link",
        "Name of the body frame: of calibrated_twist, and of a body-frame reference.",
    )
    base_axes: str = _parameter(
        FLU,
        "Axes of base_frame: flu (forward-left-up, as REP-103 has it) or frd (forward-right-down, z down). Mounting, "
        "lever arm and every result are in these axes.",
        choices=(FLU, FRD),
    )
    use_transforms: bool = _parameter(
        True,
        "Take mounting_rpy, lever_arm and imu_rpy from /tf_static or robot_description, where they are at their "
        "default and the transforms have the DVL's frame.",
    )
    publish_tf: bool = _parameter(
        False,
        "Broadcast the calibrated mounting, as in ~/mounting, as a static transform from base_frame to the DVL's frame "
        "(live, where tf2_ros is installed). Not beside another node that publishes that transform.",
    )
    dvl_frame: str = _parameter(
        "",
        "frame_id that DVL messages must carry. Empty: any but a body or earth frame, and the first one seen.",
    )
    dvl_axes: str = _parameter(
        FROM_MESSAGE,
        "Axes of the DVL's data: flu (forward-left-up) or frd (forward-right-down). Where base_axes are the other, "
        "they are turned. from_message: a frame_id that ends in _frd or _flu says so, else the message type does.",
        choices=(FROM_MESSAGE, FLU, FRD),
    )
    dvl_type: str = _parameter(
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "Message type of the DVL's topic, live (a bag says its types itself).",
    )
    dvl_fields: str = _parameter(
        "",
        "Fields of DVL messages whose type is not listed: velocity=vel.x,vel.y,vel.z,valid=lock; a vector or three "
        "fields, or beams=list,direction,velocity; also variance, stamp, frame. Axes as dvl_axes says.",
    )
    gnss_type: str = _parameter(
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "Message type of the reference's topic, live.",
    )
    position_window: float = _parameter(
        1.0,
        "Time over which two satellite positions are differenced where the reference is positions alone "
        "(sensor_msgs/msg/NavSatFix). Longer: less noise, less true in turns.",
        unit="s",
        low=0.1,
        high=30.0,
    )
    mounting_rpy: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Nominal orientation of the DVL in the body, as in a URDF origin (fixed axes X, Y, Z).",
        unit="rad",
        low=-2 * math.pi,
        high=2 * math.pi,
    )
    lever_arm: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Position of the DVL relative to the reference point, body frame; compensated while the "
        "angular velocity is known.",
        unit="m",
        low=-100.0,
        high=100.0,
    )
    reference_position: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Position in base_frame of the reference point (antenna, INS): added to the lever arm, it is the DVL's.",
        unit="m",
        low=-100.0,
        high=100.0,
    )
    dvl_position: str = _parameter(
        UNKNOWN,
        "How the DVL's position in base_frame is known. from_reference: reference_position plus the lever arm that is "
        "found; told: the same with the lever_arm that is given; unknown: "
        "no position is written to URDF, TF or launch files.",
        choices=(UNKNOWN, TOLD, FROM_REFERENCE),
    )
    imu_rpy: tuple[float, ...] = _parameter(
        (0.0, 0.0, 0.0),
        "Orientation in the body of the axes of the IMU's data, as in a URDF origin (fixed axes X, Y, "
        "Z). Forward-right-down in a level vehicle is pi 0 0.",
        unit="rad",
        low=-2 * math.pi,
        high=2 * math.pi,
    )
    imu_frame: str = _parameter(
        IMU_ENU,
        "What the IMU's orientation is relative to: enu (yaw 0 is east, REP-103), ned (yaw 0 is north, clockwise) or "
        "nwu (yaw 0 is north, counter-clockwise).",
        choices=(IMU_ENU, IMU_NED, NWU),
    )
    restamp: str = _parameter(
        "",
        "Whose stamps are not believed: log takes the time at which each message was recorded (live: received); names "
        "of topics, with commas between, do so for these topics of a recording alone.",
    )
    dvl_time_offset: float = _parameter(
        0.0,
        "Positive: DVL stamps are late. Taken off before pairing.",
        unit="s",
        low=-60.0,
        high=60.0,
    )
    reference_time_offset: float = _parameter(
        0.0,
        "Positive: reference (GNSS) stamps are late. Taken off before pairing.",
        unit="s",
        low=-60.0,
        high=60.0,
    )
    reference_velocity_offset: tuple[float, ...] = _parameter(
        (0.0, 0.0),
        "Constant error (east, north) of a reference velocity in ENU or NED: of an inertial navigation that drifts, "
        "or a current where the DVL tracks water. Taken off.",
        unit="m/s",
        low=-5.0,
        high=5.0,
    )
    imu_time_offset: float = _parameter(
        0.0,
        "Positive: IMU stamps (attitude and angular velocity) are late. Taken off before pairing.",
        unit="s",
        low=-60.0,
        high=60.0,
    )
    dvl_clock_drift: float = _parameter(
        0.0,
        "By how much DVL stamps get later per second since the first (the DVL's clock runs fast). Taken off.",
        unit="s/s",
        low=-0.01,
        high=0.01,
    )
    dvl_time_jump: float = _parameter(
        0.0,
        "By how much DVL stamps are later from dvl_time_jump_at on, in addition. Taken off.",
        unit="s",
        low=-10.0,
        high=10.0,
    )
    dvl_time_jump_at: float = _parameter(
        0.0,
        "DVL stamp (s since 1970) at which dvl_time_jump begins.",
        unit="s",
        low=0.0,
        high=2.0**31,
    )
    initial_std_misalignment: float = _parameter(
        0.05,
        "Prior standard deviation of each misalignment angle.",
        unit="rad",
        low=1e-6,
        high=1.0,
    )
    initial_std_scale: float = _parameter(
        0.006,
        "Prior standard deviation of the scale-factor error.",
        low=1e-7,
        high=0.5,
    )
    initial_std_lever_arm: float = _parameter(
        2.0,
        "Prior standard deviation of each component of the lever arm about lever_arm (full). One that is given counts "
        "as measured to 0.05 m, or with a probability of 0.1 as wrong by this.",
        unit="m",
        low=1e-4,
        high=100.0,
    )
    initial_std_time_offset: float = _parameter(
        1.0,
        "Prior standard deviation of the DVL's time offset about dvl_time_offset (full, which looks within 3.2 s).",
        unit="s",
        low=1e-4,
        high=10.0,
    )
    process_std_misalignment: float = _parameter(
        0.0,
        "Random walk of each misalignment angle.",
        unit="rad/√s",
        low=0.0,
        high=0.1,
    )
    process_std_scale: float = _parameter(
        0.0,
        "Random walk of the scale-factor error.",
        unit="1/√s",
        low=0.0,
        high=0.1,
    )
    use_message_covariance: bool = _parameter(
        True,
        "R of the GNSS models from the messages' covariances (rotated, added) where given. Without, samples whose "
        "variances are 1000 (m/s)² and more on all axes are used, which are invalid else.",
    )
    gnss_aided_std: float = _parameter(
        0.2,
        "Standard deviation per axis of R of the GNSS models where the reference gives no covariance.",
        unit="m/s",
        low=1e-4,
        high=10.0,
    )
    gnss_free_std: float = _parameter(
        0.025,
        "Standard deviation per axis of R of the GNSS-free models; stands in for a DVL covariance that is not given.",
        unit="m/s",
        low=1e-4,
        high=10.0,
    )
    motion_std: float = _parameter(
        ASSUMPTIONS.motion_std,
        "Standard deviation of sway and heave about what is modelled, straight ahead: the noise of A1 and F1.",
        unit="m/s",
        low=1e-4,
        high=10.0,
    )
    motion_correlation_time: float = _parameter(
        ASSUMPTIONS.motion_correlation_time,
        "Correlation time of sway and heave: samples closer together weigh less (A1, F1). 0: all weigh the same.",
        unit="s",
        low=0.0,
        high=600.0,
    )
    heave_offset_std: float = _parameter(
        ASSUMPTIONS.heave_offset_std,
        "Prior standard deviation of a constant heave, such as of trim (A1, F1).",
        unit="m/s",
        low=1e-6,
        high=10.0,
    )
    reference_offset_std: float = _parameter(
        0.005,
        "Prior standard deviation, east, north and up, of a constant error of a reference velocity in an earth frame, "
        "as of an inertial navigation (full). Several headings find the error.",
        unit="m/s",
        low=1e-6,
        high=10.0,
    )
    heading_deviation_std: float = _parameter(
        math.radians(0.5),
        "Prior standard deviation of the heading's error with the course (one and two cycles, as of a compass). On one "
        "heading the σ of yaw includes it; several headings show its true size. 0: the heading is exact.",
        unit="rad",
        low=0.0,
        high=0.5,
    )
    dvl_bias_std: float = _parameter(
        0.008,
        "Prior standard deviation of a constant error of the DVL's velocity, along each of its axes (full). At one "
        "speed σ of roll, pitch, yaw and scale includes it; several speeds show its size. 0.008: as the beam biases "
        "of the paper's data make it; the worst that is known is under three times that. 0: the DVL has none.",
        unit="m/s",
        low=0.0,
        high=1.0,
    )
    day_std_heading: float = _parameter(
        math.radians(0.1),
        "Constant error of the heading reference on one day: included in the σ of yaw, which is that of the next "
        "recording (0.1°: a fibre-optic gyrocompass; a magnetic compass: 1° and more).",
        unit="rad",
        low=0.0,
        high=0.5,
    )
    day_std_scale: float = _parameter(
        0.003,
        "By how much the scale differs from day to day: included in the σ of scale, which is that of the next "
        "recording (0.3 %: "
        "4.5 m/s of the speed of sound, as of 1.5 °C).",
        low=0.0,
        high=0.5,
    )
    current_std: float = _parameter(
        ASSUMPTIONS.current_std,
        "Prior standard deviation of the current per axis (A1, F1). On one heading it decides how much of the sway "
        "counts as misalignment: half, where it equals speed · initial_std_misalignment.",
        unit="m/s",
        low=1e-6,
        high=10.0,
    )
    prior_source: str = _parameter(
        "fixed",
        "Prior sway and heave of M5 and M6: fixed (prior_sway_heave), initial_window (mean of the DVL's own "
        "first prior_window; then M5 and M6 gain nothing, the mean already holds the misalignment), reference (mean "
        "of the reference velocity's first prior_window; replay only).",
        choices=("fixed", "initial_window", "reference"),
    )
    prior_window: float = _parameter(
        2.0,
        "Length of the window that prior_source averages.",
        unit="s",
        low=0.1,
        high=600.0,
    )
    prior_sway_heave: tuple[float, ...] = _parameter(
        (0.0, 0.0),
        "Sway and heave of prior_source fixed, body frame.",
        unit="m/s",
        low=-10.0,
        high=10.0,
    )
    gate_probability: float = _parameter(
        0.999,
        "Innovation gate: share of good samples that pass (chi-square). 0 or 1: off.",
        low=0.0,
        high=1.0,
    )
    min_speed: float = _parameter(
        0.3,
        "Slower samples are not used. 0: off.",
        unit="m/s",
        low=0.0,
        high=10.0,
    )
    max_turn_rate: float = _parameter(
        0.0,
        "Samples at a higher angular velocity are not used, nor are samples without one. 0: off.",
        unit="rad/s",
        low=0.0,
        high=10.0,
    )
    max_repeats: float = _parameter(
        0.0,
        "How often in a row a DVL velocity may repeat exactly; further repeats mean that the driver hangs, and are "
        "not used. 0: off (a simulated DVL without noise repeats itself).",
        low=0.0,
        high=1e6,
        read_only=False,
    )
    max_speed: float = _parameter(
        10.0,
        "A DVL or reference velocity above this is invalid.",
        unit="m/s",
        low=0.1,
        high=100.0,
    )
    max_fom: float = _parameter(
        0.4,
        "A DVL message with a figure of merit above this is invalid (dvl_msgs/DVL, which has one).",
        unit="m/s",
        low=0.0,
        high=100.0,
    )
    imu_timeout: float = _parameter(
        1.5,
        "Longest gap between two IMU samples that is interpolated across.",
        unit="s",
        low=0.01,
        high=60.0,
    )
    max_latency: float = _parameter(
        1.0,
        "By how much (in stamps) one topic may lag another before a DVL sample goes on without its partner. When "
        "a bag is played faster than recorded, raise it in proportion.",
        unit="s",
        low=0.0,
        high=600.0,
    )
    max_time_jump: float = _parameter(
        10.0,
        "A step between stamps above this needs a second sample to be believed; back in time it is a restart "
        "(bag loop) and the calibration starts anew.",
        unit="s",
        low=0.1,
        high=86400.0,
    )
    new_day_after: float = _parameter(
        3600.0,
        "Pause of the DVL after which it is another day: the delay of its stamps, a constant error of the reference "
        "and the current, which belong to the day, are found anew. Recordings replayed together are a day each.",
        unit="s",
        low=15.0,
        high=1e9,
    )
    fine_std_misalignment: float = _parameter(
        0.0017453292519943296,
        "Convergence is fine once every observable angle's standard deviation is below this (0.1°) ...",
        unit="rad",
        low=1e-6,
        high=1.0,
        read_only=False,
    )
    fine_std_scale: float = _parameter(
        0.001,
        "... and the scale's below this.",
        low=1e-7,
        high=0.5,
        read_only=False,
    )
    discover: bool = _parameter(
        True,
        "Look for DVL, reference and IMU among all topics, as replay does, while nobody publishes the DVL's topic and "
        "that was not remapped.",
    )
    target_drift: float = _parameter(
        2.0,
        "Drift of dead reckoning, predicted for a straight leg, from which on the live view says that the calibration "
        "is good enough.",
        unit="m/km",
        low=0.01,
        high=1000.0,
        read_only=False,
    )
    verification_block: float = _parameter(
        10.0,
        "Length of the blocks that hold-out verification deals out to its folds.",
        unit="s",
        low=0.1,
        high=3600.0,
    )
    accept_misalignment: float = _parameter(
        math.radians(2.0),
        "A calibration with a misalignment below this (2°) may be accepted; above it is marginal ...",
        unit="rad",
        low=0.0,
        high=math.pi,
    )
    reject_misalignment: float = _parameter(
        math.radians(5.0),
        "... and from this (5°) on rejected.",
        unit="rad",
        low=0.0,
        high=math.pi,
    )
    max_scale_error: float = _parameter(
        0.05,
        "A calibration with a scale-factor error above this is rejected.",
        low=0.0,
        high=1.0,
    )
    max_error_ratio: float = _parameter(
        1.0,
        "A held-out velocity error above so many times the predicted one (and beyond chance) makes it marginal.",
        low=0.1,
        high=100.0,
    )
    result_file: str = _parameter(
        "",
        "Result file (YAML) written by ~/save and at shutdown. Empty: none. At run time only another .yaml file in the "
        "same folder (the working directory, if none was named at the start).",
        read_only=False,
    )
    result_backups: float = _parameter(
        3.0,
        "How many earlier results are kept beside result_file: .bak is the last one, .bak.2 and on are the best "
        "converged of the others.",
        low=1.0,
        high=100.0,
        read_only=False,
    )
    initial_calibration: str = _parameter(
        "", "Result file whose states and covariances are the prior. Empty: none.",
    )  # fmt: skip

    def __post_init__(self) -> None:
        for name, spec in SCHEMA.items():
            object.__setattr__(self, name, spec.check(name, getattr(self, name)))

    @staticmethod
    def from_mapping(values: Mapping[str, Any]) -> Parameters:
        """Parameters with these values, the rest at their defaults. ParameterError names what is unknown or wrong."""
        check_names(values)
        return Parameters(**values)

    def replace(self, **values: Any) -> Parameters:
        """A copy with these values, checked."""
        check_names(values)
        return dataclasses.replace(self, **values)

    def as_dict(self) -> dict[str, Any]:
        """Name -> value with arrays as lists, for YAML and JSON."""
        return {name: list(value) if isinstance(value := getattr(self, name), tuple) else value for name in SCHEMA}

    @property
    def is_z_down(self) -> bool:
        """Whether base_frame is forward-right-down."""
        return self.base_axes == FRD

    @property
    def body_axes(self) -> tuple[str, str, str]:
        """Which way x, y and z of base_frame point, in words."""
        return ("ahead", "to starboard", "down") if self.is_z_down else ("ahead", "to port", "up")

    @property
    def up(self) -> float:
        """The vertical, upwards, along z of base_frame: 1 or, z down, -1."""
        return -1.0 if self.is_z_down else 1.0

    @cached_property
    def rotation_dvl_from_body(self) -> Array:
        """T (3, 3), from mounting_rpy."""
        return rotation_from_rpy(self.mounting_rpy).T


SCHEMA: Mapping[str, ParameterSpec] = {field.name: field.metadata["spec"] for field in dataclasses.fields(Parameters)}


def check_names(names: Mapping[str, Any]) -> None:
    """Raise ParameterError for a name that is not a parameter, with the nearest one that is."""
    for name in names:
        if name not in SCHEMA:
            near = difflib.get_close_matches(str(name), SCHEMA, n=1)
            hint = f", did you mean {near[0]!r}?" if near else f"; there are {', '.join(SCHEMA)}"
            raise ParameterError(f"{name}: no such parameter{hint}")
