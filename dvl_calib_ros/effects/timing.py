"""Effects of time: stamps that are late, a reference that is filtered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ..calibration.frames import Array
from ..calibration.samples import VelocityFrame
from .base import ActsOn, Effect, EffectInput, ParameterSpec


class DvlTimeOffset(Effect):
    """The DVL's stamps are late: what is stamped t was measured before."""

    name = "dvl_time_offset"
    summary = "the DVL's stamps are late by τ: v(t - τ) - v(t), body frame"
    manoeuvre = "straight legs that speed up and slow down, in waves or with quick changes of speed"
    parameters = (ParameterSpec("seconds", "s", 0.1, -2.0, 2.0, "how late a stamp is; positive: late", linear=False),)
    acts_on = ActsOn.MOTION
    confounded_with = ("reference_time_offset", "reference_lag")

    def delay(self, values: Mapping[str, float]) -> float:
        """τ."""
        return values["seconds"]

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """v(t - τ) - v(t), body frame."""
        return delayed(motion.time, motion.velocity_body, values["seconds"]) - motion.velocity_body


class ReferenceTimeOffset(Effect):
    """The reference's stamps are late. Recorded in ENU it then is turned by an attitude that is too new."""

    name = "reference_time_offset"
    summary = "the reference's stamps are late by τ: -(g(t - τ) - g(t)), in the frame it was recorded in"
    manoeuvre = "turns to both sides at two speeds, and straight legs that speed up and slow down"
    parameters = DvlTimeOffset.parameters
    acts_on = ActsOn.REFERENCE
    confounded_with = ("dvl_time_offset", "reference_lag", "sideslip", "lever_arm")

    def delay(self, values: Mapping[str, float]) -> float:
        """τ."""
        return values["seconds"]

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """g(t) - g(t - τ), in the frame in which the reference was recorded, turned into the body."""
        reference = _in_reference_frame(motion)
        return _in_body(motion, reference - delayed(motion.time, reference, values["seconds"]))


class ReferenceLag(Effect):
    """The receiver filters its velocity: a first-order low-pass, in the frame in which it was recorded."""

    name = "reference_lag"
    summary = "the reference is low-pass filtered: T dg'/dt = g - g', in the frame it was recorded in"
    manoeuvre = "sharp turns as well as wide ones, and quick changes of speed"
    parameters = (ParameterSpec("time_constant_s", "s", 0.2, 0.0, 5.0, "time constant of the filter", linear=False),)
    acts_on = ActsOn.REFERENCE
    confounded_with = ("reference_time_offset", "dvl_time_offset", "sideslip", "lever_arm")

    def delay(self, values: Mapping[str, float]) -> float:
        """T: what is slow comes so much later."""
        return values["time_constant_s"]

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """g - (g filtered), turned into the body."""
        reference = _in_reference_frame(motion)
        return _in_body(motion, -lag_error(motion.time, reference, values["time_constant_s"]))


def delayed(time: Array, values: Array, delay: float) -> Array:
    """What `values` (N, 3) were `delay` s before; before the first and after the last, as there.

    Cubic between samples: a straight line would cut the crests of waves sampled at 1 Hz by a seventh.
    """
    if delay == 0.0 or len(time) < 2:
        return values
    curve = CubicHermiteSpline(time, values, np.gradient(values, time, axis=0))
    return np.asarray(curve(np.clip(time - delay, time[0], time[-1])))


def lag_error(time: Array, values: Array, time_constant: float) -> Array:
    """First-order low-pass of `values` (N, 3) less `values`: exact where slopes are straight between their times.

    With e = output - input, de/dt = -e / T - slope. Where the slope goes from s_0 to s_1 within a step of h, one
    solution is p(t) = T² (s_1 - s_0) / h - T slope(t), so e_n = exp(-h / T) (e_(n-1) - p_(n-1)) + p_n. The filter
    begins with the first value.
    """
    error = np.zeros_like(values)
    if time_constant <= 0.0 or len(time) < 2:
        return error
    steps = np.diff(time)[:, None]
    decay = np.vstack([[0.0], np.exp(-steps / time_constant)])
    slope = np.gradient(values, time, axis=0)
    bend = time_constant**2 * np.diff(slope, axis=0) / steps
    error[1:] = bend - time_constant * slope[1:] - decay[1:] * (bend - time_constant * slope[:-1])
    # the recursion over any steps, by doubling: each pass adds what came twice as far before
    reach = 1
    while reach < len(time) and decay[reach:].max() > np.finfo(float).eps:
        error[reach:] += decay[reach:] * error[:-reach]
        decay[reach:] = decay[reach:] * decay[:-reach]
        decay[:reach] = 0.0
        reach *= 2
    return error


def _turns(motion: EffectInput) -> bool:
    return motion.reference_frame is not VelocityFrame.BODY and motion.rotation_enu_from_body is not None


def _in_reference_frame(motion: EffectInput) -> Array:
    if not _turns(motion):
        return motion.velocity_body
    return np.einsum("nij,nj->ni", motion.attitude, motion.velocity_body)


def _in_body(motion: EffectInput, velocity: Array) -> Array:
    return np.einsum("nji,nj->ni", motion.attitude, velocity) if _turns(motion) else velocity
