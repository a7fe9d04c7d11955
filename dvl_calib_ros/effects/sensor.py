"""Effects of the DVL, of its mounting and of the vehicle's motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration.numerics.frames import Array, cross
from .base import (
    HOUR_S,
    ActsOn,
    Effect,
    EffectInput,
    EffectNeeds,
    EffectParameter,
    MountingEffect,
    along_axes,
    vector,
    within,
)


class VelocityBias(Effect):
    """A constant velocity on the DVL's axes, for example by beam biases."""

    name = "velocity_bias"
    summary = "a constant velocity added on the DVL's axes"
    remedy = "let the DVL measure standing still over the bottom; a bias there is the maker's to mend"
    manoeuvre = "straight legs at two speeds or more, one of them slow"
    parameters = along_axes("mps", "m/s", 0.02, 1.0, "bias of the DVL's axis {}")
    acts_on = ActsOn.DVL
    of_velocity = False
    confounded_with = ("quadratic_scale", "mount_flexure", "water_lock")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return Tᵀ b."""
        bias = motion.rotation_dvl_from_body.T @ vector(values, "mps")
        return np.broadcast_to(bias, motion.velocity_body.shape).copy()


class QuadraticScale(Effect):
    """A scale-factor error that grows with speed."""

    name = "quadratic_scale"
    summary = "an error that grows with speed squared: coefficient · ‖v‖ · v"
    remedy = "ask the DVL's maker; drive the survey at the speed that was calibrated"
    manoeuvre = "straight legs at three speeds or more"
    parameters = (
        within("coefficient_s_per_m", "s/m", 0.005, 0.2, "scale-factor error per m/s of speed", "coefficient"),
    )
    acts_on = ActsOn.DVL
    confounded_with = ("velocity_bias",)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return coefficient · speed · v."""
        return values["coefficient_s_per_m"] * motion.speed[:, None] * motion.velocity_body


class ScaleDrift(Effect):
    """A scale-factor error that changes along the run, as the speed of sound does."""

    name = "scale_drift"
    summary = "the scale-factor error changes along the run, as of sound speed: rate · (t - start) · v"
    remedy = "measure the speed of sound along the run, or give the DVL temperature and salinity"
    manoeuvre = "the same straight leg at the beginning, in the middle and at the end"
    parameters = (within("rate_per_hour", "1/h", 0.03, 2.0, "change of the scale-factor error per hour", "rate"),)
    per_recording = True
    acts_on = ActsOn.DVL
    confounded_with = ("misalignment_drift", "sound_speed_layer")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return rate · (t - t_0) · v."""
        return values["rate_per_hour"] / HOUR_S * motion.elapsed[:, None] * motion.velocity_body


class SoundSpeedLayer(Effect):
    """A scale-factor error that changes with depth, because the speed of sound does."""

    name = "sound_speed_layer"
    summary = "the scale-factor error changes with depth, as sound speed does in layers: ratio · (depth - start) · v"
    remedy = "let the DVL compute the speed of sound at its depth, from temperature and salinity"
    manoeuvre = "the same straight leg at three depths, the first one again at the end"
    parameters = (within("ratio_per_m", "1/m", 0.0005, 0.05, "scale-factor error per metre below the start", ""),)
    acts_on = ActsOn.DVL
    needs = frozenset({EffectNeeds.DEPTH})
    confounded_with = ("scale_drift",)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return ratio · (depth - start) · v."""
        return values["ratio_per_m"] * motion.depth[:, None] * motion.velocity_body


class MisalignmentDrift(MountingEffect):
    """Slow rotation of the mounting along the run."""

    name = "misalignment_drift"
    summary = "the misalignment changes along the run: φ = rate · (t - start)"
    remedy = "look for what works loose; calibrate again before each dive"
    manoeuvre = "the same straight leg at the beginning, in the middle and at the end"
    parameters = along_axes(
        "rad_per_hour", "rad/h", 0.05, 2.0, "change of φ about the DVL's axis {} per hour", linear=False
    )
    per_recording = True
    confounded_with = ("scale_drift",)

    def turn(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return (t - t_0) · rate."""
        return motion.elapsed[:, None] * vector(values, "rad_per_hour") / HOUR_S


class MountFlexure(MountingEffect):
    """Bending of the mounting by the water: misalignment that depends on speed."""

    name = "mount_flexure"
    summary = "the mounting bends with speed: φ = flexure · ‖v‖"
    remedy = "stiffen the DVL's bracket; calibrate at the speed of the survey"
    manoeuvre = "straight legs at three speeds or more"
    parameters = along_axes(
        "rad_per_mps", "rad/(m/s)", 0.005, 0.2, "φ about the DVL's axis {} per m/s of speed", linear=False
    )
    confounded_with = ("velocity_bias", "quadratic_scale")

    def turn(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return speed · flexure."""
        return motion.speed[:, None] * vector(values, "rad_per_mps")


class MountingMoved(MountingEffect):
    """A mounting that differs from the one in the first of several recordings."""

    name = "mounting_moved"
    summary = "the mounting differs from the first of several recordings"
    remedy = "the DVL has been moved between the recordings: calibrate each day by itself"
    manoeuvre = "straight legs that speed up and slow down, in each recording"
    parameters = along_axes("rad", "rad", 0.02, 1.5, "change of φ about the DVL's axis {}", linear=False)
    per_recording = True
    relative_to_first = True

    def turn(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return the change of φ."""
        return vector(values, "rad")


class SoundSpeedMoved(Effect):
    """A speed-of-sound error that differs from the one in the first of several recordings."""

    name = "sound_speed_moved"
    summary = "the scale-factor error differs from the first of several recordings: ratio · v"
    remedy = "set the speed of sound on each day"
    manoeuvre = "straight legs, in each recording"
    parameters = (EffectParameter("ratio", "1", 0.005, -0.2, 0.2, "change of the scale-factor error"),)
    acts_on = ActsOn.DVL
    per_recording = True
    relative_to_first = True

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return ratio · v."""
        return values["ratio"] * motion.velocity_body


_SHEAR = "half of the difference between 90° and the angle of {} and {}"


class AxisNonorthogonality(Effect):
    """Axes that are not orthogonal, for example by wrong beam directions.

    This is the symmetric part; the skew part is misalignment. On a straight leg the two look the same.
    """

    name = "axis_nonorthogonality"
    summary = "the DVL's axes are not at right angles: symmetric shear S v, DVL frame"
    remedy = "ask the DVL's maker: its beam directions differ from the specification"
    manoeuvre = "sway and heave in addition to surge: drift across, dive or drive in waves"
    parameters = tuple(
        within(f"{a}{b}_rad", "rad", 0.01, 0.3, _SHEAR.format(a, b), f"{a}{b}") for a, b in ("xy", "xz", "yz")
    )
    acts_on = ActsOn.DVL
    confounded_with = ("sideslip", "lever_arm")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return Tᵀ S T v with S symmetric and a zero diagonal."""
        xy, xz, yz = (values[parameter.name] for parameter in self.parameters)
        shear = np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
        return motion.velocity_dvl @ shear @ motion.rotation_dvl_from_body


class LeverArm(Effect):
    """Velocity ω×l, because the DVL is not at the reference velocity's point."""

    name = "lever_arm"
    summary = "the DVL sits at l from the reference point and moves when the vehicle turns: ω × l"
    remedy = "--apply writes the lever arm; measure it with a tape to be sure"
    manoeuvre = "turns to both sides at two speeds, and straight legs that speed up and slow down"
    parameters = along_axes("m", "m", 0.3, 20.0, "position of the DVL relative to the reference point, body axis {}")
    acts_on = ActsOn.MOTION
    needs = frozenset({EffectNeeds.ANGULAR_VELOCITY})
    of_velocity = False
    confounded_with = ("sideslip", "reference_time_offset", "reference_lag")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return ω × l."""
        return cross(motion.turn_rate, vector(values, "m"))


class Sideslip(Effect):
    """Sway in a turn that the DVL measures and the reference does not, for example one derived from course."""

    name = "sideslip"
    summary = "sway that only the DVL sees: coefficient · ω_z · horizontal speed"
    remedy = (
        "the DVL sees another sway than the reference: look for what moves the water at it (thrusters, its fairing)"
    )
    manoeuvre = "turns to both sides at two speeds (a lever arm does not grow with speed)"
    parameters = (
        within("coefficient_s", "s", 0.1, 10.0, "sway per turn rate and speed; negative: outward", "coefficient"),
    )
    acts_on = ActsOn.MOTION
    needs = frozenset({EffectNeeds.ANGULAR_VELOCITY})
    confounded_with = ("lever_arm", "reference_time_offset", "reference_lag")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return (0, coefficient · ω_z · speed, 0)."""
        sway = values["coefficient_s"] * motion.turn_rate[:, 2] * np.hypot(*motion.velocity_body[:, :2].T)
        return sway[:, None] * [0.0, 1.0, 0.0]


class TiltCoupling(Effect):
    """Velocity error proportional to the tilt of the vehicle."""

    name = "tilt_coupling"
    summary = "an error in proportion to pitch or roll, body frame"
    remedy = "the velocity of DVL or reference is not rotated by the vehicle's roll and pitch: check the driver's frame"
    manoeuvre = "straight legs in waves, or with pitch and roll held at several angles"
    parameters = (
        within("x_per_pitch", "m/s/rad", 0.5, 20.0, "surge error per pitch (positive: bow down)", "x per pitch"),
        within("z_per_pitch", "m/s/rad", 0.5, 20.0, "heave error per pitch", "z per pitch"),
        within("y_per_roll", "m/s/rad", 0.5, 20.0, "sway error per roll (positive: port side up)", "y per roll"),
        within("z_per_roll", "m/s/rad", 0.5, 20.0, "heave error per roll", "z per roll"),
    )
    acts_on = ActsOn.DVL
    of_velocity = False
    needs = frozenset({EffectNeeds.ATTITUDE})
    confounded_with = ("velocity_bias", "lever_arm")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return gains (3, 2) times pitch and roll."""
        rotation = motion.attitude
        pitch = -np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0))
        roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
        gains = [
            [values["x_per_pitch"], 0.0],
            [0.0, values["y_per_roll"]],
            [values["z_per_pitch"], values["z_per_roll"]],
        ]
        return np.column_stack([pitch, roll]) @ np.transpose(gains)
