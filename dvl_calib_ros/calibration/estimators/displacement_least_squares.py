"""Least squares over legs of dead reckoning between position fixes (docs/models.md, "positions").

Fixes minus dead reckoning are y = o + J θ + noise, with a constant o per stretch. θ: misalignment (3) rad, scale, lever
arm (3) m beyond the parameters', delay of the fixes s, and heading deviation (5). Means over blocks of time are fitted
together. Their noise is white, plus a Gauss-Markov process (multipath, sound speed of a beacon) and a random walk (dead
reckoning). A grid of hypotheses has their sizes and memories, and the result is the mixture by evidence, so σ includes
the unknown noise.

Shapes: N fixes, B blocks of time, A axes, G hypotheses of the noise, F sizes of the heading deviation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..models.own import heading_cycles
from ..models.parameters import Parameters
from ..numerics.block_covariance import BLOCK_S
from ..numerics.error_model import correction_matrix
from ..numerics.frames import Array, rotation_from_quaternion
from ..numerics.kalman import GaussianState
from ..numerics.robust import FEWEST_VALUES, ROBUST_PASSES, median, robust_std
from ..numerics.samples import Index, Mask, Stamps

N_ERRORS, N_THETA = 4, 13
SCALE, ARM, LATE, DEVIATION, DRIFT = 3, slice(4, 7), 7, slice(8, 13), 12
# Largest number of blocks of time, which are solved together.
MAX_BLOCKS = 120
# A fix is an outlier beyond this number of σ from the median of its neighbours to either side.
OUTLIER_Z, NEIGHBOURS = 4.5, 6
# Limit for outliers that last for minutes, in σ from the median of a stretch; drift spreads evenly and stays below.
LASTING_OUTLIER_Z = 6.0
# Huber's bound, σ, in the first fit.
HUBER_Z = 1.5
# Noise hypotheses. LASTING: variance of the Gauss-Markov process relative to a block's white variance; LASTING_S: its
# memory, s. WALKED: variance of the random walk after WALK_S, relative to the same. DEVIATES: heading deviation
# relative to its parameter.
LASTING: tuple[float, ...] = (0.3, 1.5, 8.0, 40.0)
LASTING_S: tuple[float, ...] = (20.0, 60.0, 180.0, 600.0)
WALKED, WALK_S = (0.0, 0.03, 0.3, 3.0), 300.0
DEVIATES: Array = np.array([0.3, 1.0, 3.0])
_DEVIATES_LOG: Array = -0.5 * (np.log(DEVIATES) / np.log(4.0)) ** 2
# Prior σ of the heading coefficients (one cycle, two cycles, drift over the run), relative to the same parameter.
_SHARE: Array = np.array([1.0, 1.0, 0.7, 0.7, 1.0])
# Variance of a stretch's constant, relative to the largest other variance.
FREE_VARIANCE = 1e5
# Smallest noise of a fix against dead reckoning, m: in turns a delayed fix is wrong by half the acceleration times
# delay².
MIN_NOISE_M = 0.3


class DisplacementFit(NamedTuple):
    """Fit of all legs: θ (13,) with covariance, and which fixes (N,) are used."""

    state: GaussianState
    used: Mask

    @property
    def errors(self) -> GaussianState:
        """Misalignment and scale, the states of `positions`."""
        return GaussianState(self.state.x[:N_ERRORS], self.state.p[:N_ERRORS, :N_ERRORS])


class _Linear(NamedTuple):
    """y (N, 3) m and its columns (N, 3, 13), linear in absolute θ."""

    y: Array
    columns: Array


class _Blocks(NamedTuple):
    """Means over B blocks of time.

    seconds, stretch, weight: (B,), the weight being the number of fixes. y: (A, B), columns: (A, B, 13), for A axes.
    """

    seconds: Array
    stretch: Index
    weight: Array
    y: Array
    columns: Array


def white_noise(legs: Legs, lever_arm: Array) -> float:
    """Return the white σ (m) per axis of fixes against their neighbours, with the nominal mounting.

    lever_arm: (3,) m configured DVL position from the reference point, body frame.
    """
    step = np.diff(legs.seconds)[:, None]
    position = legs.position + legs.rotation @ lever_arm
    moved = np.diff(position, axis=0) - 0.5 * step * (legs.velocity[1:] + legs.velocity[:-1])
    return float(robust_std(moved[:, :2]).mean()) / math.sqrt(2.0)


def _prior(errors: GaussianState, parameters: Parameters, span_s: float) -> GaussianState:
    """Return the prior of θ. errors: prior of misalignment and scale. span_s: duration of the run."""
    p = parameters
    deviation = p.heading_deviation_std * _SHARE / np.array([1.0, 1.0, 1.0, 1.0, max(span_s, 60.0)])
    rest = np.array([*[p.initial_std_lever_arm] * 3, p.initial_std_time_offset, *np.maximum(deviation, 1e-12)])
    covariance = np.diag(np.concatenate([np.zeros(N_ERRORS), rest**2]))
    covariance[:N_ERRORS, :N_ERRORS] = errors.p
    return GaussianState(np.concatenate([errors.x, np.zeros(len(rest))]), covariance)


def _solved(legs: Legs, parameters: Parameters, errors: GaussianState) -> DisplacementFit | None:
    """Return the fit, or None for too few fixes; see `solve`."""
    if len(legs.seconds) < FEWEST_VALUES:
        return None
    prior = _prior(errors, parameters, float(np.ptp(legs.seconds)))
    std = np.sqrt(np.diag(prior.p))
    theta = prior.x
    for _ in range(ROBUST_PASSES):
        theta = _first_fit(linear_about(legs, theta, parameters), legs, std)
    used = np.ones(len(legs.seconds), dtype=bool)
    state = GaussianState(theta, prior.p)
    for _ in range(ROBUST_PASSES):
        linear = linear_about(legs, state.x, parameters)
        residual = linear.y - linear.columns @ state.x
        used = _no_outliers(residual[:, :2], legs.stretch)
        if used.sum() < FEWEST_VALUES:
            return None
        state = _fitted(_means(linear, legs, used, (0, 1)), prior)
        has_height = used & np.isfinite(legs.variance[:, 2]) & (np.abs(legs.position[:, 2]) < FARTHEST_M)
        if has_height.sum() >= FEWEST_VALUES:
            state = _fitted(_means(linear, legs, has_height, (2,)), state)
    _add_unmodelled(state, float(np.ptp(legs.seconds)), parameters)
    return DisplacementFit(state, used)


def _add_unmodelled(state: GaussianState, span_s: float, parameters: Parameters) -> None:
    """Add two effects to the covariance: an unknown pitch ε changes the scale by ε²/2, a heading drift the yaw.

    The drift's zero is unknown within the duration of the run, span_s.
    """
    x, p = state
    _, across, up = parameters.rotation_dvl_from_body.T
    p[SCALE, SCALE] += 0.75 * float(across @ p[:3, :3] @ across) ** 2
    p[:3, :3] += np.outer(up, up) * (x[DRIFT] ** 2 + p[DRIFT, DRIFT]) * span_s**2 / 12.0


def solve(legs: Legs, parameters: Parameters, errors: GaussianState) -> DisplacementFit | None:
    """Fit all legs; None if they are too few or numbers diverge. errors: prior of misalignment and scale."""
    try:
        fit = _solved(legs, parameters, errors)
    except np.linalg.LinAlgError:
        return None
    return fit if fit is not None and np.isfinite(fit.state.p).all() and np.isfinite(fit.state.x).all() else None


def linear_about(legs: Legs, theta: Array, parameters: Parameters) -> _Linear:
    """Linearise fixes minus dead reckoning about θ (13,): the residual of θ is y - columns @ θ."""
    t = parameters.rotation_dvl_from_body

    def matrix(errors: Array) -> Array:
        """Return C (3, 3), body from measured DVL velocity."""
        return correction_matrix(errors[:3], np.full(3, errors[3]), t)

    errors = theta[:N_ERRORS]
    nudges = 1e-5 * np.eye(N_ERRORS)
    slopes = [(matrix(errors + nudge) - matrix(errors - nudge)) / 2e-5 for nudge in nudges]
    columns = np.empty((len(legs.seconds), 3, N_THETA))
    for state, slope in enumerate(slopes):
        columns[:, :, state] = np.einsum("nabc,bc->na", legs.way, slope)
    # misalignment about level axes hardly changes horizontal displacements, so it must not gain information from them
    up = t[:, 2]
    columns[:, :2, :3] = (columns[:, :2, :3] @ up)[..., None] * up
    columns[:, :, ARM] = -legs.rotation
    columns[:, :, LATE] = -legs.velocity
    columns[:, :, DEVIATION] = -legs.drifted
    # the drift is centred in time; its mean belongs to yaw
    east, north, _ = np.einsum("nabc,bc->na", legs.way, t.T).T
    columns[:, 0, DRIFT] -= north * legs.seconds.mean()
    columns[:, 1, DRIFT] += east * legs.seconds.mean()
    way = np.einsum("nabc,bc->na", legs.way, matrix(errors))
    y = legs.position - way + legs.rotation @ np.array(parameters.lever_arm)
    return _Linear(y + columns[:, :, :N_ERRORS] @ errors, columns)


def _first_fit(linear: _Linear, legs: Legs, std: Array) -> Array:
    """Fit θ (13,) to the horizontal axes by least squares with white noise and Huber weights. std: (13,) prior σ."""
    _, stretch = np.unique(legs.stretch, return_inverse=True)
    rows = np.concatenate([linear.y[:, :2, None], linear.columns[:, :2]], axis=2)  # (N, 2, 14)
    weight, level = np.ones((len(rows), 2)), 1.0
    theta = np.zeros(N_THETA)
    for _ in range(12):
        centred = rows - _stretch_means(rows, weight, stretch)[stretch]
        flat = centred.reshape(-1, N_THETA + 1)
        products = (flat * weight.reshape(-1, 1)).T @ flat  # of y and the columns
        theta = np.linalg.solve(products[1:, 1:] + np.diag((level / std) ** 2), products[1:, 0])
        deviation = np.abs(centred[..., 0] - centred[..., 1:] @ theta)
        level = max(float(median(deviation.ravel())) * 1.4826, 1e-6)  # σ, m
        weight = np.minimum(1.0, HUBER_Z * level / np.maximum(deviation, 1e-9))
    return theta


def _stretch_means(rows: Array, weight: Array, stretch: Index) -> Array:
    """Return weighted means (S, 2, 14) of rows (N, 2, 14) per stretch. weight: (N, 2). stretch: (N,)."""
    sums, total = np.zeros((int(stretch[-1]) + 1, *rows.shape[1:])), np.zeros((int(stretch[-1]) + 1, 2))
    np.add.at(sums, stretch, rows * weight[..., None])
    np.add.at(total, stretch, weight)
    return np.asarray(sums / total[..., None])


def _no_outliers(residual: Array, stretch: Index) -> Mask:
    """Return which of N fixes are no outliers, from their residuals (N, 2) m and stretches (N,)."""
    n = len(residual)
    around = np.clip(np.arange(n)[:, None] + np.arange(-NEIGHBOURS, NEIGHBOURS + 1), 0, n - 1)
    neighbours = np.where((stretch[around] == stretch[:, None])[..., None], residual[around], np.nan)
    from_neighbours = residual - np.nanmedian(neighbours, axis=1)
    is_near = np.abs(from_neighbours) < OUTLIER_Z * np.maximum(robust_std(from_neighbours), 1e-6)
    from_stretch = residual.copy()
    for number in np.unique(stretch):
        in_stretch = stretch == number
        from_stretch[in_stretch] -= median(residual[in_stretch])
    in_reach = np.abs(from_stretch) < LASTING_OUTLIER_Z * np.maximum(robust_std(from_stretch), MIN_NOISE_M)
    return np.asarray((is_near & in_reach).all(axis=1))


def _means(linear: _Linear, legs: Legs, use: Mask, axes: tuple[int, ...]) -> _Blocks:
    """Average the fixes in `use` (N,) over blocks of time, along some axes (0: east, 1: north, 2: up)."""
    used = np.flatnonzero(use)
    seconds = legs.seconds[used]
    length = max(BLOCK_S, float(seconds[-1] - seconds[0]) / MAX_BLOCKS)
    number = np.floor((seconds - seconds[0]) / length).astype(np.intp)
    key = np.stack([legs.stretch[used], number])
    first = np.flatnonzero(np.concatenate([[True], (np.diff(key, axis=1) != 0).any(axis=0)]))
    weight = np.diff(np.append(first, len(used))).astype(float)

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, first, axis=0)) / weight.reshape(-1, *[1] * (values.ndim - 1))

    y, columns = mean(linear.y[used][:, axes]), mean(linear.columns[used][:, axes])
    stretch = legs.stretch[used][first]
    # a stretch of one block holds no information, as its constant is free; of very many stretches the longest suffice
    numbers, sizes = np.unique(stretch, return_counts=True)
    longest = np.argsort(-sizes, kind="stable")
    sufficient = np.cumsum(sizes[longest]) <= max(2 * MAX_BLOCKS, int(sizes.max()))
    kept = np.isin(stretch, numbers[longest[(sizes[longest] > 1) & sufficient]])  # blocks
    return _Blocks(mean(seconds)[kept], stretch[kept], weight[kept], y[kept].T, columns[kept].swapaxes(0, 1))


def _hypotheses(blocks: _Blocks) -> Array:
    """Return noise covariances (G, B, B) of the hypotheses, relative to the white variance of a fix."""
    seconds, white = blocks.seconds, 1.0 / blocks.weight
    usual = float(median(white))
    is_same_stretch = blocks.stretch[:, None] == blocks.stretch
    starts = np.array([seconds[blocks.stretch == number][0] for number in blocks.stretch])
    walk = np.where(is_same_stretch, np.minimum(seconds[:, None], seconds) - starts[:, None], 0.0) / WALK_S
    apart = np.abs(seconds[:, None] - seconds)
    lasting = [np.zeros_like(apart)] + [size * np.exp(-apart / tau) for size in LASTING for tau in LASTING_S]
    covariance = np.array([process + size * walk for process in lasting for size in WALKED]) * usual + np.diag(white)
    largest = np.diagonal(covariance, axis1=1, axis2=2).max(axis=1)
    return np.asarray(covariance + FREE_VARIANCE * largest[:, None, None] * is_same_stretch)


class _NormalEquations(NamedTuple):
    """Sums of squares and products over all blocks and axes, for G noise covariances and a white variance of 1.

    square: (G,) of y.
    vector: (G, 13) of y and the columns.
    information: (G, 13, 13) of the columns.
    log_det: (G,) log determinant of the noise covariance of all axes.
    freedom: degrees of freedom.
    """

    square: Array
    vector: Array
    information: Array
    log_det: Array
    freedom: float


def _normal_equations(blocks: _Blocks) -> _NormalEquations:
    """Whiten the blocks by each noise hypothesis, and sum their products."""
    axes, n, _ = blocks.columns.shape
    root = np.linalg.cholesky(_hypotheses(blocks))
    log_det = 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
    rows = np.concatenate([blocks.y[:, :, None], blocks.columns], axis=2)
    rows = rows - rows.mean(axis=1, keepdims=True)  # a common constant has no effect, as each stretch has a free one
    # axes side by side, (B, A 14), so that each of the large factors is used once
    whitened = np.linalg.solve(root, np.concatenate(list(rows), axis=1)[None])  # NumPy 1 takes (B, k) for vectors
    parts = np.split(whitened, axes, axis=2)
    square = np.asarray(sum(part.swapaxes(1, 2) @ part for part in parts))
    freedom = float(axes * (n - len(np.unique(blocks.stretch))))
    return _NormalEquations(square[:, 0, 0], square[:, 0, 1:], square[:, 1:, 1:], axes * log_det, freedom)


class _Hypothesised(NamedTuple):
    """Posteriors for G noise hypotheses and F sizes of the heading deviation.

    x (G, F, 13), p (G, F, 13, 13), log_evidence (G, F). freedom: (G, F) that determine the white variance of a fix.
    """

    x: Array
    p: Array
    freedom: Array
    log_evidence: Array


def _posteriors(sums: _NormalEquations, prior: GaussianState) -> _Hypothesised:
    """Return the posterior of θ under each pair of hypotheses, by iterating on the white variance (m²) of a fix."""
    sizes = np.ones((len(DEVIATES), N_THETA))
    sizes[:, DEVIATION] = DEVIATES[:, None]
    known = np.linalg.inv(prior.p * sizes[:, :, None] * sizes[:, None, :])
    variance = np.maximum(sums.square / max(sums.freedom, 1.0), MIN_NOISE_M**2)[:, None] * np.ones(len(DEVIATES))
    for _ in range(6):
        from_data = sums.information[:, None] / variance[..., None, None]
        information = known + from_data
        vector = (known @ prior.x) + sums.vector[:, None] / variance[..., None]
        x = np.linalg.solve(information, vector[..., None])[..., 0]
        residual_square = sums.square[:, None] - 2.0 * (x * sums.vector[:, None]).sum(axis=-1)
        residual_square = residual_square + np.einsum("gfi,gij,gfj->gf", x, sums.information, x)
        n_estimated = np.trace(np.linalg.solve(information, from_data), axis1=2, axis2=3)
        variance = np.maximum(residual_square / np.maximum(sums.freedom - n_estimated, 1.0), MIN_NOISE_M**2)
    information = known + sums.information[:, None] / variance[..., None, None]
    from_prior = x - prior.x
    log_evidence = -0.5 * (
        residual_square / variance
        + np.einsum("gfi,fij,gfj->gf", from_prior, known, from_prior)
        + sums.freedom * np.log(variance)
        + sums.log_det[:, None]
        + np.linalg.slogdet(information)[1]
        - np.linalg.slogdet(known)[1]
    )
    freedom = np.maximum(sums.freedom - n_estimated, 3.0)
    return _Hypothesised(x, np.linalg.inv(information), freedom, log_evidence + _DEVIATES_LOG)


def _fitted(blocks: _Blocks, prior: GaussianState) -> GaussianState:
    """Return the posterior from the mixture of all hypotheses."""
    if not len(blocks.seconds):
        return prior
    posteriors = _posteriors(_normal_equations(blocks), prior)
    weight = np.exp(posteriors.log_evidence - posteriors.log_evidence.max())
    weight /= weight.sum()
    mean = np.einsum("gf,gfi->i", weight, posteriors.x)
    spread = posteriors.x - mean
    # variance of Student's t, as few degrees of freedom determine the white variance
    p = posteriors.p * (posteriors.freedom / (posteriors.freedom - 2.0))[..., None, None]
    total = np.einsum("gf,gfij->ij", weight, p) + np.einsum("gf,gfi,gfj->ij", weight, spread, spread)
    return GaussianState(mean, 0.5 * (total + total.T))


# Largest distance of a vehicle from its start, m.
FARTHEST_M = 1e6
# Longest interval of DVL samples that is integrated, s.
LONGEST_STEP_S = 3.0
# Fixes are accepted with delays up to this at least, s, after the DVL's samples of their time.
LATEST_FIX_S = 60.0
# Shortest interval of fixes, ns; denser ones have the same errors.
SHORTEST_FIX_NS = 950_000_000


class Fixes(NamedTuple):
    """N position fixes in order of stamps.

    stamps_ns: (N,).
    position: (N, 3) east, north, up, m, from any origin.
    variance: (N, 3) m², nan if not given.
    """

    stamps_ns: Stamps
    position: Array
    variance: Array

    @staticmethod
    def none() -> Fixes:
        """Return no fixes."""
        return Fixes(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))

    def part(self, at: slice | Index) -> Fixes:
        """Return the rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Fixes(*columns)

    def joined(self, others: Fixes) -> Fixes:
        """Return these fixes followed by others."""
        columns: list[Any] = [np.concatenate(pair) for pair in zip(self, others, strict=True)]
        return Fixes(*columns)


class Legs(NamedTuple):
    """N fixes, each with the dead reckoning to it since its stretch began. A stretch has no DVL gap.

    seconds: (N,) since the first DVL sample.
    stretch: (N,) number.
    way: (N, 3, 3, 3) m, W = ∫ R ⊗ v dt over axes of ENU, body and DVL; a correction matrix M displaces by W : M.
    drifted: (N, 3, 5) m/rad, derivative of the displacement by the heading deviation, the drift being per second.
    rotation: (N, 3, 3) ENU from body.
    velocity: (N, 3) m/s ENU, nominal mounting.
    position, variance: (N, 3) of the fixes.
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
        """Return the rows of a slice or of indices."""
        columns: list[Any] = [column[at] for column in self]
        return Legs(*columns)


# Coefficients of the heading deviation: one and two cycles, and a drift. N_SUMS: integrated columns, the way and its
# derivatives by these.
N_HEADING = 5
N_SUMS = 27 + 3 * N_HEADING
_WAY, _DRIFTED = slice(0, 27), slice(27, N_SUMS)


class _Passed(NamedTuple):
    """DVL samples since the last processed fix. sums: integrals up to each. rates: integrands, per second."""

    seconds: Array
    stretch: Index
    sums: Array
    rates: Array
    quaternion: Array


_NO_ROWS = _Passed(
    np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros((0, N_SUMS)), np.zeros((0, N_SUMS)), np.zeros((0, 4))
)


class DeadReckoning:
    """Integral of DVL samples as they arrive, interpolated at fixes."""

    def __init__(self, rotation_dvl_from_body: Array, latest_fix_s: float = 0.0) -> None:
        """Start without samples. latest_fix_s: largest delay of a fix after the DVL's samples of its time."""
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
        """Add fixes, without those out of order, too far away, or too dense."""
        kept = []
        sound = np.asarray((np.abs(fixes.position[:, :2]) < FARTHEST_M).all(axis=1))
        for row, stamp_ns in enumerate(fixes.stamps_ns.tolist()):
            if sound[row] and stamp_ns >= self._newest_fix_ns + SHORTEST_FIX_NS:
                self._newest_fix_ns = stamp_ns
                kept.append(row)
        if kept:
            self._waiting = self._waiting.joined(fixes.part(np.array(kept)))

    def add_rows(self, stamps_ns: Stamps, velocity_dvl: Array, quaternion: Array) -> None:
        """Add the next DVL samples: velocity (N, 3) m/s, DVL axes; quaternion (N, 4), ENU from body."""
        known = np.isfinite(velocity_dvl).all(axis=1) & np.isfinite(quaternion).all(axis=1)
        if not known.any():
            return
        self._new.append((stamps_ns[known], velocity_dvl[known], quaternion[known]))

    def _sum_up(self) -> None:
        """Integrate the new samples."""
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
        """Return the integrands (N, 42), per second."""
        rotation = rotation_from_quaternion(quaternion)
        n = len(seconds)
        way = rotation[:, :, :, None] * velocity[:, None, None, :]
        east, north, _ = (rotation @ (velocity @ self._body_from_dvl.T)[..., None])[..., 0].T
        terms = np.column_stack([heading_cycles(rotation), seconds])
        turned = np.column_stack([-north, east, np.zeros(n)])
        return np.concatenate(
            [way.reshape(n, 27), (turned[:, :, None] * terms[:, None, :]).reshape(n, 3 * N_HEADING)], axis=1
        )

    def legs(self) -> Legs:
        """Return the legs to all fixes that DVL samples have passed."""
        self._sum_up()
        self._pass_fixes()
        newest_s = self._rows.seconds[-1] if len(self._rows.seconds) else 0.0
        # fixes with a longer delay are dropped
        kept = max(int(np.searchsorted(self._rows.seconds, newest_s - self._latest_s)) - 1, 0)
        columns: list[Any] = [column[kept:] for column in self._rows]
        self._rows = _Passed(*columns)
        if len(self._done) > 1:
            columns = [np.concatenate(column) for column in zip(*self._done, strict=True)]
            self._done = [Legs(*columns)]
        return self._done[0] if self._done else _no_legs()

    def _pass_fixes(self) -> None:
        """Interpolate the integrals at the fixes that DVL samples have passed."""
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
        integrals = sums[after - 1] + share * (sums[after] - sums[after - 1])
        n, nearest = len(at_s), after - (share[:, 0] < 0.5)
        rotation = rotation_from_quaternion(quaternion[nearest])
        rate = (rates[after - 1] + share * (rates[after] - rates[after - 1]))[:, _WAY].reshape(n, 3, 3, 3)
        velocity = np.einsum("nabc,bc->na", rate, self._body_from_dvl)
        way, drifted = integrals[:, _WAY].reshape(n, 3, 3, 3), integrals[:, _DRIFTED].reshape(n, 3, N_HEADING)
        self._done.append(Legs(at_s, stretch[after], way, drifted, rotation, velocity, fixes.position, fixes.variance))


def _no_legs() -> Legs:
    """Return an empty set of legs."""
    nothing = np.zeros((0, 3))
    turned = np.zeros((0, 3, N_HEADING))
    none = np.zeros(0, dtype=np.intp)
    return Legs(np.zeros(0), none, np.zeros((0, 3, 3, 3)), turned, np.zeros((0, 3, 3)), nothing, nothing, nothing)
