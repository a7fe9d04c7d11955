"""Results of an evaluation, as immutable plain data, and the error measures in them.

Array axes in the docstrings: S sets, C columns (uncalibrated, then the models), M models, W windows, L runs, Q seeds.
All velocities in m/s, angles in rad; nan if a model cannot run on the data (for example without attitude).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibration.models import MODELS
from ..calibration.numerics.distributions import normal_isf
from ..calibration.numerics.frames import Array, nearest_rotation
from ..verdict.answering import Answering

UNCALIBRATED = "uncalibrated"


def mean_of_known(values: Array, axis: int | tuple[int, ...]) -> Array:
    """Return the mean along axes without nan; nan if all values are."""
    known = np.isfinite(values)
    count = np.asarray(known.sum(axis=axis))
    total = np.asarray(np.where(known, values, 0.0).sum(axis=axis))
    return np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0)


class Improvement(NamedTuple):
    """Mean velocity error (m/s) without correction, and with the model that reduces it most."""

    model: str
    before: float
    after: float

    @staticmethod
    def of(models: Sequence[str], corrected: Array, uncorrected: Array) -> Improvement:
        """Return the improvement by the best of M models, from corrected (M, ...) and uncorrected (...) errors, m/s."""
        candidates = []
        for name, after in zip(models, corrected, strict=True):
            known = np.isfinite(after) & np.isfinite(uncorrected)
            if known.any():
                before = np.broadcast_to(uncorrected, known.shape)[known]
                candidates.append(Improvement(name, float(before.mean()), float(after[known].mean())))
        return min(candidates, key=lambda each: each.after - each.before, default=Improvement("", math.nan, math.nan))

    @property
    def verdict(self) -> str:
        """Answer: better, not_better or not_known."""
        return "not_known" if not self.model else "better" if self.after < self.before else "not_better"

    def sentence(self, what: str) -> str:
        """Return the sentence. what: bags or runs."""
        if not self.model:
            return f"Nothing could be calibrated and checked on other {what}."
        error = f"{self.model} leaves a velocity error of {self.after:.3f} m/s rms"
        return f"On the other {what}, {error}; without a calibration, {self.before:.3f}."


@dataclass(frozen=True)
class Failure:
    """An omitted result whose computation raised: one estimate of many, or a whole seed.

    what: a model, a baseline, or another computation.
    run: trajectory or set.
    combination, seed: None for all of them.
    why: the exception in one line.
    """

    what: str
    run: str
    combination: int | None
    why: str
    seed: int | None = None

    @staticmethod
    def of(error: Exception, what: str, run: str = "", combination: int | None = None) -> Failure:
        """Build from an exception."""
        text = " ".join(str(error).split())
        return Failure(what, run, combination, f"{type(error).__name__}: {text}" if text else type(error).__name__)

    def __str__(self) -> str:
        parts = [self.what, self.run]
        parts += [f"seed {self.seed}"] if self.seed is not None else []
        parts += [f"combination {self.combination}"] if self.combination is not None else []
        return f"{', '.join(part for part in parts if part)}: {self.why}"


@dataclass(frozen=True)
class CalibrationSet:
    """A set of the procedure: calibrate on the first window_s (None: all) of a run, evaluate on all other runs."""

    name: str
    calibration_run: str
    window_s: float | None


@dataclass(frozen=True)
class CalibrationRun:
    """A stretch of a trajectory for calibration, s from its start. heading_spread: circular std, rad."""

    trajectory: str
    from_s: float
    to_s: float
    heading_spread: float


@dataclass(frozen=True)
class Coverage:
    """Share of errors (estimate - truth) within the model's 68 % and 95 % intervals.

    model: name.
    state_names: the n error states (nuisance states have no truth).
    within_68, within_95: (n,) per state.
    pooled_68, pooled_95: over all states.
    n_errors: errors per state.
    mean_error, rms_error, mean_std: (n,).
    normalised_rms: rms of error / σ over all states: 1 for a correct σ, larger if σ is too small.
    """

    model: str
    state_names: tuple[str, ...]
    within_68: Array
    within_95: Array
    pooled_68: float
    pooled_95: float
    n_errors: int
    mean_error: Array
    rms_error: Array
    mean_std: Array
    normalised_rms: float = float("nan")


@dataclass(frozen=True)
class EachStudy:
    """Calibration on each of L runs with attitude, evaluated on all other trajectories.

    runs: (L,).
    avg_vrmse: (L, C, Q).
    yaw_observed: (L, M) share of combinations and seeds in which yaw is observable for the model.
    coverage: per model, over runs, combinations and seeds.
    """

    runs: tuple[CalibrationRun, ...]
    avg_vrmse: Array
    yaw_observed: Array
    coverage: tuple[Coverage, ...]

    def median(self, trajectories: Collection[str] | None = None) -> Array:
        """Return the median (C,) over runs (of these trajectories) of the mean over seeds, or nan."""
        rows = [i for i, run in enumerate(self.runs) if trajectories is None or run.trajectory in trajectories]
        if not rows:
            return np.full(self.avg_vrmse.shape[1], np.nan)
        return np.asarray(np.median(self.seed_mean[rows], axis=0))

    @property
    def run_names(self) -> list[str]:
        """Displayed names (L,) of the runs."""
        return [f"{run.trajectory} {run.from_s:.0f}–{run.to_s:.0f} s" for run in self.runs]

    @property
    def seed_mean(self) -> Array:
        """Avg.VRMSE (L, C), mean over the seeds."""
        return mean_of_known(self.avg_vrmse, -1)


@dataclass(frozen=True)
class HeldOut:
    """Hold-out verification of one model's calibration on one set.

    Velocity error (vector rms, m/s) against the reference, including its noise, on samples that the calibration did not
      use.
    uncorrected, corrected, predicted: rms over combinations of errors.
    verdict: the most frequent one.
    verdicts: count of each.
    """

    set_name: str
    model: str
    verdict: str
    uncorrected: float
    corrected: float
    predicted: float
    verdicts: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class ConvergenceCurve:
    """Error over time of one method. name: model or baseline. gnss_std: noise of the reference, m/s, None without one.

    rms: (T, 3) rad about the body's x, y, z at `convergence.TIMES_S`, over runs, combinations of errors and seeds.
    """

    name: str
    gnss_std: float | None
    rms: Array

    @property
    def angle_deg(self) -> Array:
        """Rms (T,) of the whole angle, degrees."""
        return np.degrees(np.sqrt((self.rms**2).sum(axis=1)))

    @property
    def level_deg(self) -> Array:
        """Rms (T,) of pitch and yaw together, degrees, which rotate a forward velocity."""
        return np.degrees(np.sqrt((self.rms[:, 1:] ** 2).sum(axis=1)))

    @property
    def label(self) -> str:
        """Label of the curve."""
        return f"{self.name}, no reference" if self.gnss_std is None else f"{self.name}, {self.gnss_std:g} m/s"


@dataclass(frozen=True, repr=False)
class Evaluation(Answering):
    """Result of the published procedure and the studies around it.

    source: folder or generator, as text.
    own_generator: whether the trajectories are simulated, so that the published figures do not apply.
    notes: warnings.
    columns: `UNCALIBRATED`, then the models.
    avg_vrmse: (S, C, Q).
    windows_s: (W,), None is all.
    avg_vrmse_by_time: (S, W, C, Q).
    published: set -> column -> m/s.
    coverage: over the sets.
    coverage_of_all: over these and the runs of `each`.
    parameters: plain values.
    baselines: (S,) Avg.VRMSE of earlier methods, by name.
    convergence: error of the misalignment over time.
    failures: exceptions; their results are excluded.
    version: of the software.
    """

    source: str
    own_generator: bool
    notes: tuple[str, ...]
    trajectories: tuple[str, ...]
    models: tuple[str, ...]
    sets: tuple[CalibrationSet, ...]
    seeds: tuple[int, ...]
    n_combinations: int
    avg_vrmse: Array
    windows_s: tuple[float | None, ...]
    avg_vrmse_by_time: Array
    published: Mapping[str, Mapping[str, float]]
    coverage: tuple[Coverage, ...]
    each: EachStudy | None
    single_heading: EachStudy | None
    parameters: Mapping[str, Any]
    version: str
    held_out: tuple[HeldOut, ...] = ()
    baselines: Mapping[str, Array] = field(default_factory=dict)
    convergence: tuple[ConvergenceCurve, ...] = ()
    coverage_of_all: tuple[Coverage, ...] = ()
    failures: tuple[Failure, ...] = ()

    @property
    def improvement(self) -> Improvement:
        """Improvement by the best model, on runs that it was not calibrated on, over all sets and seeds."""
        return Improvement.of(self.models, self.avg_vrmse[:, 1:].swapaxes(0, 1), self.avg_vrmse[:, 0])

    @property
    def verdict(self) -> str:
        """Answer: better, not_better or not_known."""
        return self.improvement.verdict

    @property
    def columns(self) -> tuple[str, ...]:
        """Names along C."""
        return (UNCALIBRATED, *self.models)

    def best(self, values: Array) -> dict[str, tuple[str, float]]:
        """Return, "with GNSS" and "without GNSS", the name and value of the model with the smallest of values (C,)."""
        known = zip(self.columns, map(float, values), strict=True)
        usable = [(name, value) for name, value in known if name in MODELS and np.isfinite(value)]
        aidings = (("with GNSS", True), ("without GNSS", False))
        found = {aiding: [each for each in usable if MODELS[each[0]].aided == aided] for aiding, aided in aidings}
        return {aiding: min(each, key=lambda pair: pair[1]) for aiding, each in found.items() if each}

    def of_models(self, values: Array) -> Array:
        """Select the models' part (..., M) of values (..., C)."""
        return np.asarray(values[..., [self.columns.index(name) for name in self.models]])

    @property
    def seed_mean(self) -> Array:
        """Avg.VRMSE (S, C), mean over the seeds."""
        return mean_of_known(self.avg_vrmse, -1)

    @property
    def seed_mean_by_time(self) -> Array:
        """Avg.VRMSE (S, W, C), mean over the seeds."""
        return mean_of_known(self.avg_vrmse_by_time, -1)

    @property
    def set_mean(self) -> Array:
        """Mean (C,) over the sets of `seed_mean`; nan if a model does not run on every set."""
        return np.asarray(self.seed_mean.mean(axis=0))

    @property
    def published_table(self) -> Array:
        """Published Avg.VRMSE (S, C), nan if missing."""
        rows = [[self.published.get(each.name, {}).get(c, np.nan) for c in self.columns] for each in self.sets]
        return np.array(rows, dtype=float)

    @property
    def published_of_these(self) -> Array:
        """`published_table` (S, C), or nan everywhere if the trajectories are others."""
        return np.full_like(self.published_table, np.nan) if self.own_generator else self.published_table

    @property
    def ratio(self) -> Array:
        """Ratio (S, C) of this result to the published one."""
        return self.seed_mean / self.published_table


# Error measures of a calibration, and the least-squares rotation on SO(3) as a baseline.
#
# Kinsey and Whitcomb, "In situ alignment calibration of attitude and Doppler sensors for precision underwater vehicle
# navigation: theory and experiment" (2007), align displacements: the integrated DVL against positions. Troni and
# Whitcomb, "New velocity-based algorithms for the in situ calibration of Doppler velocity log sensors" (2010), align
# velocities. Both compute the rotation C that minimises Σ |g_i - C v_i|² by a singular value decomposition (Wahba's
# problem). They have no scale, no prior, and no σ.


def troni_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """Fit the rotation to velocities (..., N, 3) m/s."""
    return nearest_rotation(np.swapaxes(reference, -1, -2) @ measured)


def kinsey_whitcomb(time: Array, measured: Array, reference: Array) -> Array:
    """Fit the rotation to displacements since the start, from velocities (..., N, 3) m/s at times (N,) s.

    This uses the body frame, in which the misalignment is constant; positions are the integrated reference velocity.
    """
    step = np.diff(time, prepend=time[:1])[:, None]
    return troni_whitcomb(time, np.cumsum(measured * step, axis=-2), np.cumsum(reference * step, axis=-2))


BASELINES: Mapping[str, Callable[[Array, Array, Array], Array]] = {
    "Kinsey-Whitcomb": kinsey_whitcomb,
    "Troni-Whitcomb": troni_whitcomb,
}


# two-sided intervals of a normal distribution
WITHIN_68, WITHIN_95 = (float(normal_isf(0.5 - 0.5 * share)) for share in (0.68, 0.95))


@dataclass(frozen=True)
class RunMoments:
    """Second moments of measured velocities v and true ones g of ... runs, sufficient for every VRMSE.

    They are for whole runs, many corrections, and a true velocity with all axes. `calibration.folds.Moments` sums by
      fold, with references that may lack axes.
    vv: E[v vᵀ] (..., 3, 3).
    gv: E[g vᵀ] (..., 3, 3).
    gg: E[gᵀg] (...,). (m/s)².
    """

    vv: Array
    gv: Array
    gg: Array

    @staticmethod
    def of(measured: Array, truth: Array) -> RunMoments:
        """Compute from measured (..., N, 3) and true (N, 3) velocities, m/s."""
        n = len(truth)
        transposed = np.swapaxes(measured, -1, -2)
        vv, vg = transposed @ measured / n, transposed @ truth / n
        gg = np.full(measured.shape[:-2], np.sum(truth * truth) / n)
        return RunMoments(vv, np.swapaxes(vg, -1, -2), gg)

    @staticmethod
    def stack(each: Sequence[RunMoments]) -> RunMoments:
        """Stack several runs along a new first axis."""
        return RunMoments(*(np.stack([getattr(one, name) for one in each]) for name in ("vv", "gv", "gg")))


def vrmse(moments: RunMoments, correction: Array) -> Array:
    """Return sqrt(E‖g - C v‖²) (...,) m/s of velocities corrected by matrices C (..., 3, 3); shapes broadcast.

    E‖g - C v‖² = E[gᵀg] - 2 tr(C E[g vᵀ]ᵀ) + tr(C E[v vᵀ] Cᵀ), so a correction costs a few products instead of a pass
    over the samples.
    """
    linear = 2.0 * moments.gv - correction @ moments.vv
    mean_square = moments.gg - np.sum(correction * linear, axis=(-2, -1))
    return np.sqrt(np.maximum(mean_square, 0.0))  # rounding may make a perfect correction negative


def heading_spread(rotation_enu_from_body: Array) -> float:
    """Return the circular standard deviation of the heading, rad, of attitudes (N, 3, 3)."""
    from scipy.stats import circstd

    forward = rotation_enu_from_body[:, :2, 0]
    return float(circstd(np.arctan2(forward[:, 1], forward[:, 0])))


def coverage(model: str, state_names: Sequence[str], errors: Array, std: Array) -> Coverage:
    """Return the coverage of errors (N, n), estimate - truth, by their claimed standard deviations (N, n)."""
    inside_68: NDArray[Any] = np.abs(errors) <= WITHIN_68 * std
    inside_95: NDArray[Any] = np.abs(errors) <= WITHIN_95 * std
    return Coverage(
        model=model,
        state_names=tuple(state_names),
        within_68=inside_68.mean(axis=0),
        within_95=inside_95.mean(axis=0),
        pooled_68=float(inside_68.mean()),
        pooled_95=float(inside_95.mean()),
        n_errors=len(errors),
        mean_error=errors.mean(axis=0),
        rms_error=np.sqrt((errors**2).mean(axis=0)),
        mean_std=std.mean(axis=0),
        normalised_rms=float(np.sqrt(np.mean((errors / std) ** 2))),
    )
