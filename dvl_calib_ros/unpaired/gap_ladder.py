"""Reduction of the gap by adding the missing effects to the simulator's model, on the vehicle's motion.

All models are evaluated on held-out stretches of the vehicle's recordings: misalignment and scale (which absorb a part
of every effect) and the added effects are fitted to the rest. One measure is the rms difference of recorded and
simulated DVL velocity. The other is an energy distance between windows of both velocities, each minus an ideal DVL with
the vehicle's clocks and lag; the simulated one has noise. If both velocities had the same distribution, two windows of
the same time could be exchanged, which gives the distribution of the distance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..diagnosis.answer.simulated_twin import simulated, with_denoised_reference
from ..diagnosis.fit.cross_validation import fitted_without, stretch_of
from ..diagnosis.model.forward_model import Problem
from ..diagnosis.model.hypothesis import Hypothesis, Values, amplitudes, is_time_of_run
from ..diagnosis.model.settings import SETTINGS
from ..diagnosis.search.effect_selection import EffectSelection
from ..effects.base import ActsOn, ClockEffect, Effect, EffectWithMemory
from .both_sides import Log
from .effect_comparison import Size
from .results import ComparisonStatus, Rung

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
