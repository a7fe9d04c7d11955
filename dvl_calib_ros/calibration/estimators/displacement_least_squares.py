"""Least squares over legs of dead reckoning between position fixes.

Fixes less dead reckoning are y = o + J θ + noise, with o a constant of each stretch. Means over blocks of time are
fitted at once; the noise of these is white, beside it a Gauss-Markov process (multipath, a beacon's sound speed) and a
random walk (dead reckoning's own), as large and as lasting as a grid of hypotheses says. What is told is the mixture of
all, by their evidence, so σ holds that the noise is not known either. θ: misalignment (3) rad, scale, lever arm (3) m
beyond the parameters', by what fixes are late s, and coefficients (5) of the heading's deviation.

The way between two times is ∫ R M v dt, with R the attitude (ENU from body), v the DVL's velocity and M the matrix that
corrects it. It is linear in M, whatever the angles are: so W = ∫ R ⊗ v dt is summed up once, and serves any M.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.error_model import correction_matrix
from ..numerics.frames import Array, rotation_from_quaternion
from ..numerics.kalman import GaussianState
from ..numerics.robust import median, robust_std
from ..numerics.samples import Index, Mask, Stamps

N_ERRORS, N_THETA = 4, 13
SCALE, ARM, LATE, DEVIATION, DRIFT = 3, slice(4, 7), 7, slice(8, 13), 12
# Fewer fixes prove nothing.
ENOUGH_FIXES = 12
# Blocks of time, s: as many as can be solved at once, and no shorter.
SHORTEST_BLOCK_S, MOST_BLOCKS = 10.0, 120
# A fix is an outlier from so many σ beyond the median of so many neighbours to either side.
OUTLYING, NEIGHBOURS = 4.5, 6
# Outliers that last for minutes are so many σ from the median of all of a stretch: what drifts is spread evenly.
FAR_OUT = 6.0
# Huber's bound, σ, of a first fit.
HUBER = 1.5
# Hypotheses of noise: variance that lasts, of a block's white one, and for how long, s; variance that a random walk
# gathers in WALK_S; how much larger a heading deviates than the parameter says (as of `heading_states`).
LASTING: tuple[float, ...] = (0.3, 1.5, 8.0, 40.0)
LASTING_S: tuple[float, ...] = (20.0, 60.0, 180.0, 600.0)
WALKED, WALK_S = (0.0, 0.03, 0.3, 3.0), 300.0
DEVIATES: Array = np.array([0.3, 1.0, 3.0])
_DEVIATES_LOG: Array = -0.5 * (np.log(DEVIATES) / np.log(4.0)) ** 2
_SHARE: Array = np.array([1.0, 1.0, 0.7, 0.7, 1.0])
# A stretch begins anywhere: its variance, of the largest other.
ANYWHERE = 1e5
ROUNDS = 3
# No fix is better beside dead reckoning, m: in turns, late ones are off by half the acceleration times their lateness².
FINEST_M = 0.3


class DisplacementFit(NamedTuple):
    """What was found. state: θ (13,) and its covariance. noise_m: standard deviation of a fix, white, of one axis.
    used (N,): which fixes are no outliers."""

    state: GaussianState
    noise_m: float
    used: Mask

    @property
    def errors(self) -> GaussianState:
        """Misalignment and scale: D1's states."""
        return GaussianState(self.state.x[:N_ERRORS], self.state.p[:N_ERRORS, :N_ERRORS])


class _Linear(NamedTuple):
    """y (N, 3) m and its columns (N, 3, 13) for absolute θ."""

    y: Array
    columns: Array


class _Blocks(NamedTuple):
    """Means over B blocks. seconds, stretch, weight (B,): fixes in each. y (A, B), columns (A, B, 13) of A axes."""

    seconds: Array
    stretch: Index
    weight: Array
    y: Array
    columns: Array


def white_noise(legs: Legs) -> float:
    """Standard deviation of a fix beside its neighbours, m, of one axis, as the DVL is mounted."""
    step = np.diff(legs.seconds)[:, None]
    moved = np.diff(legs.position, axis=0) - 0.5 * step * (legs.velocity[1:] + legs.velocity[:-1])
    return float(robust_std(moved[:, :2]).mean()) / math.sqrt(2.0)


def _prior(errors: GaussianState, parameters: Parameters, span_s: float) -> GaussianState:
    """θ before any data."""
    p = parameters
    deviation = p.heading_deviation_std * _SHARE / np.array([1.0, 1.0, 1.0, 1.0, max(span_s, 60.0)])
    rest = np.array([*[p.initial_std_lever_arm] * 3, p.initial_std_time_offset, *np.maximum(deviation, 1e-12)])
    covariance = np.diag(np.concatenate([np.zeros(N_ERRORS), rest**2]))
    covariance[:N_ERRORS, :N_ERRORS] = errors.p
    return GaussianState(np.concatenate([errors.x, np.zeros(len(rest))]), covariance)


def _solved(legs: Legs, parameters: Parameters, errors: GaussianState) -> DisplacementFit | None:
    """As `solve`; None where there are too few. errors: misalignment and scale before them."""
    if len(legs.seconds) < ENOUGH_FIXES:
        return None
    prior = _prior(errors, parameters, float(np.ptp(legs.seconds)))
    std = np.sqrt(np.diag(prior.p))
    theta = prior.x
    for _ in range(ROUNDS):
        theta = _first_fit(linear_about(legs, theta, parameters), legs, std)
    used = np.ones(len(legs.seconds), dtype=bool)
    state = GaussianState(theta, prior.p)
    noise = 0.0
    for _ in range(ROUNDS):
        linear = linear_about(legs, state.x, parameters)
        left = linear.y - linear.columns @ state.x
        used = _no_outliers(left[:, :2], legs.stretch)
        if used.sum() < ENOUGH_FIXES:
            return None
        state, noise = _fitted(_means(linear, legs, used, (0, 1)), prior)
        has_height = used & np.isfinite(legs.variance[:, 2]) & (np.abs(legs.position[:, 2]) < FARTHEST_M)
        if has_height.sum() >= ENOUGH_FIXES:
            state, _ = _fitted(_means(linear, legs, has_height, (2,)), state)
    # nobody knows when a heading that drifts is right; and by a pitch ε that is not known the way is longer by ε²/2
    span_s, (x, p) = float(np.ptp(legs.seconds)), state
    _, across, up = parameters.rotation_dvl_from_body.T
    p[SCALE, SCALE] += 0.75 * float(across @ p[:3, :3] @ across) ** 2
    p[:3, :3] += np.outer(up, up) * (x[DRIFT] ** 2 + p[DRIFT, DRIFT]) * span_s**2 / 12.0
    return DisplacementFit(state, noise, used)


def solve(legs: Legs, parameters: Parameters, errors: GaussianState) -> DisplacementFit | None:
    """What all legs tell; None where they are too few, or numbers run away. errors: misalignment and scale before."""
    try:
        fit = _solved(legs, parameters, errors)
    except np.linalg.LinAlgError:
        return None
    return fit if fit is not None and np.isfinite(fit.state.p).all() and np.isfinite(fit.state.x).all() else None


def linear_about(legs: Legs, theta: Array, parameters: Parameters) -> _Linear:
    """Fixes less dead reckoning about θ, as linear in it."""
    t = parameters.rotation_dvl_from_body

    def matrix(errors: Array) -> Array:
        return correction_matrix(errors[:3], np.full(3, errors[3]), t)

    errors = theta[:N_ERRORS]
    nudges = 1e-5 * np.eye(N_ERRORS)
    slopes = [(matrix(errors + each) - matrix(errors - each)) / 2e-5 for each in nudges]
    columns = np.empty((len(legs.seconds), 3, N_THETA))
    for place, slope in enumerate(slopes):
        columns[:, :, place] = np.einsum("nabc,bc->na", legs.way, slope)
    # of the way's horizontal a misalignment about the level axes is next to nothing, and nothing is to be claimed by it
    up = t[:, 2]
    columns[:, :2, :3] = (columns[:, :2, :3] @ up)[..., None] * up
    columns[:, :, ARM] = -legs.rotation
    columns[:, :, LATE] = -legs.velocity
    columns[:, :, DEVIATION] = -legs.drifted
    # a drift has no mean over the run: yaw has that
    east, north, _ = np.einsum("nabc,bc->na", legs.way, t.T).T
    columns[:, 0, DRIFT] -= north * legs.seconds.mean()
    columns[:, 1, DRIFT] += east * legs.seconds.mean()
    way = np.einsum("nabc,bc->na", legs.way, matrix(errors))
    y = legs.position - way + legs.rotation @ np.array(parameters.lever_arm)
    return _Linear(y + columns[:, :, :N_ERRORS] @ errors, columns)


def _first_fit(linear: _Linear, legs: Legs, std: Array) -> Array:
    """θ (13,) by least squares with Huber's weights, noise being white."""
    _, stretch = np.unique(legs.stretch, return_inverse=True)
    rows = np.concatenate([linear.y[:, :2, None], linear.columns[:, :2]], axis=2)  # (N, 2, 14)
    weight, level = np.ones((len(rows), 2)), 1.0
    theta = np.zeros(N_THETA)
    for _ in range(12):
        centred = rows - _of_stretches(rows, weight, stretch)[stretch]
        each = centred.reshape(-1, N_THETA + 1)
        square = (each * weight.reshape(-1, 1)).T @ each
        theta = np.linalg.solve(square[1:, 1:] + np.diag((level / std) ** 2), square[1:, 0])
        left = np.abs(centred[..., 0] - centred[..., 1:] @ theta)
        level = max(float(median(left.ravel())) * 1.4826, 1e-6)
        weight = np.minimum(1.0, HUBER * level / np.maximum(left, 1e-9))
    return theta


def _of_stretches(rows: Array, weight: Array, stretch: Index) -> Array:
    """Weighted means (S, 2, 14) of rows (N, 2, 14), weight (N, 2), by the stretch (N,) that each is of."""
    sums, total = np.zeros((int(stretch[-1]) + 1, *rows.shape[1:])), np.zeros((int(stretch[-1]) + 1, 2))
    np.add.at(sums, stretch, rows * weight[..., None])
    np.add.at(total, stretch, weight)
    return np.asarray(sums / total[..., None])


def _no_outliers(left: Array, stretch: Index) -> Mask:
    """Which of N fixes are none, by what is left of them (N, 2) m."""
    n = len(left)
    places = np.clip(np.arange(n)[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS + 1), 0, n - 1)
    near = np.where((stretch[places] == stretch[:, None])[..., None], left[places], np.nan)
    away = left - np.nanmedian(near, axis=1)
    near_enough = np.abs(away) < OUTLYING * np.maximum(robust_std(away), 1e-6)
    centred = left.copy()
    for each in np.unique(stretch):
        own = stretch == each
        centred[own] -= median(left[own])
    in_reach = np.abs(centred) < FAR_OUT * np.maximum(robust_std(centred), FINEST_M)
    return np.asarray((near_enough & in_reach).all(axis=1))


def _means(linear: _Linear, legs: Legs, use: Mask, axes: tuple[int, ...]) -> _Blocks:
    """Means over blocks of time, of fixes in use."""
    at = np.flatnonzero(use)
    seconds = legs.seconds[at]
    length = max(SHORTEST_BLOCK_S, float(seconds[-1] - seconds[0]) / MOST_BLOCKS)
    number = np.floor((seconds - seconds[0]) / length).astype(np.intp)
    key = np.stack([legs.stretch[at], number])
    first = np.flatnonzero(np.concatenate([[True], (np.diff(key, axis=1) != 0).any(axis=0)]))
    weight = np.diff(np.append(first, len(at))).astype(float)

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, first, axis=0)) / weight.reshape(-1, *[1] * (values.ndim - 1))

    y, columns = mean(linear.y[at][:, axes]), mean(linear.columns[at][:, axes])
    stretch = legs.stretch[at][first]
    # one block alone says nothing, as its stretch begins anywhere; of very many stretches the longest say enough
    names, sizes = np.unique(stretch, return_counts=True)
    longest = np.argsort(-sizes, kind="stable")
    kept = longest[(sizes[longest] > 1) & (np.cumsum(sizes[longest]) <= max(2 * MOST_BLOCKS, int(sizes.max())))]
    of_use = np.isin(stretch, names[kept])
    return _Blocks(mean(seconds)[of_use], stretch[of_use], weight[of_use], y[of_use].T, columns[of_use].swapaxes(0, 1))


def _hypotheses(blocks: _Blocks) -> Array:
    """Covariances (G, B, B) of the noise, of a fix's white variance."""
    t, white = blocks.seconds, 1.0 / blocks.weight
    usual = float(median(white))
    same = blocks.stretch[:, None] == blocks.stretch
    starts = np.array([t[blocks.stretch == each][0] for each in blocks.stretch])
    walk = np.where(same, np.minimum(t[:, None], t) - starts[:, None], 0.0) / WALK_S
    apart = np.abs(t[:, None] - t)
    lasting = [np.zeros_like(apart)] + [size * np.exp(-apart / tau) for size in LASTING for tau in LASTING_S]
    each = np.array([one + more * walk for one in lasting for more in WALKED]) * usual + np.diag(white)
    most = np.diagonal(each, axis1=1, axis2=2).max(axis=1)
    return np.asarray(each + ANYWHERE * most[:, None, None] * same)


def _fitted(blocks: _Blocks, prior: GaussianState) -> tuple[GaussianState, float]:
    """Posterior by the mixture of all hypotheses, and white noise of one fix, m."""
    if not len(blocks.seconds):
        return prior, 0.0
    covariance = _hypotheses(blocks)
    axes, n, _ = blocks.columns.shape
    root = np.linalg.cholesky(covariance)
    log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    rows = np.concatenate([blocks.y[:, :, None], blocks.columns], axis=2)
    rows = rows - rows.mean(axis=1, keepdims=True)  # of a stretch that begins anywhere it is no matter
    # axes beside one another, (B, A 14): each of the many large roots is taken apart once for all
    whitened = np.linalg.solve(root, np.concatenate(list(rows), axis=1)[None])  # NumPy 1 takes (B, k) for vectors
    parts = np.split(whitened, axes, axis=2)
    square = np.asarray(sum(part.swapaxes(1, 2) @ part for part in parts))
    yy, by, told = square[:, 0, 0], square[:, 0, 1:], square[:, 1:, 1:]
    freedom = float(axes * (n - len(np.unique(blocks.stretch))))
    # hypotheses of the deviation beside those of the noise: (G, F, ...)
    wider = np.ones((len(DEVIATES), N_THETA))
    wider[:, DEVIATION] = DEVIATES[:, None]
    known = np.linalg.inv(prior.p * wider[:, :, None] * wider[:, None, :])
    level = np.maximum(yy / max(freedom, 1.0), FINEST_M**2)[:, None] * np.ones(len(DEVIATES))
    for _ in range(6):
        information = known + told[:, None] / level[..., None, None]
        vector = (known @ prior.x) + by[:, None] / level[..., None]
        x = np.linalg.solve(information, vector[..., None])[..., 0]
        left = yy[:, None] - 2.0 * (x * by[:, None]).sum(axis=-1) + np.einsum("gfi,gij,gfj->gf", x, told, x)
        spent = np.trace(np.linalg.solve(information, told[:, None] / level[..., None, None]), axis1=2, axis2=3)
        level = np.maximum(left / np.maximum(freedom - spent, 1.0), FINEST_M**2)
    information = known + told[:, None] / level[..., None, None]
    p = np.linalg.inv(information)
    away = x - prior.x
    misfit = left / level + np.einsum("gfi,fij,gfj->gf", away, known, away)
    likely = -0.5 * (
        misfit
        + freedom * np.log(level)
        + axes * log_det[:, None]
        + np.linalg.slogdet(information)[1]
        - np.linalg.slogdet(known)[1]
    )
    likely = likely + _DEVIATES_LOG
    share = np.exp(likely - likely.max())
    share /= share.sum()
    mean = np.einsum("gf,gfi->i", share, x)
    apart = x - mean
    # the level is found by so few: Student's t
    few = np.maximum(freedom - spent, 3.0)
    p = p * (few / (few - 2.0))[..., None, None]
    total = np.einsum("gf,gfij->ij", share, p) + np.einsum("gf,gfi,gfj->ij", share, apart, apart)
    return GaussianState(mean, 0.5 * (total + total.T)), float(np.sqrt((share * level).sum()))


# No vehicle is so far from where it began, m.
FARTHEST_M = 1e6
# Between DVL samples that are further apart, s, the way is not known.
LONGEST_STEP_S = 3.0
# So much later than the DVL's samples of its time, s, a fix may come at least.
LATEST_FIX_S = 60.0
# Fixes that come faster say no more: their errors are alike.
SHORTEST_FIX_NS = 950_000_000


class Fixes(NamedTuple):
    """N positions in order of stamps.

    stamps_ns (N,). position (N, 3): east, north, up, m, from any origin. variance (N, 3) m², nan where not given.
    """

    stamps_ns: Stamps
    position: Array
    variance: Array

    @staticmethod
    def none() -> Fixes:
        """No fix."""
        return Fixes(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def part(self, at: slice | Index) -> Fixes:
        """The rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Fixes(*columns)

    def joined(self, others: Fixes) -> Fixes:
        """These and then others."""
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self, others, strict=True)]
        return Fixes(*columns)


class Legs(NamedTuple):
    """N fixes, and the way to each since its stretch began, in which the DVL had no gap.

    seconds (N,) since the first DVL sample. stretch (N,): number of it. way (N, 3, 3, 3): W, of axes of ENU, body and
    DVL, m. drifted (N, 3, 5): by what the way turns with the coefficients of the heading's deviation as `HeadingStates`
    has them, of time per second, m/rad. rotation (N, 3, 3): ENU from body. position, variance (N, 3): of the fixes.
    velocity (N, 3) m/s in ENU, as mounted.
    """

    seconds: Array
    stretch: Index
    way: Array
    drifted: Array
    rotation: Array
    velocity: Array
    position: Array
    variance: Array

    def part(self, at: slice | Index) -> Legs:
        """The rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Legs(*columns)


# Columns of what is summed up: way, and what a deviation of the heading turns it by.
# Coefficients of the heading's deviation: one and two cycles, and a drift.
N_HEADING = 5
N_SUMS = 27 + 3 * N_HEADING
_WAY, _DRIFTED = slice(0, 27), slice(27, N_SUMS)


class _Passed(NamedTuple):
    """DVL samples since the last fix that is done. sums: up to each; rates: of them, per second."""

    seconds: Array
    stretch: Index
    sums: Array
    rates: Array
    quaternion: Array


_NO_ROWS = _Passed(
    np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros((0, N_SUMS)), np.zeros((0, N_SUMS)), np.zeros((0, 4))
)


class DeadReckoning:
    """Sums up the way as DVL samples come, and says where fixes found it."""

    def __init__(self, rotation_dvl_from_body: Array, latest_fix_s: float = 0.0) -> None:
        """latest_fix_s: so much later than the DVL's samples of its time a fix may come."""
        self._latest_s = max(LATEST_FIX_S, latest_fix_s)
        self._body_from_dvl = rotation_dvl_from_body.T
        self._epoch_ns: int | None = None
        self._stretch = 0
        self._rows: _Passed = _NO_ROWS
        self._new: list[tuple[Stamps, Array, Array]] = []
        self._waiting = Fixes.none()
        self._done: list[Legs] = []
        self._newest_fix_ns = -(2**62)

    def add_fixes(self, fixes: Fixes) -> None:
        """Take fixes; those out of order are left out, and of faster ones so many as say something."""
        kept = []
        sound = np.asarray((np.abs(fixes.position[:, :2]) < FARTHEST_M).all(axis=1))
        for row, stamp_ns in enumerate(fixes.stamps_ns.tolist()):
            if sound[row] and stamp_ns >= self._newest_fix_ns + SHORTEST_FIX_NS:
                self._newest_fix_ns = stamp_ns
                kept.append(row)
        if kept:
            self._waiting = self._waiting.joined(fixes.part(np.array(kept)))

    def add_rows(self, stamps_ns: Stamps, velocity_dvl: Array, quaternion: Array) -> None:
        """Take DVL samples that follow those before: velocity (N, 3) m/s, its axes; quaternion (N, 4) ENU from body."""
        known = np.isfinite(velocity_dvl).all(axis=1) & np.isfinite(quaternion).all(axis=1)
        if not known.any():
            return
        self._new.append((stamps_ns[known], velocity_dvl[known], quaternion[known]))

    def _sum_up(self) -> None:
        """Take what is new into the sums."""
        if not self._new:
            return
        stamps_ns, velocity_dvl, quaternion = (np.concatenate(column) for column in zip(*self._new, strict=True))
        self._new = []
        if self._epoch_ns is None:
            self._epoch_ns = int(stamps_ns[0])
        seconds = 1e-9 * (stamps_ns - self._epoch_ns)
        rates = self._rates(seconds, velocity_dvl, quaternion)
        before_s, _, before_sum, before_rate, _ = self._rows
        if not len(before_s):  # the first of all
            before_s, before_rate, before_sum = seconds[:1], rates[:1], np.zeros((1, N_SUMS))
        step = np.diff(np.concatenate([before_s[-1:], seconds]))
        breaks = step > LONGEST_STEP_S
        rate_before = np.concatenate([before_rate[-1:], rates[:-1]])
        moved = np.where(breaks[:, None], 0.0, 0.5 * step[:, None] * (rate_before + rates))
        sums = before_sum[-1] + np.cumsum(moved, axis=0)
        stretch = self._stretch + np.cumsum(breaks)
        self._stretch = int(stretch[-1])
        new = (seconds, stretch, sums, rates, quaternion)
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self._rows, new, strict=True)]
        self._rows = _Passed(*columns)

    def _rates(self, seconds: Array, velocity: Array, quaternion: Array) -> Array:
        """What is summed up, per second (N, 42)."""
        rotation = rotation_from_quaternion(quaternion)
        n = len(seconds)
        way = rotation[:, :, :, None] * velocity[:, None, None, :]
        east, north, _ = (rotation @ (velocity @ self._body_from_dvl.T)[..., None])[..., 0].T
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        terms = np.column_stack([np.sin(yaw), np.cos(yaw), np.sin(2.0 * yaw), np.cos(2.0 * yaw), seconds])
        turned = np.column_stack([-north, east, np.zeros(n)])
        return np.concatenate(
            [way.reshape(n, 27), (turned[:, :, None] * terms[:, None, :]).reshape(n, 3 * N_HEADING)], axis=1
        )

    def legs(self) -> Legs:
        """Of all fixes so far that DVL samples have passed."""
        self._sum_up()
        self._pass_fixes()
        newest_s = self._rows.seconds[-1] if len(self._rows.seconds) else 0.0
        # a fix that is later than this is not waited for
        kept = max(int(np.searchsorted(self._rows.seconds, newest_s - self._latest_s)) - 1, 0)
        columns: list[Any] = [column[kept:] for column in self._rows]
        self._rows = _Passed(*columns)
        if len(self._done) > 1:
            columns = [np.concatenate(column) for column in zip(*self._done, strict=True)]
            self._done = [Legs(*columns)]
        return self._done[0] if self._done else _no_legs()

    def _pass_fixes(self) -> None:
        seconds, stretch, sums, rates, quaternion = self._rows
        if len(seconds) < 2 or not len(self._waiting.stamps_ns):
            return
        at_s = 1e-9 * (self._waiting.stamps_ns - (self._epoch_ns or 0))
        passed = int(np.searchsorted(at_s, seconds[-1], side="right"))
        if not passed:
            return
        fixes, at_s = self._waiting.part(slice(passed)), at_s[:passed]
        self._waiting = self._waiting.part(slice(passed, None))
        after = np.clip(np.searchsorted(seconds, at_s), 1, len(seconds) - 1)
        known = (at_s >= seconds[0]) & (stretch[after] == stretch[after - 1])
        fixes, at_s, after = fixes.part(np.flatnonzero(known)), at_s[known], after[known]
        share = ((at_s - seconds[after - 1]) / (seconds[after] - seconds[after - 1]))[:, None]
        found = sums[after - 1] + share * (sums[after] - sums[after - 1])
        near = np.where(share < 0.5, after[:, None] - 1, after[:, None])[:, 0]
        n = len(at_s)
        rotation = rotation_from_quaternion(quaternion[near])
        rate = (rates[after - 1] + share * (rates[after] - rates[after - 1]))[:, _WAY].reshape(n, 3, 3, 3)
        velocity = np.einsum("nabc,bc->na", rate, self._body_from_dvl)
        way, drifted = found[:, _WAY].reshape(n, 3, 3, 3), found[:, _DRIFTED].reshape(n, 3, N_HEADING)
        self._done.append(Legs(at_s, stretch[after], way, drifted, rotation, velocity, fixes.position, fixes.variance))


def _no_legs() -> Legs:
    nothing = np.zeros((0, 3))
    turned = np.zeros((0, 3, N_HEADING))
    none = np.zeros(0, dtype=np.intp)
    return Legs(np.zeros(0), none, np.zeros((0, 3, 3, 3)), turned, np.zeros((0, 3, 3)), nothing, nothing, nothing)
