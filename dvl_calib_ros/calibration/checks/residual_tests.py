"""Tests whether the residual velocity follows a signal that no mounting makes.

The residual is the reference minus the corrected DVL. Least squares tests it against three signals, together with all
errors that a calibration may leave. If it follows tilt, the DVL's velocity does not rotate with the IMU's attitude (a
driver that levels it, a wrong sign). If it is constant at every speed, the DVL has a bias. If it follows the second
derivative of the velocity, one of the two is smoothed. All three bias the angles beyond their σ.

If it follows the DVL's earlier noise, the reference is a filter's output with that DVL as input. With d = s + n of the
DVL and r = s + m of an independent instrument, r - d = m - n, and no earlier d predicts white noise n. A filter that
keeps a response h of the noise has r - d = m - n + h ∗ n, which is predictable. Earlier noise is the residual of an
autoregression of d. A smoothed reference lags the motion, which has the opposite sign.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..models import MODELS
from ..models.own import heading_cycles
from ..models.parameters import Parameters
from ..numerics.block_covariance import effective_blocks, student_factor
from ..numerics.frames import Array, cross, skew
from ..numerics.kalman import GaussianState
from ..numerics.robust import FEWEST_VALUES, QUIETEST_MPS, ROBUST_PASSES, median, robust_std
from ..numerics.samples import Index
from ..numerics.tests import Z_95_PERCENT, Z_ONE_TEST, Z_REPEATED_TEST, Z_SLOW_ERRORS
from ..results.results import OFFSETS, Estimate
from ..streams.interpolation import linear_at
from .beam_faults import BIAS_STD, BeamFault, beam_warning
from .imu_rate_consistency import LEVEL_BELOW
from .reference_independence import SLOWEST_S

# Time constants, s, between which a change of tilt is the vehicle's; slower ones may be the IMU's error.
TILT_S = 1.0, 15.0
# Averaging time, s, of the velocity whose second derivative is tested.
BEND_S = 1.0
# Stretches, s, whose scatter gives σ.
STRETCH_S = 15.0
# Numbers of stretches combined for σ: slow errors of references and attitudes last a minute or two.
QUICK_STRETCHES, LASTING = (1, 2, 4), (1, 2, 4, 8)
# Prior σ of nuisance columns: misalignment (rad), scale, lever arm (m), delay (s), reference error (m/s), heading error
# about the earth's vertical (rad), which differs from yaw when the vehicle tilts. BY_HEADING: heading errors with one
# and two cycles of the heading, and with a drift over the recording (rad), similar to a bias but not to fast signals.
NUISANCE_STD: Array = np.array([0.05] * 3 + [0.02] * 3 + [1.0] * 3 + [0.3] + [0.01, 0.01, 0.05] + [0.1])
BY_HEADING: Array = np.array([0.05] * 2 + [0.02] * 2 + [0.1])
# Prior σ of the tested signals: shares of tilt, second derivative (s²). Heading drift and bed: on means over MEAN_S.
SIGNAL_STD, MEAN_S = np.array([10.0, 10.0, 10.0]), 5.0
# Smallest tilt (rad, rms) for a test, and share of tilt that the residual must follow.
LEAST_TILT, MISSING_TILT_SHARE = math.radians(0.08), 0.6
# Prior σ of the bed's velocity, m/s: sediment in a flood, or a water layer. Below MOVES_FROM_MPS the reference may be
# the cause: an inertial navigation at sea (recording T09) had an error of 0.054.
BED_STD_MPS, MOVES_FROM_MPS = 1.0, 0.08
# Columns of the reference error, east and north, in `NUISANCE_STD`.
OVER_GROUND = slice(10, 12)
# Share of the second derivative that means over `MEAN_S` must keep for the smoothing test.
LEAST_OF_BEND = 0.3
# σ of the missing share of tilt above which it may be the whole tilt.
TILT_UNOBSERVABLE_STD = 0.2
# Bias of a usual DVL (m/s), and its σ (forward or port) from which the motion does not make it observable.
TYPICAL_BIAS_MPS, BIAS_UNOBSERVABLE_STD_MPS = 0.02, 0.008
# Share of tilt from which a sign is wrong, instead of a levelled velocity.
WRONG_SIGN_TILT_SHARE = 1.6
# Mounting error (rad) from which it is reported.
REPORTED_FROM_RAD = math.radians(0.2)
# Time constant of smoothing (s) from which the calibration is rejected.
TOO_SMOOTH_S = 0.6
# Residual relative to the median, or innovation in σ, beyond which it is an outlier.
OUTLIER_RATIO = 4.0
# Memories of a filter that are tested, s.
FILTER_MEMORIES_S = 0.5, 1.0, 3.0
# Samples to either side that predict one.
NEIGHBOURS = 12
# σ of the share of the DVL's noise in the reference that is due to waves (0.2 m/s at 8 Hz: up to 0.05).
OF_WAVES = 0.015


class ResidualTrend(NamedTuple):
    """Signals that the residual velocity follows.

    tilt, tilt_std: (2,) share of roll and pitch missing in the DVL's velocity: 0 if correct, 1 if levelled, ±2 for a
      wrong sign.
    smoothed, smoothed_std: s², half the squared time constant of the reference; negative for the DVL.
    lean: (2,) rad, mean roll and pitch.
    speed: m/s, rms.
    circular, circular_std: share of the DVL's noise that the reference keeps after one sample.
    circular_s: the most significant of `FILTER_MEMORIES_S`.
    over_ground, over_ground_std: (2,) m/s, reference minus DVL, east and north, on every heading; 0 if the residual
      holds less than half of it.
    turned, turned_std: rad, change of the heading error from start to end.
    """

    tilt: Array
    tilt_std: Array
    smoothed: float
    smoothed_std: float
    lean: Array
    speed: float
    circular: float
    circular_std: float
    circular_s: float
    over_ground: Array
    over_ground_std: Array
    turned: float
    turned_std: float


class _Fit(NamedTuple):
    """Fit of the residual: x (n,) with σ from the scatter of stretches, and P (n, n) of the noise alone.

    weight: (N,). starts: of the stretches.
    """

    x: Array
    std: Array
    p: Array
    weight: Array
    starts: Index

    def last_coefficient(self, columns: Array, values: Array) -> float:
        """Return the coefficient of the last column of (N, 3, n) in values (N, 3), adjusted for the others."""
        return float(self.p[-1] @ np.einsum("n,nij,ni->j", self.weight, columns, values))


def residual_trend(
    time: Array, rotation_enu_from_body: Array, velocity: Array, error: Array, rates: Array, interval_s: float = 0.0
) -> ResidualTrend | None:
    """Fit tilt and smoothing to all samples, heading drift and moving bed to means; None for too little data.

    Parameters
    ----------
    time: (N,) s.
    rotation_enu_from_body: (N, 3, 3).
    velocity, error: (N, 3) m/s, of the reference, and reference minus corrected DVL, body.
    rates: (N, 3) rad/s, body.
    interval_s: sample interval of the reference, which is interpolated linearly, s.
    """
    if len(time) < 3 or time[-1] - time[0] < FEWEST_VALUES * STRETCH_S:
        return None
    samples = _ResidualSamples(time, rotation_enu_from_body, velocity - error, error, rates, interval_s)
    up = np.sign(rotation_enu_from_body[:, 2, 2].mean())  # -1 for a z-down body
    roll = np.arctan2(up * rotation_enu_from_body[:, 2, 1], up * rotation_enu_from_body[:, 2, 2])
    pitch = -np.arcsin(np.clip(rotation_enu_from_body[:, 2, 0], -1.0, 1.0))
    changing_tilt = [_mean(time, tilt, TILT_S[0]) - _mean(time, tilt, TILT_S[1]) for tilt in (roll, pitch)]
    smoothed = _smoothed_motion(samples)
    fast = _fit_fast_signals(samples, smoothed, changing_tilt)
    means = _fit_means(samples, smoothed)
    if fast is None or means is None:
        return None
    tilt, tilt_std = fast.fit.x[-3:-1], fast.fit.std[-3:-1]
    tilt_std[[axis.std() < LEAST_TILT for axis in changing_tilt]] = math.inf
    # without tilt data, wave motion looks like turning
    is_tilting = max(float(np.abs(axis).max()) for axis in changing_tilt) > LEVEL_BELOW
    # scaled to the whole second derivative, which a smoothed reference lacks, as means keep little of waves
    is_observable = is_tilting and fast.bend_gain > LEAST_OF_BEND
    circular = _noise_in_reference(samples, fast)
    return ResidualTrend(
        tilt=tilt, tilt_std=tilt_std,
        smoothed=float(fast.fit.x[-1] / fast.bend_gain) if is_observable else 0.0,
        smoothed_std=float(fast.fit.std[-1] / fast.bend_gain) if is_observable else math.inf,
        lean=np.array([roll.mean(), pitch.mean()]), speed=math.sqrt(float((velocity**2).sum(axis=1).mean())),
        circular=circular.share, circular_std=circular.std, circular_s=circular.memory_s,
        over_ground=_over_ground(samples, means.bed), over_ground_std=means.bed.std[OVER_GROUND],
        turned=float(means.drift.x[-4]), turned_std=float(means.drift.std[-4]),
    )  # fmt: skip


class _ResidualSamples(NamedTuple):
    """N samples: time s, rotation_enu_from_body (N, 3, 3), corrected DVL velocity and error m/s, rates rad/s; body.

    error: reference minus DVL. interval_s: sample interval of the reference, s.
    """

    time: Array
    rotation_enu_from_body: Array
    dvl: Array
    error: Array
    rates: Array
    interval_s: float


class _SmoothedMotion(NamedTuple):
    """Smoothed DVL velocity (N, 3) m/s with its slope and bend, its first and second derivative; body axes.

    The DVL's is smoothed, because noise of either velocity would correlate with the residual.
    """

    velocity: Array
    slope: Array
    bend: Array


def _smoothed_motion(samples: _ResidualSamples) -> _SmoothedMotion:
    """Smooth the DVL's velocity over BEND_S, and differentiate it over the same time."""
    time, body_from_enu = samples.time, samples.rotation_enu_from_body.swapaxes(1, 2)
    enu = _mean(time, _turned(samples.rotation_enu_from_body, samples.dvl), BEND_S)
    slope = (linear_at(time, enu, time + BEND_S) - linear_at(time, enu, time - BEND_S)) / (2.0 * BEND_S)
    return _SmoothedMotion(*(_turned(body_from_enu, values) for values in (enu, slope, _bend(time, enu))))


def _bend(time: Array, values: Array) -> Array:
    """Return the second derivative of values (N, 3) by differences over BEND_S."""
    before, after = linear_at(time, values, time - BEND_S), linear_at(time, values, time + BEND_S)
    return np.asarray((after - 2.0 * values + before) / BEND_S**2)


class _FastFit(NamedTuple):
    """Fit of tilt and second derivative to all samples, with its columns (N, 3, n).

    bend_gain: coefficient of the second derivative of means per unit of the whole second derivative.
    """

    fit: _Fit
    columns: Array
    bend_gain: float

    def without_columns(self, values: Array) -> Array:
        """Subtract the fit of the columns to values (N, 3)."""
        weighted = self.fit.weight[:, None] * values
        return np.asarray(values - self.columns @ (self.fit.p @ np.einsum("nij,ni->j", self.columns, weighted)))


def _fit_fast_signals(
    samples: _ResidualSamples, smoothed: _SmoothedMotion, changing_tilt: Sequence[Array]
) -> _FastFit | None:
    """Fit roll, pitch (N,) rad and the second derivative of the velocity to all samples; None for too little data."""
    time, body_from_enu = samples.time, samples.rotation_enu_from_body.swapaxes(1, 2)
    signals = np.zeros((len(time), 3, 3))
    for axis, tilt in enumerate(changing_tilt):
        tilt_axis = np.zeros((len(time), 3))
        tilt_axis[:, axis] = -tilt
        signals[:, :, axis] = cross(tilt_axis, smoothed.velocity)
    # second derivative of means, so that DVL noise is common to all samples of a mean
    of_means = _mean(time, _turned(samples.rotation_enu_from_body, _mean(time, samples.dvl, MEAN_S)), BEND_S)
    signals[:, :, 2] = _turned(body_from_enu, _bend(time, of_means))
    # linear interpolation loses this part of the second derivative on average
    residual = samples.error - samples.interval_s**2 / 12.0 * smoothed.bend
    nuisance = _nuisance_columns(smoothed.velocity, samples.rates, smoothed.slope, body_from_enu)
    columns = np.concatenate([nuisance, signals], axis=2)
    fit = _fitted(time, columns, residual, np.concatenate([NUISANCE_STD, SIGNAL_STD]))
    return None if fit is None else _FastFit(fit, columns, fit.last_coefficient(columns, smoothed.bend))


class _MeanFits(NamedTuple):
    """Fits to means over MEAN_S: of a heading that drifts, and of the same with a moving bed."""

    drift: _Fit
    bed: _Fit


def _fit_means(samples: _ResidualSamples, smoothed: _SmoothedMotion) -> _MeanFits | None:
    """Fit heading errors, DVL bias and moving bed to means over MEAN_S; None for too little data."""
    time, rotation = samples.time, samples.rotation_enu_from_body
    starts = np.flatnonzero(np.diff(np.floor((time - time[0]) / MEAN_S), prepend=-1.0))
    # velocity of neighbouring means, because a mean's own noise would look like a scale, and so like a bias
    moving = _neighbouring_means(time, smoothed.velocity, starts)
    nuisance = _nuisance_columns(moving, samples.rates, smoothed.slope, rotation.swapaxes(1, 2))
    progress = (time - time.mean()) / (time[-1] - time[0])
    heading_terms = np.column_stack([heading_cycles(rotation), progress])
    by_heading = nuisance[:, :, -1, None] * heading_terms[:, None]
    by_bias = np.broadcast_to(-np.eye(3), (len(time), 3, 3))
    columns = np.concatenate([_means(part, starts) for part in (nuisance, by_heading, by_bias)], axis=2)
    data = _means(time, starts), columns, _means(samples.error, starts)
    prior_std = np.concatenate([NUISANCE_STD, BY_HEADING, np.full(3, BIAS_STD)])
    drift = _fitted(*data, prior_std, LASTING)
    prior_std[OVER_GROUND] = BED_STD_MPS
    bed = _fitted(*data, prior_std, LASTING)
    return None if drift is None or bed is None else _MeanFits(drift, bed)


def _over_ground(samples: _ResidualSamples, bed: _Fit) -> Array:
    """Return the velocity (2,) m/s of the bed, east and north; 0 if the residual holds less than half of it.

    On few headings yaw and bias can compensate any bed velocity, with a small residual.
    """
    over_ground = bed.x[OVER_GROUND]
    residual = median(_turned(samples.rotation_enu_from_body, samples.error)[:, :2])
    if float(over_ground @ residual) < 0.5 * float(over_ground @ over_ground):
        return np.zeros(2)
    return over_ground


def _nuisance_columns(moving: Array, rates: Array, slope: Array, body_from_enu: Array) -> Array:
    """Return nuisance columns (N, 3, 14) from velocity, turn rate and acceleration (N, 3), body axes."""
    columns = np.zeros((len(moving), 3, len(NUISANCE_STD)))
    columns[:, :, :3] = skew(moving)
    columns[:, [0, 1, 2], [3, 4, 5]] = moving
    columns[:, :, 6:9] = skew(rates)
    columns[:, :, 9] = slope
    columns[:, :, 10:13] = body_from_enu
    columns[:, :, 13] = cross(moving, body_from_enu[:, :, 2])
    return columns


def _neighbouring_means(time: Array, values: Array, starts: Index) -> Array:
    """Return for each value (N, 3) the mean of the neighbouring stretches, or of its own if these are far in time."""
    mean_times, stretch_means = _means(time, starts), _means(values, starts)
    is_near = (np.diff(mean_times) < 2.0 * MEAN_S).astype(float)[:, None]
    before, after = np.vstack([[[0.0]], is_near]), np.vstack([is_near, [[0.0]]])
    neighbour_mean = before * np.roll(stretch_means, 1, axis=0) + after * np.roll(stretch_means, -1, axis=0)
    is_alone = before + after == 0.0
    means = np.where(is_alone, stretch_means, neighbour_mean / np.where(is_alone, 1.0, before + after))
    return np.repeat(means, np.diff(starts, append=len(time)), axis=0)


def confused_with_bias_std(estimate: Estimate, parameters: Parameters) -> Array:
    """Return σ (3,) of scale, yaw and pitch (rad), which a bias along body x, y and z resembles at constant speed."""
    terms, dvl_from_body = MODELS[estimate.model].error_terms_from_state, parameters.rotation_dvl_from_body
    p = terms @ estimate.recording_covariance @ terms.T
    weights = dvl_from_body[:, 0] ** 2
    angles = np.diag(dvl_from_body.T @ p[:3, :3] @ dvl_from_body)
    return np.sqrt([float(weights @ p[3:, 3:] @ weights), angles[2], angles[1]])


def moving_bed(trend: ResidualTrend | None, estimate: Estimate) -> Reason | None:
    """Return the reason against a calibration over a moving bed; None if not significant.

    It is only marginal if the calibration's constant reference error holds most of that velocity.
    """
    if trend is None:
        return None
    size = float(np.linalg.norm(trend.over_ground))
    if size < MOVES_FROM_MPS or (np.abs(trend.over_ground) < Z_SLOW_ERRORS * trend.over_ground_std).all():
        return None
    estimated_error = [estimate.state_of(name) for name in OFFSETS]
    is_held = float(np.linalg.norm(trend.over_ground - estimated_error)) < 0.5 * size
    course = math.degrees(math.atan2(*trend.over_ground)) % 360.0
    reason = finding("BED_MOVES", millimetres=1000.0 * size, course=course, std=float(f"{size:.1g}"))
    return reason.weighed(Severity.MARGINAL if is_held else Severity.REJECT)


def residual_warnings(
    trend: ResidualTrend | None,
    of_positions: bool = False,
    mounting_std: Sequence[float] | Array = (0.0, 0.0, 0.0),
    bias: GaussianState | None = None,
    beam: BeamFault | None = None,
    accepted: float = 0.01,
    second_order: float = 0.0,
) -> list[Reason]:
    """Return the reasons from the residual, weighed by their effect on the verdict.

    of_positions: the reference's velocities are position differences, smoothed by their interval.
    mounting_std: see `confused_with_bias_std`.
    bias: x (3,) m/s, P (3, 3) of the DVL, body axes; None if not estimated.
    accepted: error of the mounting (rad, or share of the distance) that does not reject a calibration; nor does an
      error within its own 95 % interval.
    second_order: square of the misalignment, rad²: the error of its first-order model, which looks like a beam.
    """
    if trend is None:
        return []
    seconds = math.sqrt(2.0 * abs(trend.smoothed))
    # a filter smooths and passes noise on: with evidence for one, the other needs less
    is_filter = not of_positions and trend.smoothed > Z_95_PERCENT * trend.smoothed_std
    if trend.circular > (Z_ONE_TEST if is_filter else Z_REPEATED_TEST) * trend.circular_std:
        return [finding("CIRCULAR_REFERENCE", seconds=trend.circular_s).weighed(Severity.REJECT)]
    by_position_window = of_positions and trend.smoothed > 0.0
    is_smoothed = abs(trend.smoothed) > Z_REPEATED_TEST * trend.smoothed_std
    if is_smoothed and seconds > TOO_SMOOTH_S:
        severity = Severity.MARGINAL if by_position_window else Severity.REJECT
        # smoothing causes any other signal
        return [finding("VELOCITY_SMOOTHED", name=_smoothed_one(trend), seconds=seconds).weighed(severity)]
    reasons = _tilt_warnings(trend, accepted)
    # the heading at either end, relative to its mean
    error = 0.5 * abs(trend.turned)
    if error > REPORTED_FROM_RAD and error > Z_ONE_TEST * trend.turned_std:
        severity = Severity.MARGINAL if error > max(accepted, Z_95_PERCENT * mounting_std[1]) else Severity.WARNING
        degrees = {"degrees": math.degrees(trend.turned), "std": math.degrees(trend.turned_std)}
        reasons.append(finding("HEADING_DRIFTS", **degrees, off=math.degrees(error)).weighed(severity))
    if all(reason.severity is Severity.WARNING for reason in reasons):  # a wrong tilt or heading looks like a beam
        reasons += beam_warning(beam, max(accepted, second_order))
    return reasons if bias is None else reasons + _bias_warnings(bias, trend.speed, mounting_std, accepted)


def _tilt_warnings(trend: ResidualTrend, accepted: float) -> list[Reason]:
    """Return reasons for roll and pitch that the DVL's velocity does not follow, or may not. accepted: rad."""
    reasons = []
    for axis, name in enumerate(("roll", "pitch")):
        share, std, lean = float(trend.tilt[axis]), float(trend.tilt_std[axis]), float(trend.lean[axis])
        if abs(share) > max(Z_SLOW_ERRORS * std, MISSING_TILT_SHARE):
            error = abs(share * lean)
            severity = Severity.REJECT if error > accepted or abs(share) > WRONG_SIGN_TILT_SHARE else Severity.MARGINAL
            found_tilt = finding("TILT_NOT_FOLLOWED", axis=name, share=share, std=std, off=math.degrees(error))
            reasons.append(found_tilt.weighed(severity))
        elif std > TILT_UNOBSERVABLE_STD and abs(lean) > accepted:
            reasons.append(finding("TILT_NOT_SHOWN", axis=name, lean=math.degrees(abs(lean))))
    return reasons


def _bias_warnings(
    bias: GaussianState, speed: float, mounting_std: Sequence[float] | Array, accepted: float
) -> list[Reason]:
    """Return the reason for a significant bias, or for one speed that does not show it; see `residual_warnings`."""
    magnitude, std = np.abs(bias.x), np.sqrt(np.diag(bias.p))
    is_significant = (magnitude > Z_SLOW_ERRORS * std) & (magnitude > REPORTED_FROM_RAD * speed)
    if is_significant.any():
        axes = ", ".join(
            f"{axis} {1000.0 * bias.x[i]:+.0f} ± {1000.0 * std[i]:.0f}"
            for i, axis in enumerate("xyz")
            if is_significant[i]
        )
        angle = float(magnitude[is_significant].max()) / speed
        allowed_mps = np.maximum(accepted, Z_95_PERCENT * np.asarray(mounting_std)) * speed
        is_wrong = is_significant & (magnitude - std > allowed_mps)
        severity = Severity.REJECT if is_wrong.any() else Severity.MARGINAL
        return [finding("DVL_BIAS", axes=axes, degrees=math.degrees(angle)).weighed(severity)]
    if float(std[:2].max()) > BIAS_UNOBSERVABLE_STD_MPS:
        share = TYPICAL_BIAS_MPS / speed
        return [finding("ONE_SPEED", off=TYPICAL_BIAS_MPS, degrees=math.degrees(share), percent=100.0 * share)]
    return []


def _smoothed_one(trend: ResidualTrend) -> str:
    return "reference" if trend.smoothed > 0.0 else "DVL"


def _fitted(
    time: Array, columns: Array, error: Array, prior_std: Array, group_sizes: Sequence[int] = QUICK_STRETCHES
) -> _Fit | None:
    """Fit error (N, 3) = columns (N, 3, n) x robustly, σ from the scatter of stretches; None for too few stretches."""
    stretch = np.floor((time - time[0]) / STRETCH_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(stretch, prepend=-1))
    if len(starts) < FEWEST_VALUES:
        return None
    n = columns.shape[2]
    residual = error
    for _ in range(ROBUST_PASSES):
        square = (residual**2).sum(axis=1)
        noise = max(float(median(square)), QUIETEST_MPS**2)
        weight = 1.0 / np.maximum(square / (OUTLIER_RATIO**2 * noise), 1.0)
        weighted = columns * weight[:, None, None]
        design, observed = columns.reshape(-1, n), error.reshape(-1)
        prior = noise / 3.0 / prior_std**2
        p = np.linalg.inv(weighted.reshape(-1, n).T @ design + np.diag(prior))
        estimate = p @ (weighted.reshape(-1, n).T @ observed)
        residual = error - columns @ estimate
    scores = np.add.reduceat(np.einsum("nij,ni->nj", weighted, residual), starts, axis=0)
    # one axis at a time to save memory: hours of data would need a tenth of a gigabyte
    axis_sums = [np.add.reduceat((weighted[:, axis] @ p) ** 2, starts, axis=0) for axis in range(3)]
    contributions = np.sum(axis_sums, axis=0)
    # nuisance errors of their prior size add to σ, as far as the data do not exclude them
    prior_error = p[:, : len(NUISANCE_STD)] * (prior * prior_std)[: len(NUISANCE_STD)]
    std = student_factor(effective_blocks(contributions[None])[0] - 1.0) * _std(p @ scores.T, group_sizes)
    std = np.maximum(std, np.sqrt(np.diag(p) * _mean_square(weight, residual)))
    return _Fit(estimate, np.sqrt(std**2 + (prior_error**2).sum(axis=1)), p, weight, starts)


def _mean_square(weight: Array, values: Array) -> float:
    """Return the weighted mean square of values (N, 3): white noise, below which few stretches may scatter."""
    return float(weight @ (values**2).sum(axis=1)) / (3.0 * float(weight.sum()))


def _std(scatter: Array, group_sizes: Sequence[int]) -> Array:
    """Return the largest σ (n,) from scatter (n, M) of stretches and of their groups, as noise is correlated."""
    n, m = scatter.shape
    sums = [scatter[:, : m // k * k].reshape(n, -1, k).sum(axis=2) for k in group_sizes if m >= 2 * k]
    return np.sqrt(np.max([(group**2).sum(axis=1) for group in sums], axis=0) * (m / (m - 1.0)))


class _KeptNoise(NamedTuple):
    """Share of the DVL's noise that the reference keeps after one sample, its σ, and the memory of the filter, s."""

    share: float
    std: float
    memory_s: float


_NO_KEPT_NOISE = _KeptNoise(0.0, math.inf, 0.0)


def _noise_in_reference(samples: _ResidualSamples, fast: _FastFit) -> _KeptNoise:
    """Estimate the share of the DVL's noise in the reference, for the most significant memory of a filter.

    The innovation of a velocity, given its neighbours, holds its noise. The same filter is applied to the residual, so
    both hold the same noise. Nuisance columns hold DVL noise themselves, so the residual is not corrected by them.
    """
    step = float(median(np.diff(samples.time)))
    # in slower streams the innovation is motion, and a reference that is interpolated follows the motion before
    if max(step, samples.interval_s) > SLOWEST_S or len(samples.time) < 4 * NEIGHBOURS:
        return _NO_KEPT_NOISE
    innovation, kept = (np.zeros_like(samples.dvl) for _ in range(2))
    for axis, values in enumerate((samples.dvl - samples.dvl.mean(axis=0)).T):
        shares = _innovation_filter(values)
        for filtered, unfiltered in ((innovation, values), (kept, samples.error[:, axis])):
            filtered[NEIGHBOURS:-NEIGHBOURS, axis] = np.correlate(unfiltered, shares, "valid")
    limit = OUTLIER_RATIO * robust_std(innovation)
    # gaps break the prediction
    is_gap = np.append(0.0, np.abs(np.diff(samples.time) - step) > 0.5 * step)
    innovation[np.convolve(is_gap, np.ones(2 * NEIGHBOURS), "same") > 0.5] = 0.0
    noise = np.clip(innovation, -limit, limit)
    weight = fast.fit.weight * ((innovation == noise) & (innovation != 0.0)).all(axis=1)  # neither clipped, nor an end
    current = fast.without_columns(noise)
    noise_power = np.maximum(np.einsum("n,ni,ni->i", weight, current, current), 1e-18)

    def without_current(values: Array) -> Array:
        """Subtract the part of values (N, 3) that follows the noise of the same sample."""
        return np.asarray(values - current * (np.einsum("n,ni,ni->i", weight, current, values) / noise_power))

    kept, candidates = without_current(kept), []
    for seconds in FILTER_MEMORIES_S:
        for corrected_lag in (0.0, seconds):  # the lag may have been corrected as a delay
            past = without_current(fast.without_columns(_filtered_noise(noise, step, seconds, corrected_lag)))
            square = float(np.einsum("n,ni,ni->", weight, past, past))
            if square <= 0.0:
                continue
            share = float(np.einsum("n,ni,ni->", weight, past, kept)) / square
            left = kept - share * past
            scores = np.add.reduceat(weight * (past * left).sum(axis=1), fast.fit.starts)
            scatter = float(_std(scores[None] / square, QUICK_STRETCHES)[0])
            std = math.hypot(max(scatter, math.sqrt(_mean_square(weight, left) / square)), OF_WAVES)
            if share - Z_95_PERCENT * std < 1.0:  # no filter makes more of the noise than there is: that is motion
                candidates.append(_KeptNoise(share, std, seconds))
    return max(candidates, key=lambda kept_noise: kept_noise.share / kept_noise.std, default=_NO_KEPT_NOISE)


def _filtered_noise(noise: Array, step: float, seconds: float, corrected_lag: float) -> Array:
    """Return a filter's output from earlier noise (N, 3). seconds: memory. corrected_lag: lag that is corrected, s."""
    kernel = np.exp(-np.arange(math.ceil(3.0 * seconds / step) + 1.0) * step / seconds)
    n_ahead = int(corrected_lag / step + 1e-6)
    kernel[n_ahead] = 0.0
    output = np.column_stack([np.convolve(np.append(column, np.zeros(n_ahead)), kernel) for column in noise.T])
    return np.asarray(output[n_ahead : n_ahead + len(noise)])


def _innovation_filter(values: Array) -> Array:
    """Return a filter (2 `NEIGHBOURS` + 1,) that gives a sample's error of interpolation from both sides."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * NEIGHBOURS + 1)
    centre, others = windows[:, NEIGHBOURS], np.delete(windows, NEIGHBOURS, axis=1)
    square = others.T @ others
    tiny = 1e-9 * float(np.trace(square)) / NEIGHBOURS + 1e-18  # simulated values may be exactly predictable
    return np.insert(-np.linalg.solve(square + tiny * np.eye(2 * NEIGHBOURS), others.T @ centre), NEIGHBOURS, 1.0)


def _mean(time: Array, values: Array, seconds: float) -> Array:
    """Return means of values (N, ...) over a window (s) about each time (N,)."""
    first = np.searchsorted(time, time - 0.5 * seconds)
    end = np.searchsorted(time, time + 0.5 * seconds, side="right")
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    number = (end - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((sums[end] - sums[first]) / number)


def _means(values: Array, starts: Index) -> Array:
    """Return means of values (N, ...) from each start to the next."""
    number = np.diff(starts, append=len(values)).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, starts, axis=0) / number)


def _turned(rotation: Array, vectors: Array) -> Array:
    """Rotate vectors (N, 3) by rotations (N, 3, 3)."""
    return np.asarray(np.matmul(rotation, vectors[..., None])[..., 0])
