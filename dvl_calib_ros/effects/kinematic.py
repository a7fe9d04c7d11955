"""Effects of the vehicle's motion: position of the DVL, sideslip, tilt."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..calibration.numerics.frames import Array, cross
from .base import ActsOn, Effect, EffectInput, EffectNeeds, EffectParameter, along_axes, vector


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
        EffectParameter(
            "coefficient_s",
            "s",
            0.1,
            -10.0,
            10.0,
            "sway per turn rate and speed; negative: outward",
            said="coefficient",
        ),
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
        EffectParameter(
            "x_per_pitch", "m/s/rad", 0.5, -20.0, 20.0, "surge error per pitch (positive: bow down)", said="x per pitch"
        ),
        EffectParameter("z_per_pitch", "m/s/rad", 0.5, -20.0, 20.0, "heave error per pitch", said="z per pitch"),
        EffectParameter(
            "y_per_roll", "m/s/rad", 0.5, -20.0, 20.0, "sway error per roll (positive: port side up)", said="y per roll"
        ),
        EffectParameter("z_per_roll", "m/s/rad", 0.5, -20.0, 20.0, "heave error per roll", said="z per roll"),
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
