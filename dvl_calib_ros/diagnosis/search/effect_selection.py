"""Selection of the effects that explain a recording.

Proposal: linearised about the current fit, all effects share one Gram matrix. Combinations of up to three effects are
small least squares problems in it. Decision: the best proposals are fitted in the composed model and compared by
penalised deviance. The search repeats about the winner, with the noise re-estimated under all effects jointly, so that
no effect is taken for noise.

A constant heading error is not identifiable next to the DVL's mounting: navigation is identical. A heading error that
varies with the heading (hard and soft iron) or drifts resembles a mounting that moves. Compass errors are common and
moving mountings are rare, so the heading is named first, unless the same heading on another day contradicts it.

An outlier of a fast stream is found from its neighbours. A vehicle can turn between the samples of a slow stream: an
outlier there must also contradict the other stream, by as much and in the same direction.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...calibration.numerics.robust import robust_std
from ...calibration.numerics.samples import VelocityFrame
from ...effects.base import ActsOn, Effect, true_times
from ..fit.gauss_newton import Fit, Fitter
from ..fit.selection_criteria import best_of, finer_steps
from ..model.forward_model import Problem, make_problem
from ..model.hypothesis import Hypothesis, Values, is_time_of_run, no_effect
from ..model.recorded_streams import RecordedStreams
from ..model.settings import SETTINGS
from ..model.stream_curve import FAST_ENOUGH_S
from ..noise.noise_level import estimate_noise
from ..noise.noise_model import Noise, white_noise
from ..noise.whitened_least_squares import WhitenedLeastSquares
from .arm_clock_ambiguity import ARM, ArmAmbiguity, guessed_arm
from .backward_elimination import eliminate, without_chance
from .candidates import intermittent_effects, proposed, variants_about
from .clock_jumps import hypotheses_with_jumps, with_jumps_in_gaps
from .identifiability import Selected, identify_effects
from .initial_guess import FirstGuess, first_guess
from .observable_parameters import observable_parts, unobservable_parts, without_insignificant

# The most common causes of a gap; the first fit includes all of them.
START = (ARM, "dvl_time_offset", "reference_time_offset")
ROUNDS = 4
# Robust fits from the first guess on; each re-estimates the outliers about the previous fit.
ROBUST_ROUNDS = 3


@dataclass(frozen=True)
class EffectSelection:
    """Selected effects, strongest first, with the fits without (`base`) and with them under the same noise.

    testable: effects with their observable parameters.
    trade_off: ambiguity of lever arm and clock at one speed.
    changes: by arm parameter, the difference (m) to a fit with another clock that explains the data equally well.
    wider: the hypothesis with effects that slow noise explains equally well.
    """

    selected: tuple[Selected, ...]
    base: Fit
    fit: Fit
    fitter: Fitter
    testable: Mapping[str, Effect]
    trade_off: ArmAmbiguity | None = None
    changes: Mapping[str, float] = field(default_factory=dict)
    wider: Hypothesis | None = None

    def without(self, names: Collection[str]) -> EffectSelection:
        """Return the selection without the named effects; re-estimate the others."""
        kept = [effect for effect in self.fit.effects if effect.name not in names]
        hypothesis = self.fit.hypothesis.with_effects(kept, self.fit.n_recordings, {})
        selected = tuple(each for each in self.selected if each.effect.name not in names)
        return replace(self, selected=selected, fit=self.fitter.fit(hypothesis, self.fit.noise))


class TooFewBinsError(Exception):
    """Error for streams that overlap too briefly, with their number of samples."""

    def __init__(self, samples: int) -> None:
        super().__init__(samples)
        self.samples = samples


def started(
    recordings: Sequence[RecordedStreams],
    rotation_dvl_from_body: Array,
    lever_arm: Array,
    effects: Mapping[str, Effect],
) -> tuple[Problem, Hypothesis, tuple[FirstGuess, ...], dict[str, Effect]]:
    """Return the problem about each first guess, a start hypothesis, the guesses and the effects (observable parts)."""
    guesses = tuple(first_guess(recording, rotation_dvl_from_body, lever_arm) for recording in recordings)
    problem = make_problem(recordings, rotation_dvl_from_body, lever_arm, [guess.offsets for guess in guesses])
    _check_size(problem)
    every, effects = effects, observable_parts({name: effect.once for name, effect in effects.items()}, problem)
    problem = replace(problem, unobservable=unobservable_parts(every, effects))
    found: dict[str, tuple[Values, ...]] = {
        ARM: (guessed_arm(guesses, effects),) * len(guesses),
        "dvl_time_offset": tuple({"seconds": guess.offsets.dvl} for guess in guesses),
        "reference_time_offset": tuple({"seconds": guess.offsets.reference} for guess in guesses),
    }
    present = [effects[name] for name in START if name in effects]
    phi = problem.observable_turns @ np.median([guess.phi for guess in guesses], axis=0)
    start = no_effect(phi).with_effects(present, len(guesses), found)
    return problem, start, guesses, effects


def select(
    recordings: Sequence[RecordedStreams],
    rotation_dvl_from_body: Array,
    lever_arm: Array,
    effects: Mapping[str, Effect],
) -> EffectSelection:
    """Select among testable effects. Raises TooFewBinsError."""
    heading = effects.get(HEADING)
    effects = every = {name: effect.usual for name, effect in effects.items()}  # unobservable parameters are no noise
    problem, start, guesses, effects = started(recordings, rotation_dvl_from_body, lever_arm, effects)
    fitter, fit = _first_fit(problem, start)
    kept = without_slow_outliers(problem, fit.hypothesis)
    if kept is not None:
        problem = make_problem(kept, rotation_dvl_from_body, lever_arm, [guess.offsets for guess in guesses])
        problem = replace(problem, unobservable=fitter.problem.unobservable)
        fitter, fit = _first_fit(problem, fit.hypothesis)
    fitter, fit = with_noise_reestimated(fitter, fit, every)
    far = fitter.bursts(fit)
    if far.any():
        problem = problem.without(far)
        fitter, fit = with_noise_reestimated(*_first_fit(problem, fit.hypothesis), every)
    best = fit
    seen_before: set[frozenset[str]] = set()
    for _ in range(ROUNDS):
        candidates = [*proposed(fitter, fit, effects), *with_two_cycles(fit, heading)]
        fits = [fitter.fit_kept(hypothesis, fit.noise) for hypothesis in candidates]
        fits += [fitter.fit(hypothesis, fit.noise) for hypothesis in hypotheses_with_jumps(fitter, fit, effects, every)]
        finer = finer_steps(problem)
        for hypothesis in intermittent_effects(fitter, fit, effects):
            as_white = fitter.refined(fitter.fit(hypothesis, fit.noise.white), finer)
            fits.append(fitter.fit(as_white.hypothesis, fit.noise))
        fits = [fitter.refined(each, finer[:3]) for each in fits]  # a time of the run is coarse until then
        best = with_jumps_in_gaps(fitter, fitter.refined(best_of(fits, effects), finer[3:]))
        best = eliminate(fitter, best, len(effects))
        fitter, fit = with_noise_reestimated(fitter, best, every)
        names = frozenset(effect.name for effect in fit.effects)
        if names in seen_before:
            break
        seen_before.add(names)
    wider = eliminate(fitter, fit, len(effects))
    fit = without_chance(fitter, wider, len(effects))
    fitter, fit = with_noise_reestimated(fitter, fit, every)
    fitter, fit, effects = _with_observable_arm(fitter, fit, every, effects)
    fit, equivalent = heading_first(fitter, fit, heading)
    found = identify_effects(fitter, fit, guesses, effects, equivalent)
    base = fitter.fit_kept(found.fit.hypothesis.with_effects([], len(recordings), {}), found.fit.noise)
    return EffectSelection(
        found.selected, base, found.fit, fitter, effects, found.trade_off, found.changes, wider.hypothesis
    )


def _check_size(problem: Problem) -> None:
    if len(problem.time) < SETTINGS.min_bins:
        raise TooFewBinsError(len(problem.bin_of))


def _first_fit(problem: Problem, start: Hypothesis) -> tuple[Fitter, Fit]:
    """Fit the first hypothesis robustly, with white noise of the residual's size."""
    _check_size(problem)
    fitter = Fitter(problem)
    _, residual = fitter.evaluated(start)
    fit = fitter.fit(start, white_noise(residual, problem.segments, None, problem.interval))
    for _ in range(ROBUST_ROUNDS):
        raw = fit.residual + fitter.outliers
        noise = white_noise(raw, problem.segments, None, problem.interval)
        fitter = Fitter(problem, raw - noise.robust(raw))
        fit = fitter.fit(fit.hypothesis, noise)
    return fitter, fit


def with_noise_reestimated(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> tuple[Fitter, Fit]:
    """Repeat a fit with noise and outliers re-estimated from the residual of all columns jointly."""
    problem = fitter.problem
    columns = _columns_of_all_effects(fit, effects)
    noise = fit.noise
    raw = fit.residual + fitter.outliers
    size = np.maximum(np.sqrt((columns**2).mean(axis=(0, 1))), 1e-12)
    columns = columns / size
    own = [
        np.concatenate([each / size - columns, (residual - raw)[:, :, None]], axis=2)
        for each, residual in _with_simulated_noise(fitter, fit, effects)
    ]
    frames = _frames(problem)
    for _ in range(2):
        explained, std = _explained(noise, columns, raw - fitter.outliers, own)
        corrected = raw - explained
        noise, robust = min(
            (estimate_noise(problem, fit.seen, corrected, rotation, columns, std) for rotation in frames),
            key=lambda each: each[0].deviance(each[1]),
        )
        frames, fitter = [noise.rotation], Fitter(problem, corrected - robust)
    return fitter, fitter.fit(fit.hypothesis, noise)


def _columns_of_all_effects(fit: Fit, effects: Mapping[str, Effect]) -> Array:
    """Return columns (M, A, p) of a fit and of all effects without a time of the run."""
    others = {name: effect for name, effect in effects.items() if not any(map(is_time_of_run, effect.parameters))}
    return np.concatenate([fit.columns, *(each.columns for each in variants_about(fit, others))], axis=2)


def _with_simulated_noise(fitter: Fitter, fit: Fit, effects: Mapping[str, Effect]) -> Iterator[tuple[Array, Array]]:
    """Yield the same columns (M, A, p) and residual (M, A) with simulated noise in each velocity in turn."""
    for problem in fitter.problem.perturbed:
        perturbed = replace(fit, problem=problem)
        yield _columns_of_all_effects(perturbed, effects), problem.residual(perturbed.seen)


def _frames(problem: Problem) -> list[Array | None]:
    return [None] if problem.earth_from_compared is None else [problem.earth_from_compared, None]


def _explained(noise: Noise, columns: Array, residual: Array, own: Sequence[Array]) -> tuple[Array, Array]:
    """Return the part (M, A) of a residual that columns of unit size explain, and the ridge (p,).

    The ridge separates collinear columns. own: (M, A, p + 1) each, the contribution of a velocity's own noise to
    columns and residual. It is subtracted: noise common to both would otherwise leave a residual slower than any noise.
    """
    white = noise.whiten(columns)
    ridge = np.full(columns.shape[2], 10.0 * np.sqrt(float((noise.whiten(residual) ** 2).sum())) / np.sqrt(len(white)))
    system = WhitenedLeastSquares.of(white, noise.whiten(residual), ridge, np.zeros_like(ridge))
    of_noise = sum((joined.T @ joined for joined in map(noise.whiten, own)), np.zeros_like(system.gram))
    return np.asarray(columns @ system.solution_without(of_noise)), ridge


def _with_observable_arm(
    fitter: Fitter, fit: Fit, every: Mapping[str, Effect], effects: Mapping[str, Effect]
) -> tuple[Fitter, Fit, Mapping[str, Effect]]:
    """Return a fit and effects with only the observable parts of the lever arm.

    every: effects with all parameters; effects: with those observable by their columns alone.
    """
    arm = without_insignificant(fitter.problem, fit)
    if arm is not None:
        effects, others = {**effects, ARM: arm}, [effect for effect in fit.effects if effect.name != ARM]
        values = tuple(dict(each) for each in fit.values[ARM])  # unobservable parts are held at their values
        hypothesis = fit.hypothesis.with_effects([arm, *others], len(values), {ARM: values})
        fitter, fit = with_noise_reestimated(fitter, fitter.fit(hypothesis, fit.noise), every)
    return fitter, fit, effects


HEADING, MOVED, DRIFT = "heading_error", "mounting_moved", "misalignment_drift"
# Effects that rotate DVL against reference by heading, recording or time
BY_YAW = frozenset({HEADING, MOVED, DRIFT, "water_lock"})
OF_DRIFT = "rad_per_hour"


def with_two_cycles(fit: Fit, heading: Effect | None) -> list[Hypothesis]:
    """Propose a heading error of two cycles in place of effects that rotate DVL against reference.

    Its parameters are shared or per recording. A single recording gets none. heading: with all its parameters; None if
    untestable.
    """
    if heading is None or fit.n_recordings < 2:
        return []
    return [_with_heading_instead(fit, BY_YAW, each) for each in _two_cycles(heading)]


def heading_first(fitter: Fitter, fit: Fit, heading: Effect | None) -> tuple[Fit, dict[str, str]]:
    """Replace a moving mounting by an equally good heading error. Return the fit and equivalents by effect name."""
    if heading is None or fit.n_recordings < 2:
        return fit, {}
    equivalent: dict[str, str] = {}
    if DRIFT in fit.values:
        own = next((_names(each) for each in fit.effects if each.name == HEADING), frozenset())
        drifting = heading.without(_names(heading) - own - {OF_DRIFT})
        found = fitter.fit_kept(_with_heading_instead(fit, {DRIFT, HEADING}, drifting), fit.noise)
        if found.deviance < fit.deviance + SETTINGS.indistinguishable:
            fit = found
            equivalent[HEADING] = DRIFT
    if MOVED in fit.values:
        of_vehicle, of_day = (
            fitter.fit_kept(_with_heading_instead(fit, {MOVED, HEADING}, each), fit.noise)
            for each in _two_cycles(heading)
        )
        if of_vehicle.deviance < fit.deviance + SETTINGS.indistinguishable:
            return of_vehicle, {HEADING: MOVED}
        if of_day.deviance < fit.deviance + SETTINGS.indistinguishable:
            equivalent[MOVED] = HEADING
    return fit, equivalent


def _two_cycles(heading: Effect) -> tuple[Effect, Effect]:
    """Return the heading error shared by all recordings and the one per recording."""
    of_day = heading.without({OF_DRIFT})
    return of_day.of_the_vehicle, of_day


def _names(effect: Effect) -> frozenset[str]:
    return frozenset(spec.name for spec in effect.parameters)


def _with_heading_instead(fit: Fit, names: Collection[str], heading: Effect) -> Hypothesis:
    """Return the hypothesis of a fit with a heading error in place of the named effects."""
    n = fit.n_recordings
    none = {name: value for name, value in heading.defaults.items() if name in _names(heading)}
    own: tuple[Values, ...] = fit.values.get(HEADING, (none,) * n)
    start = tuple({name: each.get(name, value) for name, value in none.items()} for each in own)
    if not heading.per_recording:
        start = ({name: sum(each[name] for each in start) / n for name in none},) * n
    others = [effect for effect in fit.effects if effect.name not in names]
    return fit.hypothesis.with_effects([*others, heading], n, {HEADING: start})


# Robust standard deviations from the other stream; an outlier exceeds these and `SETTINGS.outlying` from its neighbours
OTHER_STREAM_Z = 4.0
# Bounds of the ratio of both deviations, projected: around a turn between samples they differ more
DEVIATION_RATIO = (0.6, 1.7)


def without_slow_outliers(problem: Problem, hypothesis: Hypothesis) -> tuple[RecordedStreams, ...] | None:
    """Return the recordings without outliers of slow streams. Return None if there are none.

    Parameters
    ----------
    problem: The recordings.
    hypothesis: Robust fit, so that lever arm and delays do not resemble outliers.

    """
    found = [_without_outliers(problem, hypothesis, index) for index in range(len(problem.recordings))]
    return None if all(one is two for one, two in zip(found, problem.recordings, strict=True)) else tuple(found)


def _without_outliers(problem: Problem, hypothesis: Hypothesis, index: int) -> RecordedStreams:
    """Return a recording without the outliers of its slow streams."""
    recording = problem.recordings[index]
    dvl = _inliers(problem, hypothesis, index, ActsOn.DVL_CLOCK)
    reference = _inliers(problem, hypothesis, index, ActsOn.REFERENCE_CLOCK)
    if dvl.all() and reference.all():
        return recording
    return replace(
        recording,
        dvl=recording.dvl.part(dvl),
        reference=recording.reference.part(reference),
        spikes=recording.spikes + int(np.count_nonzero(~dvl)),
    )


def _inliers(problem: Problem, hypothesis: Hypothesis, index: int, clock: ActsOn) -> NDArray[np.bool_]:
    """Return (N,) whether each sample of one stream is no outlier."""
    recording = problem.recordings[index]
    of_dvl = clock is ActsOn.DVL_CLOCK
    curve, other = (recording.dvl, recording.reference) if of_dvl else (recording.reference, recording.dvl)
    kept = np.ones(len(curve.time), dtype=bool)
    if curve.interval <= FAST_ENOUGH_S:
        return kept
    injections = hypothesis.injections(index)
    true = true_times(injections, clock, curve.time)
    seen = problem.seen(hypothesis, index, true)
    measured = np.array(problem.measured)
    error = (seen.error if of_dvl else -seen.error) * measured
    suspicious = other.covers(seen.reference_stamps if of_dvl else seen.dvl_stamps)
    suspicious &= np.abs(error / _scatter(error)).max(axis=1) > OTHER_STREAM_Z
    others = curve.part(~suspicious)  # adjacent outliers would confirm each other
    if not suspicious.any():
        return kept

    def in_body(values: Array) -> Array:
        """Rotate values (N, 3) of the stream to the body frame; zero on unmeasured axes."""
        if of_dvl:
            return np.asarray(values @ hypothesis.body_from_measured(problem.rotation_dvl_from_body).T) * measured
        if recording.frame is VelocityFrame.BODY:
            return values * measured
        return np.asarray(np.einsum("nji,nj->ni", recording.rotation_enu_from_body(true), values)) * measured

    scatter = _scatter(in_body(curve.from_neighbours))
    dev = in_body((curve.values - others(curve.time)) / curve.relative_noise)
    gain = (dev * error).sum(axis=1) / np.maximum((dev**2).sum(axis=1), 1e-300) / curve.relative_noise.mean(axis=1)
    bad = suspicious & others.covers(curve.time) & (np.abs(dev / scatter).max(axis=1) > SETTINGS.outlying)
    bad &= (gain > DEVIATION_RATIO[0]) & (gain < DEVIATION_RATIO[1])
    return ~bad


def _scatter(values: Array) -> Array:
    """Return the robust standard deviation (3,) of values (N, 3)."""
    return np.maximum(robust_std(values), 1e-9)
