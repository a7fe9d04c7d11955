"""Gap and closure: size of the error and share that the effects explain, on held-out data.

Shapes: F samples, M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.assessment.dead_reckoning import SHORTEST_M, Drift, drift_over, ends_of_stretches, integration_steps
from ...calibration.numerics.frames import Array
from ..fit.cross_validation import fitted_without, folds_of
from ..fit.gauss_newton import Fit, Fitter
from ..fit.selection_criteria import SlowNoiseOfFit, blocks_of
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis
from ..noise.noise_level import stretches_of
from ..search.effect_selection import EffectSelection
from ..search.unexplained import Unexplained

RESAMPLES = 1000
# Least ratio of the unexplained error to the noise that is reported
REPORTED_RATIO = 0.3
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Gap:
    """Vector RMS, m/s, per sample, on held-out data. before, after: errors without and with effects, noise included.

    noise_floor: from the residual, white and slow.
    closure: share of the noise-free error's energy that a correction with the estimated effects closes, nan without a
      gap.
    interval: its 95 per cent, given the parameters' covariance.
    not_explained: noise-free error that is not closed; without effects, the part of `after` above the noise.
    reported: noise reported by the messages, None if missing.
    by_recording: before and after per recording, if several.
    left_open: predicted part of `after` above the noise, in stretches that alone determine parts of the effects.
    drift: of straight dead reckoning with errors before and after, None for a vehicle at rest.
    """

    before: float
    after: float
    noise_floor: float
    closure: float
    interval: tuple[float, float]
    not_explained: float = 0.0
    reported: float | None = None
    by_recording: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    left_open: float = 0.0
    drift: tuple[Drift, Drift] | None = None

    @property
    def not_expected(self) -> float:
        """Return the part of `after` above the noise and beyond the part left open, m/s."""
        return float(np.sqrt(max(0.0, self.after**2 - self.noise_floor**2 - self.left_open**2)))

    @property
    def fails_held_out(self) -> bool:
        """Return whether the effects leave more than the noise in stretches that they were not fitted to."""
        return self.not_expected > self.noise_floor

    @property
    def is_reported(self) -> bool:
        """Return whether the unexplained error is large enough beside the noise to be reported."""
        return self.not_explained > REPORTED_RATIO * self.noise_floor

    @property
    def beyond_noise(self) -> float:
        """Return the gap: `before` above the noise, m/s."""
        return float(np.sqrt(max(0.0, self.before**2 - self.noise_floor**2)))


@dataclass(frozen=True)
class HeldOutResiduals:
    """Held-out errors (F, 3) m/s without (`before`) and with effects (`after`). block: (F,) index, for resampling.
    floor: (F, 3) (m/s)², noise variance of both. left_open: (F,) (m/s)², error variance with effects, predicted from
    the parameters' covariance."""

    before: Array
    after: Array
    floor: Array
    block: Integers
    left_open: Array | float = 0.0

    def squares(self) -> tuple[Array, Array, Array]:
        """Return the squares of before, after and floor, summed per block (B,), (m/s)²."""
        return self._summed(self.before**2), self._summed(self.after**2), self._summed(self.floor)

    def undetermined_of_blocks(self) -> Array:
        """Return sums of left_open per block (B,), (m/s)², bounded by the block's excess over the noise."""
        _, after, floor = self.squares()
        left_open = np.bincount(self.block, np.broadcast_to(self.left_open, len(self.block)))
        return np.asarray(np.minimum(left_open, np.maximum(after - floor, 0.0)))

    def _summed(self, squares: Array) -> Array:
        return np.asarray(np.bincount(self.block, squares.sum(axis=1)), dtype=float)


def held_out(selection: EffectSelection, unexplained: Unexplained) -> HeldOutResiduals:
    """Return the errors before and after the effects of a selection on held-out data.

    One recording is split into alternating stretches. Of several, each is held out, and parameters per recording
    (`Effect.per_recording`) are fitted to it. All parameters are re-estimated in the composed model.
    """
    fitter, fit = selection.fitter, selection.fit
    problem = fitter.problem
    before, after = np.zeros((len(problem.bin_of), 3)), np.zeros((len(problem.bin_of), 3))
    hypotheses = selection.base.hypothesis, fit.hypothesis
    fold_of, left_open = folds_of(problem), np.zeros(len(problem.bin_of))
    for fold, each in fitted_without(fitter, hypotheses, fit.noise, fold_of):
        at = (fold_of == fold)[problem.bin_of]
        for fitted, into in zip(each, (before, after), strict=True):
            if len(problem.recordings) > 1:
                of_day = _fit_own_parameters(selection, fitted.hypothesis, fold)
                into[at] = only(problem, fold).errors(of_day.seen)
            else:
                into[at] = problem.errors(fitted.seen)[at]
        left_open[at] = _undetermined(each[-1])[problem.bin_of][at]
    block = stretches_of(problem)[problem.bin_of]
    return HeldOutResiduals(before, after, noise_floor(selection, unexplained), block, left_open)


def _undetermined(fit: Fit) -> Array:
    """Return the predicted error variance (M,), (m/s)², of a fit per bin. Parameters per recording do not contribute:
    they are fitted to the held-out recording."""
    of_day = [each.effect.per_recording and fit.n_recordings > 1 for each in fit.hypothesis.parameters()]
    return np.asarray(_error_variance(fit, np.flatnonzero(~np.array([False] * 6 + of_day))).sum(axis=1))


def _error_variance(fit: Fit, at: Integers) -> Array:
    """Return the error variance (M, A), (m/s)², that a fit's parameters `at` cause."""
    columns, covariance = fit.columns[:, :, at], fit.system.covariance()[np.ix_(at, at)]
    return np.asarray(np.einsum("map,map->ma", columns @ covariance, columns))


def _fit_own_parameters(selection: EffectSelection, hypothesis: Hypothesis, recording: int) -> Fit:
    """Fit one recording's own parameters, with the vehicle's parameters from the others."""
    problem, noise = selection.fitter.problem, selection.fit.noise
    alone = only(problem, recording)
    of_it = problem.rows_of[recording]
    outliers = selection.fitter.outliers
    fitter = Fitter(alone, outliers[of_it] if isinstance(outliers, np.ndarray) else outliers)
    values = {name: (per[recording],) for name, per in hypothesis.values.items()}
    return fitter.fit(replace(hypothesis, values=values), noise.part(of_it), only_own=True)


def only(problem: Problem, recording: int) -> Problem:
    """Return the problem of one recording."""
    streams, grid = problem.recordings[recording], problem.grids[recording]
    return Problem((streams,), problem.rotation_dvl_from_body, problem.lever_arm, (grid,), problem.measured)


def measure_gap(selection: EffectSelection, residuals: HeldOutResiduals) -> Gap:
    """Return held-out errors before and after the effects of a selection."""
    before, after, floor = residuals.squares()
    left_open, n = residuals.undetermined_of_blocks(), len(residuals.before)
    squares = [float(part.sum()) / n for part in (before, after, floor)]
    return Gap(
        before=float(np.sqrt(squares[0])),
        after=float(np.sqrt(squares[1])),
        noise_floor=float(np.sqrt(squares[2])),
        closure=np.nan,
        interval=(np.nan, np.nan),
        not_explained=float(np.sqrt(max(0.0, squares[1] - squares[2]))),
        reported=_reported(selection.fitter.problem),
        by_recording=_by_recording(selection.fitter.problem, residuals),
        left_open=float(np.sqrt(left_open.sum() / n)),
        drift=_drift(selection, residuals),
    )


def _drift(selection: EffectSelection, residuals: HeldOutResiduals) -> tuple[Drift, Drift] | None:
    """Return the drift of dead reckoning on one course with the errors before and after, None for a short track."""
    problem = selection.fitter.problem
    step_s = integration_steps(problem.sample_time)
    speed = problem.sampled(selection.fit.seen, lambda motion: motion.speed)[problem.bin_of]
    distance = np.cumsum(speed * step_s)
    if distance[-1] < SHORTEST_M:
        return None
    ends = ends_of_stretches(distance)
    astray = (np.cumsum(each[:, :2] * step_s[:, None], axis=0) for each in (residuals.before, residuals.after))
    before, after = (drift_over(each, distance, ends) for each in astray)
    return before, after


def with_closure(gap: Gap, selection: EffectSelection, covariance: Array, residuals: HeldOutResiduals) -> Gap:
    """Return a gap with its closure, by the distribution of the true parameters about the estimated ones.

    covariance: (6 + p, 6 + p) of the parameters, which are drawn around their estimates. The closure of a draw is one
    minus residual over error in energy, without what a calibration absorbs. Equivalent hypotheses, and that of
    `EffectSelection.wider`, which slow noise explains as well, get equal shares of the draws.
    """
    fit, fitter = selection.fit, selection.fitter
    if not fit.effects:
        return gap
    p, blocks = fit.columns.shape[2] - 6, int(blocks_of(fitter.problem).max()) + 1
    rows = len(fit.residual)
    calibration = np.linalg.qr(fit.columns[:, :, :6].reshape(-1, 6))[0]

    def without_calibration(values: Array) -> Array:
        flat = values.reshape(calibration.shape[0], -1)
        return np.asarray(flat - calibration @ (calibration.T @ flat))

    rng = np.random.default_rng(0)
    spread = np.sqrt(blocks / rng.chisquare(blocks, (RESAMPLES, 1)))  # the scatter of blocks is itself estimated
    draws = spread * rng.multivariate_normal(np.zeros(p), covariance[6:, 6:], RESAMPLES, method="eigh")
    columns = without_calibration(fit.columns[:, :, 6:])
    others = [rival for selected in selection.selected for rival in selected.rivals]
    if selection.wider is not None and len(selection.wider.effects) > len(fit.effects):
        others.append(selection.wider)
    residuals_of = [fit.residual, *(fitter.evaluated(each)[1] for each in others)]
    truths = [without_calibration(selection.base.residual - each)[:, 0] for each in residuals_of]
    corrected = truths[0]
    of_cause = rows * max(remainder(selection, residuals), gap.not_expected**2 if gap.fails_held_out else 0.0)
    gram = columns.T @ columns
    shares = []
    for true_error, step in zip(truths, np.array_split(draws, len(truths)), strict=True):
        energy = np.einsum("ri,ij,rj->r", step, gram, step)
        residual, error = true_error - corrected, true_error
        of_residual, of_error = (each @ each - 2.0 * step @ (columns.T @ each) + energy for each in (residual, error))
        share = 1.0 - (of_residual + of_cause) / np.maximum(of_error + of_cause, 1e-300)
        shares.append(np.clip(share, -1.0, 1.0))
    low, high = np.percentile(np.concatenate(shares), [2.5, 97.5]).tolist()
    closure = float(np.median(shares[0]))
    not_explained = gap.beyond_noise * float(np.sqrt(1.0 - closure))
    return replace(gap, closure=closure, interval=(low, high), not_explained=not_explained)


def remainder(selection: EffectSelection, residuals: HeldOutResiduals) -> float:
    """Return the energy per sample, (m/s)², of the residual of all data beyond the noise."""
    residual = selection.fitter.problem.errors(selection.fit.seen)
    return max(0.0, float(((residual**2).sum() - residuals.floor.sum()) / len(residual)))


def _by_recording(problem: Problem, residuals: HeldOutResiduals) -> dict[str, tuple[float, float]]:
    """Return each recording's held-out RMS error (m/s) before and after correcting the effects.

    Empty for a single recording.
    """
    if len(problem.recordings) == 1:
        return {}
    of_sample = problem.recording_of[problem.bin_of]
    found = {}
    for index, recording in enumerate(problem.recordings):
        at = of_sample == index
        rms = [float(np.sqrt((each[at] ** 2).sum(axis=1).mean())) for each in (residuals.before, residuals.after)]
        found[recording.name] = (rms[0], rms[1])
    return found


def closure_alone(selection: EffectSelection, gap: Gap, name: str) -> float:
    """Return the share of the gap that one effect closes without the others, fitted to all data."""
    fitter, fit = selection.fitter, selection.fit
    chosen = [effect for effect in fit.effects if effect.name == name]
    if len(fit.effects) == 1 or not np.isfinite(gap.closure):
        return gap.closure
    alone = fitter.fit_kept(fit.hypothesis.with_effects(chosen, fit.n_recordings, {}), fit.noise)
    without, with_it = (
        float(np.mean((fitter.problem.errors(each.seen) ** 2).sum(axis=1))) for each in (selection.base, alone)
    )
    return float(np.clip((without - with_it) / max(gap.beyond_noise**2, 1e-300), -1.0, 1.0))


# ------------------------------------------------------------------ noise


def noise_floor(selection: EffectSelection, unexplained: Unexplained) -> Array:
    """Return the noise variance (F, 3), (m/s)², of each sample.

    It is the squared residual, so that noise common to the errors before and after cancels in the gap. The energy of an
    unknown cause is subtracted; that absorbed by parameters is added.
    """
    problem, fit = selection.fitter.problem, selection.fit
    residual, measured = problem.errors(fit.seen), np.array(problem.measured)
    floor, of_sample = residual**2, problem.recording_of[problem.bin_of]
    if unexplained.found:
        slow = SlowNoiseOfFit.of_fit(problem, fit)
        without = slow.with_nuisance(problem, slow.noise, unexplained.clearest).left
        explained = (slow.left**2 - without**2).sum(axis=1)
        for recording in range(len(problem.recordings)):
            at = of_sample == recording
            systematic = max(0.0, float(explained[problem.recording_of == recording].mean()))
            energy = float(floor[at].sum(axis=1).mean())
            floor[at] *= max(0.0, energy - systematic) / max(energy, 1e-300)
    floor[:, measured] += _error_variance(fit, np.arange(fit.columns.shape[2]))[problem.bin_of]
    return floor


def high_frequency_variance(time: Array, values: Array) -> tuple[Array, float]:
    """Return the variance (3,) of values (F, 3) from sample to sample, and its relative standard error.

    From second differences: 6 times the variance of white noise, almost zero for slow variation.
    """
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    second = values[2:] - 2.0 * values[1:-1] + values[:-2]
    adjacent = np.abs(time[2:] - time[:-2] - 2.0 * interval) < interval
    second = second[adjacent]
    if len(second) < 4:
        return np.zeros(values.shape[1]), np.inf
    return np.asarray((second**2).mean(axis=0) / 6.0), float(np.sqrt(3.9 / len(second)))


def reported_std(problem: Problem) -> list[Array] | None:
    """Return the reported standard deviation (3,) m/s of the difference per recording, None if any is missing."""
    found = []
    for recording in problem.recordings:
        if recording.dvl_std is None or recording.reference_std is None:
            return None
        measured = np.array(problem.measured)
        reference = np.where(measured, recording.reference_std, 0.0)
        found.append(np.where(measured, np.hypot(np.mean(recording.dvl_std), np.mean(reference[measured])), 0.0))
    return found


def _reported(problem: Problem) -> float | None:
    reported = reported_std(problem)
    return None if reported is None else float(np.sqrt(np.mean([np.sum(each**2) for each in reported])))
