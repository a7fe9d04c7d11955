"""Evaluation of a hypothesis for a recording, and derivatives of the residual.

Shapes: F samples, A compared axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array, skew
from ...effects.base import PASSES, ActsOn, Effect, EffectInput, EffectParameter, EffectWithMemory, Injection, traces
from .hypothesis import Hypothesis, Values, amplitudes
from .stream_curve import Curve


@dataclass(frozen=True)
class Seen:
    """A recording under a hypothesis, at F times. motion: of the reference point. at_dvl: of the DVL. measured: (F, 3)
    m/s smoothed DVL velocity, its frame. error: (F, 3) e, body frame. angles: φ plus rotations of the mounting, rad,
    (3,) or (F, 3). body_from_measured: D⁻¹ with these, (3, 3) or (F, 3, 3). dvl_stamps, reference_stamps: (F,) s of the
    same times. projection: (F, A, 3) or (1, A, 3) from the body frame to the compared axes. change, closely, as_it_is:
    evaluate `rate_of_change`, `close` and `close_unsmoothed`."""

    motion: EffectInput
    at_dvl: EffectInput
    measured: Array
    error: Array
    angles: Array
    body_from_measured: Array
    dvl_stamps: Array
    reference_stamps: Array
    projection: Array
    change: Callable[[], Array] = field(repr=False)
    closely: Callable[[], tuple[Seen, NDArray[np.intp]] | None] = field(repr=False)
    unsmoothed: Callable[[], tuple[EffectInput, NDArray[np.intp]] | None] = field(repr=False)

    @cached_property
    def rate_of_change(self) -> Array:
        """Return (F, 3) m/s² of the DVL velocity, on demand."""
        return self.change()

    @cached_property
    def close(self) -> tuple[Seen, NDArray[np.intp] | slice]:
        """Return the evaluation without memory effects at closely spaced times, and the indices of the own times."""
        return self.closely() or (self, slice(None))

    @cached_property
    def close_unsmoothed(self) -> tuple[EffectInput, NDArray[np.intp] | slice]:
        """Return the unsmoothed motion of `close`: smoothing would remove the variation that a filter acts on."""
        return self.unsmoothed() or (self.motion, slice(None))

    def on_reference(self, injections: Sequence[Injection]) -> Array:
        """Return (F, 3) m/s, traces on REFERENCE, body frame."""
        lagging = [each for each in injections if isinstance(each.effect, EffectWithMemory)]
        if not lagging or self.close_unsmoothed[0] is self.motion:
            return traces(injections, self.motion, ActsOn.REFERENCE)
        close, own = self.close_unsmoothed
        found = traces([each for each in injections if each not in lagging], self.motion, ActsOn.REFERENCE)
        return np.asarray(found + traces(lagging, close, ActsOn.REFERENCE)[own])

    def compared(self, body: Array) -> Array:
        """Project (F, 3) or (F, 3, p) of the body frame on the compared axes."""
        return self.projection @ body if body.ndim > 2 else rotate_vectors(self.projection, body)


def measured_velocity(curve: Curve, at: Array, at_samples: bool) -> tuple[Array, Array]:
    """Return (F, 3) velocity and smoothed velocity."""

    def made() -> tuple[Array, Array]:
        """Return velocity and smoothed velocity, which are the same array for a denoised curve."""
        smooth = curve.smooth
        raw = curve if at_samples else curve.denoised
        smoothed = smooth(at)
        return smoothed if raw is smooth else raw(at), smoothed

    measured: tuple[Array, Array] = curve.kept.at(f"measured, {at_samples}", at, made)
    return measured


def velocity_change(curve: Curve, at: Array) -> Array:
    """Return (F, 3) m/s² of a velocity."""
    clipped = np.clip(at, curve.time[0], curve.time[-1])
    return np.asarray(curve.kept.at("change", at, lambda: curve.derivative(clipped)))


def undo_effects(
    injections: Sequence[Injection], motion: EffectInput, acts_on: ActsOn, turned: Array | None
) -> tuple[EffectInput, Array]:
    """Return the motion before the effects of one stage, and their contribution (F, 3), or (3,) zeros.

    If an effect is not small against the motion, as for a spike of 7 m/s, iterations may diverge. Samples keep their
    last converging iteration.
    """
    of_stage = [each for each in injections if each.effect.acts_on is acts_on]
    if not of_stage:
        return motion, np.zeros(3)
    after, added = motion.velocity_body, np.zeros_like(motion.velocity_body)
    moved_before = np.full(len(after), np.inf)
    for _ in range(PASSES):
        before, added = added, traces(of_stage, motion, acts_on)
        added = added if turned is None else rotate_vectors(turned, added)
        if not any(isinstance(each.effect, Effect) and each.effect.of_velocity for each in of_stage):  # exact
            return replace(motion, velocity_body=after - added), added
        if np.array_equal(added, before):
            break
        moved = np.linalg.norm(added - before, axis=1)
        added = np.where((moved <= moved_before)[:, None], added, before)
        moved_before = np.minimum(moved, moved_before)
        motion = replace(motion, velocity_body=after - added)
    return motion, added


def lagged_columns(
    lags: Sequence[tuple[EffectWithMemory, Values]],
    seen: Seen,
    close: Seen,
    own: NDArray[np.intp] | slice,
    columns: Array,
) -> Array:
    """Filter derivatives (C, 3, p) at close times by lags of the reference; return (F, 3, p) at own times. Input is the
    reference point's velocity, m/s."""
    if close is seen and len(lags) == 1:
        ((lag, values),) = lags
        return lag.follows(seen.motion, columns, values)
    for lag, values in lags:
        columns = columns - lag.filtered(close.motion, columns, values)
    return without_remembered(lags, seen, columns[own])


def without_remembered(lags: Sequence[tuple[EffectWithMemory, Values]], seen: Seen, columns: Array) -> Array:
    """Subtract from derivatives (F, 3, p) m/s the part that a lag remembers from earlier samples."""
    for lag, values in lags:
        columns = columns - lag.of_before(seen.motion, columns, values)
    return columns


def rotate_vectors(matrix: Array, values: Array) -> Array:
    """Multiply values (N, 3) by one matrix (3, 3), (1, 3, 3) or one each (N, 3, 3)."""
    if matrix.ndim == 2 or len(matrix) == 1:
        return values @ (matrix if matrix.ndim == 2 else matrix[0]).T
    return np.asarray(np.einsum("nij,nj->ni", matrix, values))


def columns_by_turn(hypothesis: Hypothesis, seen: Seen, measured: Array) -> Array:
    """Return d e / d (φ + turns), (F, 3, 3), body frame, of DVL velocities (F, 3) m/s.

    D⁻¹ y with y the unscaled velocity is Exp(θ)ᵀ y, and Exp(θ + δ) = Exp(J δ) Exp(θ) with J the left Jacobian.
    """
    matrix = seen.body_from_measured * (1.0 + hypothesis.scale)
    unscaled, jacobian = measured / (1.0 + hypothesis.scale), _left_jacobian(seen.angles)
    if matrix.ndim == 2:  # linear in the velocity: one matrix product
        of_axes = (matrix @ skew(np.eye(3)) @ jacobian).reshape(3, 9)
        return np.asarray((unscaled @ of_axes).reshape(-1, 3, 3))
    return np.asarray(matrix @ skew(unscaled) @ jacobian)


def _left_jacobian(angles: Array) -> Array:
    """Return (..., 3, 3) of rotation vectors (..., 3) rad: I + (1 - cos θ) / θ² [θ×] + (θ - sin θ) / θ³ [θ×]²."""
    square = np.maximum((angles**2).sum(axis=-1), 1e-12)[..., None, None]
    size = np.sqrt(square)
    cross = skew(angles)
    once, twice = (1.0 - np.cos(size)) / square, (size - np.sin(size)) / (square * size)
    return np.asarray(np.eye(3) + once * cross + twice * (cross @ cross))


def trace_columns(effect: Effect, motion: EffectInput, values: Values) -> Array:
    """Return d e / d parameters of an effect's trace on a motion, (F, 3, p), in the motion's frame."""
    specs = amplitudes(effect)
    if all(spec.linear for spec in specs):
        none = {**values, **{spec.name: 0.0 for spec in specs}}
        slopes = [effect.trace(motion, {**none, spec.name: 1.0}) for spec in specs]
        own = {spec.name for spec in effect.parameters}
        if any(value for name, value in none.items() if name not in own):  # a known height is not fitted
            still = effect.trace(motion, none)
            slopes = [slope - still for slope in slopes]
    else:
        slopes = [central_difference(spec, values, lambda at: effect.trace(motion, at)) for spec in specs]
    return -np.stack(slopes, axis=2)


def central_difference(spec: EffectParameter, values: Values, function: Callable[[Values], Array]) -> Array:
    """Return the derivative of a function of the values by a parameter: central, one-sided at its bounds."""
    step = 0.05 * spec.typical
    low, high = max(values[spec.name] - step, spec.low), min(values[spec.name] + step, spec.high)
    at_low, at_high = (function({**values, spec.name: each}) for each in (low, high))
    return np.asarray((at_high - at_low) / (high - low))
