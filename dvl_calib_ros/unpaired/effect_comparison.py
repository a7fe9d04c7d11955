"""Comparison by effect: its size on both sides, the significance of the difference, and its location.

All effects found on either side are fitted to both, jointly. So the other side also gets an interval, which is wide if
its motions do not make the effect observable. Each side keeps its own form of an effect: one or two clock steps, or a
lever arm without its unobservable part. Sizes are compared by Wald's test with the covariance from the scatter between
blocks of time on each side.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import norm, t

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..diagnosis.answer.gap_location import BANDS_HZ, regimes
from ..diagnosis.answer.simulated_twin import simulated, with_denoised_reference
from ..diagnosis.fit.cross_validation import fitted_without, stretch_of
from ..diagnosis.fit.gauss_newton import Fit
from ..diagnosis.fit.selection_criteria import blocks_of
from ..diagnosis.model.forward_model import Problem
from ..diagnosis.model.hypothesis import Hypothesis, Values, amplitudes, is_time_of_run, whose_parameters
from ..diagnosis.model.settings import SETTINGS
from ..diagnosis.search.arm_clock_ambiguity import ATTITUDE_CLOCK, CLOCKS
from ..diagnosis.search.effect_selection import EffectSelection
from ..diagnosis.search.observable_parameters import default_values
from ..effects.base import ActsOn, ClockEffect, Effect, EffectWithMemory
from ..effects.registry import EFFECTS
from .both_sides import Log
from .results import ComparisonStatus, Lies, Rung, Triple

# an effect not found on a side is still present there if it is significant at this level ...
THERE = 1e-3
# ... and at least this share of the other side's; less may be due to interpolation and noise in the regressors
WORTH_IT = 0.1
# a regime is named if it has at least this share of an effect, and this multiple of its share of the time
MOST, DENSER = 0.4, 1.2
# number of calibration parameters fitted jointly; smallest degrees of freedom of an interval
CALIBRATION, FEWEST_DOF = 6, 4


@dataclass(frozen=True)
class Size:
    """An effect's size on one side. values: (p,) its linear parameters, averaged over recordings if they differ.

    stacked: (r, p) of each recording that has its own, else (1, p), with covariance (r p, r p).
    dof: of that covariance.
    found: the side's own diagnosis named it.
    recordings: names of those with their own size, none if they share it.
    """

    effect: Effect
    stacked: Array
    covariance: Array
    dof: int
    found: bool
    recordings: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Return the names of the parameters."""
        return [spec.name for spec in amplitudes(self.effect)]

    def taking(self, names: Sequence[str]) -> Array:
        """Return the matrix (q, p) that maps its parameters to other names; missing ones become 0."""
        return np.array([[float(name == name_kept) for name_kept in self.names] for name in names])

    @property
    def mean(self) -> tuple[Array, Array]:
        """Return the weighted mean (p,) over recordings and its covariance (p, p)."""
        r, p = self.stacked.shape
        design = np.tile(np.eye(p), (r, 1))
        weight = np.linalg.inv(self.covariance)
        covariance = np.linalg.inv(design.T @ weight @ design)
        return covariance @ design.T @ weight @ self.stacked.ravel(), np.asarray(covariance)

    def intervals(self) -> dict[str, Triple]:
        """Return 95 per cent intervals by name, and by recording if they differ."""
        # the covariance is estimated from this number of blocks, which also determine the calibration
        dof = max(self.dof - CALIBRATION - len(self.covariance), FEWEST_DOF)
        half_width = t.ppf(0.975, dof) * np.sqrt(np.diag(self.covariance))
        suffixes = [f" of {name}" for name in self.recordings] or [""]
        names = [f"{name}{suffix}" for suffix in suffixes for name in self.names]
        return {
            name: (float(value), float(value - half), float(value + half))
            for name, value, half in zip(names, self.stacked.ravel(), half_width, strict=True)
        }

    def p_absent(self) -> float:
        """Return the p-value of its absence."""
        defaults = np.array([spec.default for spec in amplitudes(self.effect)])
        return _wald(self.stacked.ravel() - np.tile(defaults, len(self.stacked)), self.covariance, self.dof)


def compared_names(vehicle: Size, simulator: Size) -> list[str]:
    """Return the names of parameters on both sides and, for an effect found on both, of a second occurrence.

    A side without the second occurrence has 0 for it.
    """
    own = [*dict.fromkeys([*vehicle.names, *simulator.names])]
    second_occurrence = vehicle.effect.again if vehicle.found and simulator.found else ()
    return [name for name in own if name in second_occurrence or (name in vehicle.names and name in simulator.names)]


def p_alike(vehicle: Size, simulator: Size) -> float:
    """Return the p-value of equal sizes on both sides; with sizes per recording, of each equalling the simulator's."""
    names = compared_names(vehicle, simulator)
    mean, covariance = simulator.mean
    n = len(vehicle.stacked)
    to_names, design = np.kron(np.eye(n), vehicle.taking(names)), np.tile(simulator.taking(names), (n, 1))
    difference = to_names @ vehicle.stacked.ravel() - design @ mean
    covariance = to_names @ vehicle.covariance @ to_names.T + design @ covariance @ design.T
    return _wald(difference, covariance, min(vehicle.dof, simulator.dof))


def _wald(values: Array, covariance: Array, dof: int) -> float:
    p = len(values)
    statistic = float(values @ np.linalg.solve(covariance, values)) / p
    return float(f_distribution.sf(statistic, p, max(dof - p, 2)))


def is_there(size: Size, against_size: Size) -> bool:
    """Return whether a side has an effect: found there, or significant and not small against the other side's."""
    if size.found:
        return True
    value, against = size.mean[0], against_size.mean[0]
    worth_it = float(np.linalg.norm(value)) > WORTH_IT * float(np.linalg.norm(against))
    return worth_it and size.p_absent() < THERE


def smallest_difference(vehicle: Size, simulator: Size, n_claims: int) -> dict[str, float]:
    """Return the difference of each parameter detected in four of five recordings, for this number of claims."""
    names = compared_names(vehicle, simulator)
    std = np.sqrt(sum(side.taking(names) @ np.diag(side.mean[1]) for side in (vehicle, simulator)))
    factor = float(norm.isf(0.005 / max(n_claims, 1)) + norm.ppf(0.8))
    return {name: factor * float(s) for name, s in zip(names, std, strict=True)}


def common_names(vehicle: Log, simulator: Log) -> tuple[dict[str, str], dict[str, str]]:
    """Return per side the names found -> the name under which they are compared.

    An effect that one side cannot distinguish from one found on the other side gets that name.
    """
    equals = [{effect.name: effect.equivalent_to for effect in log.diagnosis.effects} for log in (vehicle, simulator)]
    names: list[dict[str, str]] = [{name: name for name in side} for side in equals]
    for own, other_side in ((0, 1), (1, 0)):
        for name, equivalent in equals[own].items():
            if name in equals[other_side] or names[own][name] != name:
                continue
            shared = [other for other in equivalent if other in equals[other_side] and other not in equals[own]]
            if shared:
                names[own][name] = shared[0]
    return names[0], names[1]


def union(vehicle: Mapping[str, str], simulator: Mapping[str, str]) -> list[str]:
    """Return the names to compare. Of three clocks only two differences are observable, so the third is omitted."""
    names = {*vehicle.values(), *simulator.values()}
    if set(CLOCKS) <= names:
        names.discard(ATTITUDE_CLOCK)
    return [name for name in EFFECTS if name in names] + sorted(names - set(EFFECTS))


def fitted(selection: EffectSelection, names: Sequence[str]) -> Fit:
    """Fit all testable effects of these names jointly: in the form found, else in the form of the search."""
    fitter, fit = selection.fitter, selection.fit
    found = {effect.name: effect for effect in fit.effects}
    known = {**selection.testable, **found}
    chosen = [known[name] for name in names if name in known]
    start: dict[str, tuple[Values, ...]] = {
        effect.name: tuple(default_values(effect, fitter.problem)) for effect in chosen if effect.name not in found
    }
    return fitter.fit(fit.hypothesis.with_effects(chosen, fit.n_recordings, start), fit.noise)


def sizes(selection: EffectSelection, fit: Fit, found_names: Sequence[str]) -> dict[str, Size]:
    """Return every effect of a fit by name. found_names: effects named by the diagnosis of this side."""
    block = blocks_of(selection.fitter.problem)
    covariance = fit.covariance(block)
    dof = int(block.max()) + 1
    vector = fit.hypothesis.vector()
    n_all = fit.n_recordings
    result, first = {}, 6
    for effect in fit.effects:
        owners = whose_parameters(effect, n_all)
        n_parameters, n_recordings = len(amplitudes(effect)), len(owners)
        part = slice(first, first + n_parameters * n_recordings)
        first += n_parameters * n_recordings
        if not n_parameters:  # no part is observable
            continue
        stacked = vector[part].reshape(n_recordings, n_parameters)
        recordings = tuple(selection.fitter.problem.recordings[i].name for i in owners if i is not None)
        result[effect.name] = Size(effect, stacked, covariance[part, part], dof, effect.name in found_names, recordings)
    return result


def trace_of(selection: EffectSelection, fit: Fit, effect: Effect) -> Array:
    """Return the residual (M, A) m/s that an effect adds, without the part that other parameters can absorb.

    M: bins of time. A: compared axes.
    """
    others = [other for other in fit.effects if other is not effect]
    without = selection.fitter.fit(fit.hypothesis.with_effects(others, fit.n_recordings, {}), fit.noise, 4)
    return without.residual - fit.residual


def location_of(selection: EffectSelection, fit: Fit, trace: Array) -> Lies:
    """Return the axis, regime of motion and frequency band with most energy of a trace (M, A) m/s.

    A regime is named by its energy per time, compared with the whole run.
    """
    problem = selection.fitter.problem
    energy = trace**2
    total = max(float(energy.sum()), 1e-300)
    names = [name for name, measured in zip("xyz", problem.measured, strict=True) if measured]
    axis = int(np.argmax(energy.sum(axis=0)))
    regime, share, densest = "all", 1.0, DENSER
    for name, mask in regimes(problem, fit.seen).items():
        regime_share = float(energy[mask].sum()) / total
        density = regime_share / float(mask.mean())
        if regime_share > MOST and density > densest:
            regime, share, densest = name, regime_share, density
    nyquist = 0.5 / problem.interval
    power = (np.abs(np.fft.rfft(trace, axis=0)) ** 2).sum(axis=1)
    frequency = np.linspace(0.0, nyquist, len(power))
    bands = [(low, high) for low, high in itertools.pairwise(BANDS_HZ) if low < nyquist]
    powers = [power[(frequency >= low) & (frequency < high)].sum() for low, high in bands]
    strongest = int(np.argmax(powers))
    low, high = bands[strongest]
    return Lies(
        names[axis], float(energy[:, axis].sum()) / total, regime, share, (float(low), float(min(high, nyquist))),
        float(powers[strongest] / max(power.sum(), 1e-300)),
    )  # fmt: skip


# Reduction of the gap by adding the missing effects to the simulator's model, on the vehicle's motion.
#
# All models are evaluated on held-out stretches of the vehicle's recordings: misalignment and scale (which absorb a
# part of every effect) and the added effects are fitted to the rest. One measure is the rms difference of recorded and
# simulated DVL velocity. The other is an energy distance between windows of both velocities, each minus an ideal DVL
# with the vehicle's clocks and lag; the simulated one has noise. If both velocities had the same distribution, two
# windows of the same time could be exchanged, which gives the distribution of the distance.

# windows of the two-sample test, long enough that neighbours are nearly independent
WINDOW_S, PERMUTATIONS = 10.0, 500
# number of successive residuals per draw of a simulator's noise, to keep its colour
STRETCH = 8
# number of simulated references, and of frequency bands, for the colour of a vehicle's noise
SIMULATED, BANDS = 8, 40
# errors are limited to this number of standard deviations: outliers are part of the noise comparison
FAR = 5.0
AS_IT_IS, ALL, NOISE = "as it is", "all effects", "all effects, and the vehicle's noise"


@dataclass(frozen=True)
class SimulatedModel:
    """A simulated model. added: effects fitted to the vehicle. kept: the simulator's effects with their values."""

    name: str
    added: tuple[Effect, ...]
    kept: Mapping[str, tuple[Effect, Values]]
    vehicle_noise: bool = False


def models(sizes: Mapping[str, tuple[Size, Size, ComparisonStatus]], vehicle: Sequence[Effect]) -> list[SimulatedModel]:
    """Return the simulator as it is, with each lacking effect alone, with all, and with the vehicle's noise.

    sizes: of each effect on vehicle and simulator, and how they compare. vehicle: its effects.
    """
    kept = {
        name: (simulator.effect, _values(simulator))
        for name, (_, simulator, status) in sizes.items()
        if status is not ComparisonStatus.MISSING and simulator.found and is_of_every_run(simulator.effect)
    }
    lacking = [
        sizes[name][0].effect
        for name in sizes
        if sizes[name][2] in (ComparisonStatus.MISSING, ComparisonStatus.OTHER_SIZE)
        and sizes[name][0].effect in vehicle
    ]
    ladder = [SimulatedModel(AS_IT_IS, (), kept)]
    for effect in lacking:
        others = {name: effect_kept for name, effect_kept in kept.items() if name != effect.name}
        ladder.append(SimulatedModel(f"with {effect.name}", (effect,), others))
    if len(lacking) != 1 or set(vehicle) != set(lacking) or kept:
        ladder.append(SimulatedModel(ALL, tuple(vehicle), {}))
    return [*ladder, SimulatedModel(NOISE, tuple(vehicle), {}, vehicle_noise=True)]


def is_of_every_run(effect: Effect) -> bool:
    """Return whether a simulator's effect has the same size in every run."""
    return not effect.relative_to_first and not any(is_time_of_run(spec) for spec in effect.parameters)


def _is_time_shift(effect: Effect) -> bool:
    """Return whether an effect is a time shift of a velocity or a lag."""
    of_clock = isinstance(effect, ClockEffect) and effect.acts_on is not ActsOn.ATTITUDE_CLOCK
    return of_clock or isinstance(effect, EffectWithMemory)


def _values(size: Size) -> Values:
    mean = size.mean[0].tolist()
    return size.effect.defaults | {s.name: v for s, v in zip(amplitudes(size.effect), mean, strict=True)}


@dataclass(frozen=True)
class Shrunk:
    """Result of the ladder.

    rungs: of the ladder.
    floor: m/s, error of the last rung without the vehicle's error beyond its noise, white and slow.
    errors: (F, 3) m/s held out, DVL frame, by name of the model, nan if unknown.
    time: (F,) s since the start of the recording recording_of (F,).
    """

    rungs: tuple[Rung, ...]
    floor: float
    errors: Mapping[str, Array]
    time: Array
    recording_of: NDArray[np.intp]


def shrink(vehicle: Log, simulator: Log, ladder: Sequence[SimulatedModel]) -> Shrunk:
    """Compare the vehicle's DVL with the velocity that each model of the ladder predicts."""
    selection = vehicle.selection
    if selection is None:
        raise ValueError("nothing was fitted to the vehicle's recordings")
    rng = np.random.default_rng(0)
    problem = selection.fitter.problem
    recorded = [recording.dvl.values for recording in problem.recordings]
    time = np.concatenate([recording.dvl.time for recording in problem.recordings])
    recording_of = np.repeat(np.arange(len(recorded), dtype=np.intp), [len(velocity) for velocity in recorded])
    windows: Array = np.floor(time / WINDOW_S) + 1e6 * recording_of
    full = _held_out(selection, ladder[-1])
    # a time shift or lag changes the reference's noise, which must not be counted twice
    shifts = tuple(effect for effect in ladder[-1].added if _is_time_shift(effect))
    ideal = _held_out(selection, SimulatedModel("", shifts, {}))
    # the vehicle's residual includes its reference's noise; the simulator's reference is noise-free
    of_reference = _reference_noise(problem, selection.fit.hypothesis, rng)
    drawn = [
        _random_noise(simulator.residuals, dvl, rng) + noise[0]
        for dvl, noise in zip(recorded, of_reference, strict=True)
    ]
    own_noise = [
        turned_over(recording.dvl.values - predicted, noise_spectrum(noise, recording.dvl.noise), rng)
        for recording, predicted, noise in zip(problem.recordings, full, of_reference, strict=True)
    ]
    all_recorded, all_ideal = np.concatenate(recorded), np.concatenate(ideal)
    recorded_errors = all_recorded - all_ideal
    rungs, errors = [], {}
    for model in ladder:
        is_everything = set(model.added) == set(ladder[-1].added) and not model.kept
        predicted = full if is_everything else _held_out(selection, model)
        all_predicted = np.concatenate(predicted)
        difference = all_recorded - all_predicted
        simulated = all_predicted - all_ideal + np.concatenate(own_noise if model.vehicle_noise else drawn)
        known = np.isfinite(difference).all(axis=1)
        distance, null95, p = two_samples(recorded_errors[known], simulated[known], windows[known], rng)
        errors[model.name] = difference
        rungs.append(Rung(model.name, _rms(difference[known]), distance, null95, p))
    gap = vehicle.diagnosis.gap
    beyond_noise = max(0.0, gap.after**2 - gap.noise_floor**2)
    floor = float(np.sqrt(max(0.0, rungs[-1].error_mps ** 2 - beyond_noise)))
    return Shrunk(tuple(rungs), floor, errors, time, recording_of)


def _rms(values: Array) -> float:
    """Return the rms length of vectors, with limited outliers."""
    return float(np.sqrt((_limited(values) ** 2).sum(axis=1).mean()))


def _limited(values: Array) -> Array:
    """Limit values (N, 3) to FAR robust standard deviations."""
    far = FAR * np.maximum(robust_std(values), 1e-9)
    return np.clip(values, -far, far)


def _held_out(selection: EffectSelection, model: SimulatedModel) -> list[Array]:
    """Return the predicted DVL velocity (N, 3) m/s per recording, each sample by a fit without its fold.

    With several recordings stretches are held out as well, because a fit needs each recording for its own delay.
    """
    fitter, fit = selection.fitter, selection.fit
    problem = fitter.problem
    n = len(problem.recordings)
    kept = {name: (values,) * n for name, (_, values) in model.kept.items()}
    effects = [*model.added, *(effect for effect, _ in model.kept.values())]
    start = fit.hypothesis.with_effects(effects, n, kept)
    fixed = frozenset(kept)
    bins = stretch_of(problem.time) % SETTINGS.folds
    sample_folds = [_fold_of(problem, index) for index in range(n)]
    predicted = [np.full_like(recording.dvl.values, np.nan) for recording in problem.recordings]
    # at shifted times the reference's noise is different, so it would count twice
    denoised = with_denoised_reference(problem)
    for fold, (fitted,) in fitted_without(fitter, [start], fit.noise, bins, fixed):
        for index in range(n):
            at = sample_folds[index] == fold
            predicted[index][at] = simulated(denoised, fitted.hypothesis, index)[at]
    return predicted


def _fold_of(problem: Problem, recording: int) -> Array:
    """Return the fold (N,) of each DVL sample of a recording: stretches of time in turn; -1 outside the fit."""
    time = problem.recordings[recording].dvl.time - problem.grids[recording].delay_s
    bin_times = problem.grids[recording].bin_time
    fold = stretch_of(time) % SETTINGS.folds
    inside = (time >= bin_times[0]) & (time <= bin_times[-1]) if len(bin_times) else np.zeros(len(time), dtype=bool)
    return np.where(inside, fold, -1)


def _reference_noise(problem: Problem, hypothesis: Hypothesis, rng: np.random.Generator) -> list[Array]:
    """Return the slow noise (SIMULATED, N, 3) m/s per recording that simulated reference noise adds to the DVL.

    Fast reference noise is excluded, because `with_denoised_reference` subtracts it.
    """
    denoised = with_denoised_reference(problem)
    noisy = [
        with_denoised_reference(
            replace(
                problem,
                recordings=tuple(replace(one, reference=one.reference.perturbed(rng)) for one in problem.recordings),
            )
        )
        for _ in range(SIMULATED)
    ]
    return [
        np.stack([simulated(entry, hypothesis, index) for entry in noisy]) - simulated(denoised, hypothesis, index)
        for index in range(len(problem.recordings))
    ]


def noise_spectrum(of_reference: Array, white: Array) -> Array:
    """Return the noise power (N // 2 + 1, 3) by frequency, in (m/s)².

    of_reference: (R, N, 3) m/s, whose power is averaged in bands. white: standard deviations (3,) of white noise.
    """
    power = (np.abs(np.fft.rfft(of_reference, axis=1)) ** 2).mean(axis=0) / of_reference.shape[1]
    edges = np.unique(np.concatenate([[0], np.geomspace(1.0, len(power), BANDS)]).astype(int))
    counts = np.diff(edges)
    mean = np.add.reduceat(power, edges[:-1], axis=0) / counts[:, None]
    return np.asarray(np.repeat(mean, counts, axis=0) + np.maximum(white, 1e-9) ** 2)


def turned_over(residual: Array, spectrum: Array, rng: np.random.Generator) -> Array:
    """Return a residual (N, 3) m/s with random signs while whitened, and the spectrum restored.

    So its level depends on time as in the original, and structure slower than this noise is removed. Noise drawn from
    elsewhere would be too large on straight legs, which would distinguish the windows.
    """
    n = len(residual)
    values = np.nan_to_num(residual - np.nanmedian(residual, axis=0))
    signs = rng.choice([-1.0, 1.0], n)[:, None]
    limited = _limited(values)  # outliers are not coloured
    gain = np.sqrt(spectrum)
    white = np.fft.irfft(np.fft.rfft(limited, axis=0) / gain, n, axis=0)
    randomised = np.fft.irfft(np.fft.rfft(white * signs, axis=0) * gain, n, axis=0)
    return np.asarray(randomised + (values - limited) * signs)


def _random_noise(pool: Sequence[Array], like: Array, rng: np.random.Generator) -> Array:
    """Return noise (N, 3) m/s composed of stretches of residuals."""
    joined = np.concatenate(list(pool))
    joined = joined - np.nanmedian(joined, axis=0)
    n = len(like)
    starts = rng.integers(0, max(len(joined) - STRETCH, 1), -(-n // STRETCH))
    at = (starts[:, None] + np.arange(STRETCH)).ravel()[:n] % len(joined)
    return np.asarray(np.nan_to_num(joined[at]))


def features(values: Array, windows: Array) -> Array:
    """Return (W, 6) per window: mean and logarithm of the scatter on every axis."""
    _, index = np.unique(windows, return_inverse=True)
    count = np.bincount(index).astype(float)
    mean = np.stack([np.bincount(index, column) for column in values.T], axis=1) / count[:, None]
    residual = values - mean[index]
    variance = np.stack([np.bincount(index, column**2) for column in residual.T], axis=1) / count[:, None]
    full = count >= np.maximum(4.0, 0.5 * np.median(count))
    return np.column_stack([mean, 0.5 * np.log(np.maximum(variance, 1e-12))])[full]


def two_samples(one: Array, other: Array, windows: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the energy distance of two series' windows (N, 3), its 95 per cent quantile if both are alike, and p."""
    a, b = features(one, windows), features(other, windows)
    scale = np.maximum(robust_std(np.concatenate([a, b])), 1e-9)
    pooled = np.concatenate([a, b]) / scale
    distances = np.linalg.norm(pooled[:, None] - pooled[None], axis=2)
    n_windows = len(a)
    if n_windows < 4:
        return np.nan, np.nan, np.nan
    sign = np.concatenate([np.ones(n_windows), -np.ones(n_windows)])

    def energy(signs: Array) -> Array:
        """Return -s'Ds / w², which is 2 E|X-Y| - E|X-X'| - E|Y-Y'|."""
        return -np.einsum("...i,ij,...j->...", signs, distances, signs) / n_windows**2

    swap = rng.choice([-1.0, 1.0], (PERMUTATIONS, n_windows))
    null = energy(np.concatenate([swap, -swap], axis=1))
    value = float(energy(sign))
    p = (1.0 + np.count_nonzero(null >= value)) / (1.0 + PERMUTATIONS)
    null95 = float(np.quantile(null, 0.95))
    return float(np.sqrt(max(value, 0.0))), float(np.sqrt(max(null95, 0.0))), float(p)
