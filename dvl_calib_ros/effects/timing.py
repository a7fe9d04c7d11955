"""Effects of time: stamps with a delay, step or drift; a filtered reference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import VelocityFrame
from ..calibration.registration.delay_search import FARTHEST_S
from .base import (
    ActsOn,
    ClockEffect,
    EffectInput,
    EffectNeeds,
    EffectParameter,
    EffectWithMemory,
    recursion,
    slopes,
    within,
)

# search range of the clock registration
LONGEST_OFFSET_S = FARTHEST_S


def _seconds(what: str) -> tuple[EffectParameter]:
    return (within("seconds", "s", 0.1, LONGEST_OFFSET_S, what, "", linear=False),)


class _DvlClock(ClockEffect):
    acts_on = ActsOn.DVL_CLOCK

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return v(t - late) - v(t), body frame."""
        delay = self.late(motion.elapsed, values)
        return delayed(motion.time, motion.velocity_body, delay) - motion.velocity_body


class DvlTimeOffset(_DvlClock):
    """The DVL's stamps are delayed: a sample stamped t was measured earlier."""

    name = "dvl_time_offset"
    summary = "the DVL's stamps have a delay of τ: v(t - τ) - v(t), body frame"
    remedy = "--apply writes dvl_time_offset; better, set the DVL's clock (PTP, or the time of validity in the driver)"
    manoeuvre = "straight legs that speed up and slow down, in waves or with quick changes of speed"
    parameters = _seconds("delay of the stamps")
    confounded_with = ("reference_time_offset", "reference_lag", "attitude_time_offset")


class TimeOffsetJump(_DvlClock):
    """The DVL's clock is set once or twice: from then on its stamps are later (or earlier)."""

    name = "time_offset_jump"
    summary = "the DVL's stamps are later by τ from at_s on, as after its clock was set; by more from again_at_s on"
    remedy = "--apply writes dvl_time_jump for a single jump; do not let the DVL's clock be set during a run"
    manoeuvre = "turns and changes of speed before and after"
    parameters = (
        *_seconds("how much later a stamp is from then on"),
        EffectParameter("at_s", "s", 0.0, 0.0, np.inf, "when, since the start", linear=False, said="at"),
        replace(
            *_seconds("how much later still from a second time on"), name="again_seconds", typical=0.2, said="again"
        ),
        EffectParameter(
            "again_at_s", "s", 0.0, 0.0, np.inf, "when that is, since the start", np.inf, linear=False, said="at"
        ),
    )
    again: ClassVar[Mapping[str, str]] = {"again_seconds": "seconds", "again_at_s": "at_s"}
    confounded_with = ("dvl_time_offset", "clock_drift")

    def late(self, elapsed: Array, values: Mapping[str, float]) -> Array:
        """Return τ from at_s on, and more from again_at_s on."""
        first = np.where(elapsed >= values["at_s"], values["seconds"], 0.0)
        return first + np.where(elapsed >= values["again_at_s"], values["again_seconds"], 0.0)


class ClockDrift(_DvlClock):
    """The DVL's clock runs fast (or slow)."""

    name = "clock_drift"
    summary = "the DVL's clock runs fast: its stamps get later by seconds_per_hour"
    remedy = "--apply writes dvl_clock_drift; better, discipline the DVL's clock (PTP, PPS)"
    manoeuvre = "turns and changes of speed at the beginning, in the middle and at the end"
    parameters = (within("seconds_per_hour", "s/h", 1.0, 36.0, "how much later stamps get", "", linear=False),)
    confounded_with = ("dvl_time_offset", "time_offset_jump")

    def late(self, elapsed: Array, values: Mapping[str, float]) -> Array:
        """Return rate · (t - t_0)."""
        return values["seconds_per_hour"] / 3600.0 * elapsed


class ReferenceTimeOffset(ClockEffect):
    """The reference's stamps are delayed; if recorded in ENU, it is then rotated by a later attitude."""

    name = "reference_time_offset"
    summary = "the reference's stamps have a delay of τ: -(g(t - τ) - g(t)), in the frame it was recorded in"
    remedy = "--apply writes reference_time_offset; better, stamp the reference when it measures"
    manoeuvre = "turns to both sides at two speeds, and straight legs that speed up and slow down"
    parameters = _seconds("delay of the stamps")
    acts_on = ActsOn.REFERENCE_CLOCK
    confounded_with = ("dvl_time_offset", "reference_lag", "attitude_time_offset", "sideslip", "lever_arm")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return g(t) - g(t - τ) of the reference velocity g in its recorded frame, rotated to the body."""
        reference = _in_reference_frame(motion, motion.velocity_body)
        delay = self.late(motion.elapsed, values)
        return _in_body(motion, reference - delayed(motion.time, reference, delay))


class AttitudeTimeOffset(ClockEffect):
    """The stamps of attitude and angular velocity are delayed, so an earth-frame reference is rotated wrongly."""

    name = "attitude_time_offset"
    summary = "the IMU's stamps have a delay of τ: v - R(t - τ)ᵀ R(t) v, with R its attitude"
    remedy = "--apply writes imu_time_offset; better, stamp the IMU when it measures"
    manoeuvre = "turns to both sides at two speeds, and straight legs that speed up and slow down"
    parameters = _seconds("delay of the stamps")
    acts_on = ActsOn.ATTITUDE_CLOCK
    needs = frozenset({EffectNeeds.ATTITUDE})
    confounded_with = ("dvl_time_offset", "reference_time_offset", "sideslip", "lever_arm")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return v - R(t - τ)ᵀ R(t) v; a body-frame reference needs no attitude, except for a lever arm."""
        attitude, delay = motion.attitude, self.late(motion.elapsed, values)
        if motion.reference_frame is VelocityFrame.BODY or len(motion.time) < 2 or not delay.any():
            return np.zeros_like(motion.velocity_body)
        at = np.clip(motion.time - delay, motion.time[0], motion.time[-1])
        then = Slerp(motion.time, Rotation.from_matrix(attitude))(at).as_matrix()
        earth = np.einsum("nij,nj->ni", attitude, motion.velocity_body)
        return motion.velocity_body - np.einsum("nji,nj->ni", then, earth)


class ReferenceLag(EffectWithMemory):
    """The receiver filters its velocity: a first-order low-pass, in the frame in which it was recorded."""

    name = "reference_lag"
    summary = "the reference is low-pass filtered: T dg'/dt = g - g', in the frame it was recorded in"
    remedy = "take the receiver's own velocity as reference, not a filter's"
    manoeuvre = "sharp turns as well as wide ones, and quick changes of speed"
    parameters = (
        EffectParameter(
            "time_constant_s", "s", 0.2, 0.0, 5.0, "time constant of the filter", linear=False, said="time constant"
        ),
    )
    acts_on = ActsOn.REFERENCE
    confounded_with = ("reference_time_offset", "dvl_time_offset", "sideslip", "lever_arm")

    def filtered(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return g - (g filtered), rotated to the body."""
        reference = _in_reference_frame(motion, velocity)
        error = lag_error(motion.time, reference.reshape(len(reference), -1), values["time_constant_s"])
        return _in_body(motion, -error.reshape(reference.shape))

    def of_before(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return the exponential decay of the filter's unknown state at the first sample."""
        constant = values["time_constant_s"]
        if constant <= 0.0:
            return np.zeros_like(velocity)
        return _in_body(motion, _decaying_part(motion.time, _in_reference_frame(motion, velocity), constant))

    def follows(self, motion: EffectInput, velocity: Array, values: Mapping[str, float]) -> Array:
        """Return `EffectWithMemory.follows`, with one rotation to the reference's frame and back for speed."""
        reference, constant = _in_reference_frame(motion, velocity), values["time_constant_s"]
        if constant <= 0.0:
            return velocity
        error = lag_error(motion.time, reference.reshape(len(reference), -1), constant)
        error += reference.reshape(error.shape)
        error -= _decaying_part(motion.time, error, constant)
        return _in_body(motion, error.reshape(reference.shape))


def _decaying_part(time: Array, values: Array, time_constant: float) -> Array:
    """Return the part of values (N, ...) at times (N,) s that decays from the first with a time constant, s."""
    decay = np.exp((time[0] - time) / time_constant)
    return np.multiply.outer(decay, np.tensordot(decay, values, axes=1) / (decay @ decay))


def delayed(time: Array, values: Array, delay: float | Array) -> Array:
    """Return `values` (N, 3) at times earlier by `delay` s (one or (N,)); outside the range the nearest value.

    Cubic interpolation: a linear one would reduce the crests of waves sampled at 1 Hz by a seventh.
    """
    if not np.any(delay) or len(time) < 2:
        return values
    curve = CubicHermiteSpline(time, values, slopes(time, values))
    return np.asarray(curve(np.clip(time - delay, time[0], time[-1])))


def lag_error(time: Array, values: Array, time_constant: float) -> Array:
    """Return the first-order low-pass of `values` (N, k) minus `values`, exact for piecewise linear slopes.

    With e = output - input, de/dt = -e / T - slope. If the slope goes from s_0 to s_1 within a step of h, one solution
    is p(t) = T² (s_1 - s_0) / h - T slope(t), so e_n = exp(-h / T) (e_(n-1) - p_(n-1)) + p_n. The filter starts with
    the first value.
    """
    if time_constant <= 0.0 or len(time) < 2:
        return np.zeros_like(values)
    steps, slope = np.diff(time), slopes(time, values)
    decay = np.concatenate([[0.0], np.exp(-steps / time_constant)])
    bend = np.diff(slope, axis=0) * (time_constant**2 / steps)[:, None]
    slope *= time_constant
    added = np.zeros_like(values)
    added[1:] = bend - slope[1:] - decay[1:, None] * (bend - slope[:-1])
    return recursion(decay, added)


def _is_rotated(motion: EffectInput) -> bool:
    return motion.reference_frame is not VelocityFrame.BODY and motion.rotation_enu_from_body is not None


def _in_reference_frame(motion: EffectInput, velocity: Array) -> Array:
    """Rotate (N, 3) or (N, 3, p) from the body to the reference's frame."""
    return _turned(motion.attitude, velocity) if _is_rotated(motion) else velocity


def _in_body(motion: EffectInput, velocity: Array) -> Array:
    return _turned(np.swapaxes(motion.attitude, 1, 2), velocity) if _is_rotated(motion) else velocity


def _turned(rotation: Array, velocity: Array) -> Array:
    """Rotate (N, 3) or (N, 3, p), each by its own (N, 3, 3)."""
    if velocity.ndim == 2:
        return np.einsum("nij,nj->ni", rotation, velocity)
    return np.asarray(rotation @ velocity)  # for several columns five times faster
