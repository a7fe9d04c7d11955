"""What is left of the velocity after the calibration: whether it follows something that no mounting makes.

Held against the corrected DVL's velocity, a reference leaves noise. Where that follows the vehicle's tilt, the DVL's
velocity does not turn with the vehicle as the IMU's orientation says (a driver that has levelled it, an orientation of
the wrong sign); where it is the same at every speed, the DVL has a bias; where it follows how the velocity bends, one
of the two is smoothed. All three turn angles by what σ does not hold, so they are looked for, by least squares beside
all that the calibration has found already.

And where it follows what the DVL's noise was before, the reference is a filter's that took the DVL in. With d = s + n
of the DVL and r = s + m of an instrument of its own, r - d = m - n, and noise n that is new with each sample is not
foretold by any d before it. A filter that keeps h of the noise makes r - d = m - n + h ∗ n, which is. The noise that
was is what past d did not foretell of d (an autoregression). A smoothed reference lags the motion, and gives the other
sign.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..models import MODELS
from ..models.parameters import Parameters
from ..numerics.block_covariance import alike_of, of_few
from ..numerics.frames import Array, cross, skew
from ..numerics.robust import median, robust_std
from ..numerics.samples import Index
from ..results.results import ARM, OFFSETS, Estimate
from .imu_rate_consistency import LEVEL_BELOW

# Tilt that changes between so many seconds, s, is the vehicle's; slower, it may be the IMU's own error.
TILT_S = 1.0, 15.0
# The velocity bends by what its means of so long, s, do.
BEND_S = 1.0
# Stretches, s, by whose scatter σ is found; fewer say nothing.
STRETCH_S, ENOUGH = 15.0, 12
# Stretches taken together for that: slow errors of references and attitudes last for a minute or two.
QUICK_STRETCHES, LASTING = (1, 2, 4), (1, 2, 4, 8)
# So many σ are no chance; of smoothing, whose σ knows how few turns show it, fewer (of 197 surveys without any none
# had more than 3.3); of a bias, whose σ holds all else that is likely, fewer (of 300 combinations without one none
# had more than 3.6), and from fewer still it is named.
SURELY, SURELY_SMOOTHED, SURELY_BIASED, NAMED_FROM = 6.0, 5.0, 4.2, 3.7
# Likely, beside the calibration: turn (rad), scale, lever arm (m), delay (s), errors of the reference (m/s), and of the
# heading (rad), which turns about the vertical of the earth: not as a yaw does where the vehicle leans; and errors of
# the heading that change with it, once and twice around (rad), which look like a bias, but not like what is quick.
KNOWN: Array = np.array([0.05] * 3 + [0.02] * 2 + [1.0] * 3 + [0.3] + [0.01] * 3 + [0.1])
BY_HEADING: Array = np.array([0.05] * 2 + [0.02] * 2)
# ... and of what is looked for: shares of tilt, and bend (s²); a bias (m/s), looked for in means of so long, s.
QUICK, CONSTANT, MEAN_S = np.array([10.0, 10.0, 10.0]), np.array([0.1] * 3), 5.0
# Tilt (rad, rms) from which on a velocity has something to follow, and the share of it that it has to leave; the first
# of how it bends, m/s².
LEAST_TILT, NOT_FOLLOWED, LEAST_BEND = math.radians(0.08), 0.6, 0.006
# Prior σ (m/s) of a bed's velocity: sediment in a flood, or a layer of water. From `MOVES_FROM_MPS` on the reference is
# not the cause: an inertial navigation at sea (recording T09) was off by 0.054.
BED_STD_MPS, MOVES_FROM_MPS = 1.0, 0.08
# Rows of the reference's error, east and north, in `KNOWN`.
OVER_GROUND = slice(9, 11)
# Share of the whole bend that means of `MEAN_S` have to leave, for smoothing to be told by them.
LEAST_OF_BEND = 0.3
# Known to no better than this (σ), it may as well be all of it.
TILT_SHOWN = 0.2
# A bias of the DVL (m/s) that has been seen, which the motion shows to no better than this (σ, of ahead or across).
SEEN_BIAS, BIAS_OPEN = 0.02, 0.008
# A share from here on is no levelled velocity, but a sign.
WRONG_SIGN_FROM = 1.6
# An error of a mounting (rad) that is worth a word, and one that no answer is given beside unless so many σ of the
# answer, which has been told of a bias, hold the least that it is likely to be.
SAID_FROM, WRONG_FROM, WITHIN = math.radians(0.2), math.radians(0.5), 2.0
# Smoothing (s, time constant) that is worth a word, and one beside which no answer is given.
SMOOTHED_FROM_S, TOO_SMOOTH_S = 0.45, 0.6
# A velocity so many times further off than usual is an outlier.
OUTLYING, ROUNDS = 4.0, 3
# What is left is noise of so much at least, m/s.
QUIETEST_MPS = 1e-3
# A filter forgets the DVL over one of these, s. Of slower streams (s) what is new in a sample is the motion's.
FORGOTTEN_S, SLOWEST_S = (0.5, 1.0, 3.0), 0.3
# Samples that foretell the next; more than so many σ of it is no noise but an outlier.
FORETOLD_BY, NEW_AT_MOST = 12, 4.0
# So many σ of the noise being followed are no chance, of three that are looked at and one sign; and the share (σ) that
# what waves leave of themselves may look like (waves of 0.2 m/s at 8 Hz: up to 0.05).
FOLLOWED_SURELY, OF_WAVES = 4.5, 0.015
# ... where that the reference is a filter's shows by how it smooths, in so many σ: both are rare by chance, not one.
FOLLOWED_BY_FILTER, FILTER_SHOWN = 2.4, 2.4
# A filter lags by what it smooths over, within this factor; by less than this (s) so does anything. That it lags so
# shows it as well, so less of the smoothing has to, in σ.
FILTER_SHOWN_LAGGING = 1.8
LAGS_WITHIN, LEAST_LAG_S = 2.0, 0.2
# With less to correct than this (an angle in rad, a share of scale, an arm in m), or than so many σ, nothing is found.
NO_ANGLE, NO_SCALE, NO_ARM_M, BY_CHANCE = math.radians(0.35), 0.005, 0.2, 3.0
# ... and of it where a reference is positions: their window holds the motion on both sides of its middle, which looks a
# little like it.
FOLLOWED_BY_POSITIONS = 0.1


class ResidualTrend(NamedTuple):
    """What the velocity that is left follows.

    tilt, tilt_std: (2,) share of roll and of pitch that the DVL's velocity leaves out, 0 of a right one, 1 of a
    levelled one, 2 or -2 where a sign is wrong. bias, bias_std: (3,) m/s of the DVL, body. smoothed, smoothed_std: s²,
    half the square of the reference's time constant; below 0 the DVL's. lean: (2,) mean roll and pitch, rad. speed:
    m/s, rms. circular, circular_std: share of the DVL's noise that is still there with the next sample, and circular_s
    what it is forgotten over, s: the surest of `FORGOTTEN_S`. over_ground, over_ground_std: (2,) m/s that the reference
    is faster than the DVL, east and north, on every heading; 0 where the residual itself holds less than half of it.
    """

    tilt: Array
    tilt_std: Array
    bias: Array
    bias_std: Array
    smoothed: float
    smoothed_std: float
    lean: Array
    speed: float
    circular: float
    circular_std: float
    circular_s: float
    over_ground: Array
    over_ground_std: Array


class _Fit(NamedTuple):
    """x (n,), and σ by the scatter of stretches; P (n, n) of the noise alone, weights (N,), what is left (N, 3), and
    where stretches start."""

    x: Array
    std: Array
    p: Array
    weight: Array
    rest: Array
    starts: Index

    def seen_of(self, columns: Array, values: Array) -> float:
        """How much of the last one of the columns (N, 3, n) fits values (N, 3), beside all others."""
        return float(self.p[-1] @ np.einsum("n,nij,ni->j", self.weight, columns, values))


def residual_trend(
    time: Array, rotation_enu_from_body: Array, velocity: Array, error: Array, rates: Array, interval_s: float = 0.0
) -> ResidualTrend | None:
    """None where there is too little to look at.

    Parameters
    ----------
    time: (N,) s.
    rotation_enu_from_body: (N, 3, 3).
    velocity, error: (N, 3) m/s of the reference, and reference less corrected DVL, body.
    rates: (N, 3) rad/s, body.
    interval_s: between samples of the reference, which is read along straight lines between them.

    """
    if len(time) < 3 or time[-1] - time[0] < ENOUGH * STRETCH_S:
        return None
    up = np.sign(rotation_enu_from_body[:, 2, 2].mean())  # of a body that is z down -1
    roll = np.arctan2(up * rotation_enu_from_body[:, 2, 1], up * rotation_enu_from_body[:, 2, 2])
    pitch = -np.arcsin(np.clip(rotation_enu_from_body[:, 2, 0], -1.0, 1.0))
    changing = [_mean(time, tilt, TILT_S[0]) - _mean(time, tilt, TILT_S[1]) for tilt in (roll, pitch)]
    body_from_enu = rotation_enu_from_body.swapaxes(1, 2)
    # by the DVL's own velocity, for noise of the reference is what is explained; smoothed, for so is its own
    earth = _mean(time, _turned(rotation_enu_from_body, velocity - error), BEND_S)
    before, after = _at(time, earth, -BEND_S), _at(time, earth, BEND_S)
    moving, slope = _turned(body_from_enu, earth), _turned(body_from_enu, (after - before) / (2.0 * BEND_S))
    n = len(time)
    yaw = np.arctan2(rotation_enu_from_body[:, 1, 0], rotation_enu_from_body[:, 0, 0])
    around = np.column_stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw)])
    quick = np.zeros((n, 3, 3))
    for axis in range(2):
        about = np.zeros((n, 3))
        about[:, axis] = -changing[axis]
        quick[:, :, axis] = cross(about, moving)
    # as the vehicle's turning bends it: noise of the DVL is in all of a mean alike
    turning = _mean(time, _turned(rotation_enu_from_body, _mean(time, velocity - error, MEAN_S)), BEND_S)
    bend, whole_bend = (
        (_at(time, each, BEND_S) - 2.0 * each + _at(time, each, -BEND_S)) / BEND_S**2 for each in (turning, earth)
    )
    quick[:, :, 2] = _turned(body_from_enu, bend)
    bends = math.sqrt(float((bend**2).sum(axis=1).mean()))
    # a straight line between two samples is short of the bend by so much in the mean
    bent = error - interval_s**2 / 12.0 * _turned(body_from_enu, whole_bend)
    both = np.concatenate([_known(moving, rates, slope, body_from_enu), quick], axis=2)
    fast = _fitted(time, both, bent, np.concatenate([KNOWN, QUICK]))
    constant = np.broadcast_to(-np.eye(3), (n, 3, 3))
    starts = np.flatnonzero(np.diff(np.floor((time - time[0]) / MEAN_S), prepend=-1.0))
    # of a mean its own noise is what the reference is further on: that alone would be a scale, and a bias against it
    beside = _known(_beside(time, moving, starts), rates, slope, body_from_enu)
    by_heading = beside[:, :, -1, None] * around[:, None]
    columns = np.concatenate([_means(each, starts) for each in (beside, by_heading, constant)], axis=2)
    likely = np.concatenate([KNOWN, BY_HEADING, CONSTANT])
    means = _means(time, starts), columns, _means(error, starts)
    slow = _fitted(*means, likely, LASTING)
    likely[OVER_GROUND] = BED_STD_MPS
    over_bed = _fitted(*means, likely, LASTING)
    if fast is None or slow is None or over_bed is None:
        return None
    over_ground = over_bed.x[OVER_GROUND]
    # with few headings a yaw and a bias can make up for any such velocity, and the residual is small
    if float(over_ground @ median(_turned(rotation_enu_from_body, error)[:, :2])) < 0.5 * float(
        over_ground @ over_ground
    ):
        over_ground = np.zeros(2)
    tilt, std = fast.x[-3:-1], fast.std[-3:-1]
    std[[each.std() < LEAST_TILT for each in changing]] = math.inf
    lean = np.array([roll.mean(), pitch.mean()])
    speed = math.sqrt(float((velocity**2).sum(axis=1).mean()))
    # without tilt, what waves do to it looks like turning
    shows = bends > LEAST_BEND and max(float(np.abs(each).max()) for each in changing) > LEVEL_BELOW
    # a mean leaves little of waves, whose whole bend a smoothed reference lacks: so it is of that
    bends_by = fast.seen_of(both, _turned(body_from_enu, whole_bend))
    shows = shows and bends_by > LEAST_OF_BEND
    smoothed, smoothed_std = (fast.x[-1] / bends_by, fast.std[-1] / bends_by) if shows else (0.0, math.inf)
    return ResidualTrend(
        tilt, std, slow.x[-3:], slow.std[-3:], float(smoothed), float(smoothed_std), lean, speed,
        *_circular(time, velocity - error, error, both, fast), over_ground, over_bed.std[OVER_GROUND],
    )  # fmt: skip


def _known(moving: Array, rates: Array, slope: Array, body_from_enu: Array) -> Array:
    """Columns (N, 3, 13) of what a calibration may have left, by velocity, turn rate, acceleration (N, 3), body."""
    known = np.zeros((len(moving), 3, len(KNOWN)))
    known[:, :, :3] = skew(moving)
    known[:, 0, 3], known[:, 1, 4] = moving[:, 0], moving[:, 1]
    known[:, :, 5:8] = skew(rates)
    known[:, :, 8] = slope
    known[:, :, 9:12] = body_from_enu
    known[:, :, 12] = cross(moving, body_from_enu[:, :, 2])
    return known


def _beside(time: Array, values: Array, starts: Index) -> Array:
    """Means of the stretches before and after that of each value (N, 3), as far as these are near."""
    at, of_each = _means(time, starts), _means(values, starts)
    near = (np.diff(at) < 2.0 * MEAN_S).astype(float)[:, None]
    before, after = np.vstack([[[0.0]], near]), np.vstack([near, [[0.0]]])
    around = before * np.roll(of_each, 1, axis=0) + after * np.roll(of_each, -1, axis=0)
    alone = before + after == 0.0
    means = np.where(alone, of_each, around / np.where(alone, 1.0, before + after))
    return np.repeat(means, np.diff(starts, append=len(time)), axis=0)


def reference_lag_s(estimate: Estimate, parameters: Parameters) -> float:
    """By what (s) the reference lags behind the DVL, as it was found."""
    own = dict(zip(estimate.state_names, estimate.state.tolist(), strict=True))
    return parameters.reference_time_offset - parameters.dvl_time_offset - own.get("time_offset", 0.0)


def is_insignificant(estimate: Estimate) -> bool:
    """Whether a calibration finds nothing to correct but a lag.

    One that knows no two angles has found nothing either way, and a filter of the DVL shows no lever arm of its own.
    """
    terms = MODELS[estimate.model].error_terms_from_state
    found = np.abs(terms @ estimate.state)
    std = np.sqrt(np.diag(terms @ estimate.recording_covariance @ terms.T))
    if (found > np.maximum([NO_ANGLE] * 3 + [NO_SCALE] * 3, BY_CHANCE * std)).any() or np.sort(std[:3])[1] > NO_ANGLE:
        return False
    arm, own = estimate.std_of(*ARM), dict(zip(estimate.state_names, estimate.state.tolist(), strict=True))
    return arm is None or not (np.abs([own[name] for name in ARM]) > np.maximum(NO_ARM_M, BY_CHANCE * arm)).any()


def std_along(estimate: Estimate, parameters: Parameters) -> Array:
    """σ (3,) of what a bias along each axis of the body looks like: scale ahead, and turns (rad) in pitch and yaw."""
    terms, dvl_from_body = MODELS[estimate.model].error_terms_from_state, parameters.rotation_dvl_from_body
    p = terms @ estimate.recording_covariance @ terms.T
    ahead = dvl_from_body[:, 0] ** 2
    turned = np.diag(dvl_from_body.T @ p[:3, :3] @ dvl_from_body)
    return np.sqrt([float(ahead @ p[3:, 3:] @ ahead), turned[2], turned[1]])


def moving_bed(found: ResidualTrend | None, estimate: Estimate) -> Reason | None:
    """Return the reason against a calibration over a bed that moves; None where it is not seen to.

    A calibration whose own constant error of the reference holds most of that velocity is only marginal.
    """
    if found is None:
        return None
    size = float(np.linalg.norm(found.over_ground))
    if size < MOVES_FROM_MPS or (np.abs(found.over_ground) < SURELY * found.over_ground_std).all():
        return None
    own = [estimate.state_of(name) for name in OFFSETS]
    is_held = float(np.linalg.norm(found.over_ground - own)) < 0.5 * size
    course = math.degrees(math.atan2(*found.over_ground)) % 360.0
    moves = finding("BED_MOVES", millimetres=1000.0 * size, course=course, std=float(f"{size:.1g}"))
    return moves.weighed(Severity.MARGINAL if is_held else Severity.REJECT)


def residual_warnings(
    found: ResidualTrend | None,
    of_positions: bool = False,
    lag_s: float = 0.0,
    is_nil: bool = False,
    along: Sequence[float] | Array = (0.0, 0.0, 0.0),
) -> list[Reason]:
    """What to say of it, as bad as it is to the verdict.

    of_positions: the reference's velocities are differences of positions, which smooths them by their interval.
    lag_s, is_nil, along: as of `reference_lag_s`, `is_insignificant` and `std_along`.
    """
    if found is None:
        return []
    least = FOLLOWED_BY_POSITIONS if of_positions else 0.0
    seconds = math.sqrt(2.0 * abs(found.smoothed))
    lags_so = lag_s > max(LEAST_LAG_S, seconds / LAGS_WITHIN) and lag_s < LAGS_WITHIN * seconds
    filter_from = FILTER_SHOWN_LAGGING if lags_so else FILTER_SHOWN
    is_filter = not of_positions and found.smoothed > filter_from * found.smoothed_std
    surely = FOLLOWED_BY_FILTER if is_filter else FOLLOWED_SURELY
    if found.circular > max(surely * found.circular_std, least):
        return [finding("CIRCULAR_REFERENCE", seconds=found.circular_s).weighed(Severity.REJECT)]
    if is_filter and lags_so and is_nil and found.smoothed > FILTER_SHOWN * found.smoothed_std:
        return [finding("FILTER_FINDS_NOTHING", late=lag_s).weighed(Severity.REJECT)]
    is_ours = of_positions and found.smoothed > 0.0
    is_smoothed = abs(found.smoothed) > SURELY_SMOOTHED * found.smoothed_std
    if is_smoothed and seconds > (TOO_SMOOTH_S if is_ours else SMOOTHED_FROM_S):
        word = Severity.REJECT if seconds > TOO_SMOOTH_S and not is_ours else Severity.MARGINAL
        # what else it follows then comes of that
        return [finding("VELOCITY_SMOOTHED", name=_smoothed_one(found), seconds=seconds).weighed(word)]
    said = []
    for axis, name in enumerate(("roll", "pitch")):
        share, std = float(found.tilt[axis]), float(found.tilt_std[axis])
        if abs(share) > max(SURELY * std, NOT_FOLLOWED):
            off = abs(share * float(found.lean[axis]))
            word = Severity.REJECT if off > WRONG_FROM or abs(share) > WRONG_SIGN_FROM else Severity.MARGINAL
            found_tilt = finding("TILT_NOT_FOLLOWED", axis=name, share=share, std=std, off=math.degrees(off))
            said.append(found_tilt.weighed(word))
        elif std > TILT_SHOWN and abs(float(found.lean[axis])) > WRONG_FROM:
            said.append(finding("TILT_NOT_SHOWN", axis=name, lean=math.degrees(abs(float(found.lean[axis])))))
    size = np.abs(found.bias)
    shown = (size > NAMED_FROM * found.bias_std) & (size > SAID_FROM * found.speed)
    if shown.any():
        axes = ", ".join(
            f"{axis} {1000.0 * found.bias[i]:+.0f} ± {1000.0 * found.bias_std[i]:.0f}"
            for i, axis in enumerate("xyz")
            if shown[i]
        )
        turned = float(size[shown].max()) / found.speed
        is_sure = size > SURELY_BIASED * found.bias_std
        is_wrong = size - found.bias_std > np.maximum(WRONG_FROM, WITHIN * np.asarray(along)) * found.speed
        word = Severity.REJECT if (shown & is_wrong).any() and (shown & is_sure).any() else Severity.MARGINAL
        said.append(finding("DVL_BIAS", axes=axes, degrees=math.degrees(turned)).weighed(word))
    elif float(found.bias_std[:2].max()) > BIAS_OPEN:
        share = SEEN_BIAS / found.speed
        said.append(finding("ONE_SPEED", off=SEEN_BIAS, degrees=math.degrees(share), percent=100.0 * share))
    return said


def _smoothed_one(found: ResidualTrend) -> str:
    return "reference" if found.smoothed > 0.0 else "DVL"


def _fitted(
    time: Array, columns: Array, error: Array, likely: Array, together: Sequence[int] = QUICK_STRETCHES
) -> _Fit | None:
    """Of error (N, 3) = columns (N, 3, n) x; None for too few stretches of time."""
    stretch = np.floor((time - time[0]) / STRETCH_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(stretch, prepend=-1))
    if len(starts) < ENOUGH:
        return None
    n = columns.shape[2]
    rest = error
    for _ in range(ROUNDS):
        square = (rest**2).sum(axis=1)
        level = max(float(median(square)), QUIETEST_MPS**2)
        weight = 1.0 / np.maximum(square / (OUTLYING**2 * level), 1.0)
        weighted = columns * weight[:, None, None]
        flat, z = columns.reshape(-1, n), error.reshape(-1)
        prior = level / 3.0 / likely**2
        p = np.linalg.inv(weighted.reshape(-1, n).T @ flat + np.diag(prior))
        x = p @ (weighted.reshape(-1, n).T @ z)
        rest = error - columns @ x
    scores = np.add.reduceat(np.einsum("nij,ni->nj", weighted, rest), starts, axis=0)
    # an axis at a time: of hours of data all of it at once is a tenth of a gigabyte
    each_axis = [np.add.reduceat((weighted[:, axis] @ p) ** 2, starts, axis=0) for axis in range(3)]
    told = np.sum(each_axis, axis=0)
    # what is not looked for may be there as far as it is likely, and the data do not say that it is not
    beside = p[:, : len(KNOWN)] * (prior * likely)[: len(KNOWN)]
    std = of_few(alike_of(told[None])[0] - 1.0) * _std(p @ scores.T, together)
    return _Fit(x, np.sqrt(std**2 + (beside**2).sum(axis=1)), p, weight, rest, starts)


def _std(scatter: Array, together: Sequence[int]) -> Array:
    """σ (n,) by what each of M stretches, or so many together, say (n, M): the largest, for noise lasts."""
    n, m = scatter.shape
    sums = [scatter[:, : m // k * k].reshape(n, -1, k).sum(axis=2) for k in together if m >= 2 * k]
    return np.sqrt(np.max([(each**2).sum(axis=1) for each in sums], axis=0) * (m / (m - 1.0)))


def _circular(time: Array, dvl: Array, error: Array, columns: Array, fit: _Fit) -> tuple[float, float, float]:
    """Share of the DVL's noise (velocity (N, 3), body) that the reference still holds, its σ, and over how long, s.

    What the samples around do not foretell of a velocity holds some of their noise. The error is taken against its own
    samples around by the same shares: the DVL's noise is then the same in both, as far as waves leave it so. What else
    is in it goes with that; the columns hold the DVL's noise themselves, so they are not taken off.
    """
    step = float(median(np.diff(time)))
    if step > SLOWEST_S or len(time) < 4 * FORETOLD_BY:
        return 0.0, math.inf, 0.0
    new, rest = (np.zeros_like(dvl) for _ in range(2))
    for axis, values in enumerate((dvl - dvl.mean(axis=0)).T):
        shares = _not_foretold(values)
        for filtered, each in ((new, values), (rest, error[:, axis])):
            filtered[FORETOLD_BY:-FORETOLD_BY, axis] = np.correlate(each, shares, "valid")
    most = NEW_AT_MOST * robust_std(new)
    # nor is a sample foretold by those that are not at its own distances
    is_gap = np.append(0.0, np.abs(np.diff(time) - step) > 0.5 * step)
    new[np.convolve(is_gap, np.ones(2 * FORETOLD_BY), "same") > 0.5] = 0.0
    noise = np.clip(new, -most, most)
    weight = fit.weight * ((new == noise) & (new != 0.0)).all(axis=1)  # neither clipped, nor at an end

    def without_columns(values: Array) -> Array:
        weighted = fit.weight[:, None] * values
        return np.asarray(values - columns @ (fit.p @ np.einsum("nij,ni->j", columns, weighted)))

    now = without_columns(noise)
    level = np.maximum(np.einsum("n,ni,ni->i", weight, now, now), 1e-18)

    def without_now(values: Array) -> Array:
        return np.asarray(values - now * (np.einsum("n,ni,ni->i", weight, now, values) / level))

    rest, found = without_now(rest), []
    for seconds in FORGOTTEN_S:
        for late in (0.0, seconds):  # that lag is taken for a late clock, and off
            past = without_now(without_columns(_followed(noise, step, seconds, late)))
            square = float(np.einsum("n,ni,ni->", weight, past, past))
            if square <= 0.0:
                continue
            share = float(np.einsum("n,ni,ni->", weight, past, rest)) / square
            scores = np.add.reduceat(weight * (past * (rest - share * past)).sum(axis=1), fit.starts)
            found.append((share, math.hypot(float(_std(scores[None] / square, QUICK_STRETCHES)[0]), OF_WAVES), seconds))
    return max(found, key=lambda each: each[0] / each[1], default=(0.0, math.inf, 0.0))


def _followed(noise: Array, step: float, seconds: float, late: float) -> Array:
    """What a filter that forgets over so many seconds makes of noise (N, 3) before, or, late, until then, but now."""
    kernel = np.exp(-np.arange(math.ceil(3.0 * seconds / step) + 1.0) * step / seconds)
    ahead = int(late / step + 1e-6)
    kernel[ahead] = 0.0
    made = np.column_stack([np.convolve(np.append(each, np.zeros(ahead)), kernel) for each in noise.T])
    return np.asarray(made[ahead : ahead + len(noise)])


def _not_foretold(values: Array) -> Array:
    """Shares (2 `FORETOLD_BY` + 1,) by which the samples around one of (N,), and it, make what is new in it."""
    around = np.lib.stride_tricks.sliding_window_view(values, 2 * FORETOLD_BY + 1)
    own, others = around[:, FORETOLD_BY], np.delete(around, FORETOLD_BY, axis=1)
    square = others.T @ others
    level = 1e-9 * float(np.trace(square)) / FORETOLD_BY + 1e-18  # a simulator's may be foretold exactly
    return np.insert(-np.linalg.solve(square + level * np.eye(2 * FORETOLD_BY), others.T @ own), FORETOLD_BY, 1.0)


def _mean(time: Array, values: Array, seconds: float) -> Array:
    """Means over so many seconds about each time (N,) of values (N, ...)."""
    first = np.searchsorted(time, time - 0.5 * seconds)
    end = np.searchsorted(time, time + 0.5 * seconds, side="right")
    sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    number = (end - first).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray((sums[end] - sums[first]) / number)


def _at(time: Array, values: Array, later: float) -> Array:
    """Values (N, 3) so many seconds later than each time (N,)."""
    return np.column_stack([np.interp(time + later, time, column) for column in values.T])


def _means(values: Array, starts: Index) -> Array:
    """Means of values (N, ...) from each start to the next."""
    number = np.diff(starts, append=len(values)).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.add.reduceat(values, starts, axis=0) / number)


def _turned(rotation: Array, vectors: Array) -> Array:
    """(N, 3) vectors by rotations (N, 3, 3)."""
    return np.asarray(np.matmul(rotation, vectors[..., None])[..., 0])
