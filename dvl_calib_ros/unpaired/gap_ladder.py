"""How far the gap shrinks: the vehicle's motion through the simulator's model as it is, and with what it lacks added.

Everything is judged on stretches of the vehicle's recordings that were held out: misalignment and scale (which take in
a part of every effect) and the effects that are added are fitted to the rest. Two figures: the rms of what recorded and
simulated DVL velocity differ by, and an energy distance between windows of both, each less what an ideal DVL would have
measured by the clocks and the lag that the vehicle has, the simulated one with noise. If both were drawn alike, each
pair of windows of the same time could be exchanged, which gives the distance's distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..diagnosis.answer.simulated_twin import simulated, with_quiet_reference
from ..diagnosis.fit.cross_validation import fitted_without, stretch_of
from ..diagnosis.model.forward_model import Problem
from ..diagnosis.model.hypothesis import Hypothesis, Values, amplitudes, is_time_of_run
from ..diagnosis.model.settings import SETTINGS
from ..diagnosis.search.effect_selection import EffectSelection
from ..effects.base import ActsOn, ClockEffect, Effect, EffectWithMemory
from .both_sides import Log
from .effect_comparison import Size
from .results import ComparisonStatus, Rung

# Windows of the two-sample test: long enough that neighbours are nearly independent
WINDOW_S, PERMUTATIONS = 10.0, 500
# Noise of a simulator is drawn from stretches of so many residuals, so that its colour is in it
STRETCH = 8
# The colour of a vehicle's noise is that of so many made-up references, the mean over so many bands of frequency
MADE_UP, BANDS = 8, 40
# Errors count no more than so many standard deviations: an outlier is noise, of which there is a figure
FAR = 5.0
AS_IT_IS, ALL, NOISE = "as it is", "all effects", "all effects, and the vehicle's noise"


@dataclass(frozen=True)
class SimulatedModel:
    """What is simulated. added: effects fitted to the vehicle; kept: those of the simulator, with their values."""

    name: str
    added: tuple[Effect, ...]
    kept: Mapping[str, tuple[Effect, Values]]
    vehicle_noise: bool = False


def models(sizes: Mapping[str, tuple[Size, Size, ComparisonStatus]], vehicle: Sequence[Effect]) -> list[SimulatedModel]:
    """The ladder. sizes: of both sides by name, and how they compare. vehicle: effects that the vehicle has."""
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
        rest = {name: each for name, each in kept.items() if name != effect.name}
        ladder.append(SimulatedModel(f"with {effect.name}", (effect,), rest))
    if len(lacking) != 1 or set(vehicle) != set(lacking) or kept:
        ladder.append(SimulatedModel(ALL, tuple(vehicle), {}))
    return [*ladder, SimulatedModel(NOISE, tuple(vehicle), {}, vehicle_noise=True)]


def is_of_every_run(effect: Effect) -> bool:
    """Whether what a simulator has of it, it has on every run."""
    return not effect.relative_to_first and not any(is_time_of_run(spec) for spec in effect.parameters)


def _is_of_time(effect: Effect) -> bool:
    """Whether an effect says when a velocity was, or that it lags."""
    of_clock = isinstance(effect, ClockEffect) and effect.acts_on is not ActsOn.ATTITUDE_CLOCK
    return of_clock or isinstance(effect, EffectWithMemory)


def _values(size: Size) -> Values:
    mean = size.mean[0].tolist()
    return size.effect.defaults | {s.name: v for s, v in zip(amplitudes(size.effect), mean, strict=True)}


@dataclass(frozen=True)
class Shrunk:
    """rungs: of the ladder. floor: m/s. errors: (F, 3) m/s held out, DVL frame, by name of the model, nan where nothing
    is known. time: (F,) s since the start of the recording (F,).
    """

    rungs: tuple[Rung, ...]
    floor: float
    errors: Mapping[str, Array]
    time: Array
    recording_of: NDArray[np.intp]


def shrink(vehicle: Log, simulator: Log, ladder: Sequence[SimulatedModel], seed: int = 0) -> Shrunk:
    """Climb the ladder on the vehicle's recordings."""
    selection = vehicle.selection
    if selection is None:
        raise ValueError("nothing was fitted to the vehicle's recordings")
    rng = np.random.default_rng(seed)
    problem = selection.fitter.problem
    truth = [each.dvl.values for each in problem.recordings]
    time = np.concatenate([each.dvl.time for each in problem.recordings])
    recording_of = np.repeat(np.arange(len(truth), dtype=np.intp), [len(each) for each in truth])
    windows = np.floor(time / WINDOW_S).astype(int) + recording_of * 1_000_000
    everything = _held_out(selection, ladder[-1])
    # at other times, or without a lag, the reference has other noise, which were in both, and in one of them twice
    ideal = _held_out(selection, SimulatedModel("", tuple(each for each in ladder[-1].added if _is_of_time(each)), {}))
    # the vehicle's residual holds its reference's noise; that of a simulator, whose reference is the truth, does not
    of_reference = _reference_noise(problem, selection.fit.hypothesis, rng)
    drawn = [_drawn(simulator.residuals, a, rng) + b[0] for a, b in zip(truth, of_reference, strict=True)]
    own = [
        turned_over(a - b, noise_spectrum(of_it, one.dvl.noise), rng)
        for a, b, of_it, one in zip(truth, everything, of_reference, problem.recordings, strict=True)
    ]
    recorded = np.concatenate([a - b for a, b in zip(truth, ideal, strict=True)])
    rungs, errors = [], {}
    for model in ladder:
        is_everything = set(model.added) == set(ladder[-1].added) and not model.kept
        predicted = everything if is_everything else _held_out(selection, model)
        off = np.concatenate([a - b for a, b in zip(truth, predicted, strict=True)])
        noise = own if model.vehicle_noise else drawn
        made = np.concatenate([a - b + n for a, b, n in zip(predicted, ideal, noise, strict=True)])
        known = np.isfinite(off).all(axis=1)
        distance, null95, p = two_samples(recorded[known], made[known], windows[known], rng)
        errors[model.name] = off
        rungs.append(Rung(model.name, _rms(off[known]), distance, null95, p))
    return Shrunk(tuple(rungs), _floor(errors[ladder[-1].name], recording_of), errors, time, recording_of)


def _rms(values: Array) -> float:
    """Of the vectors' lengths, outliers drawn in."""
    return float(np.sqrt((_drawn_in(values) ** 2).sum(axis=1).mean()))


def _drawn_in(values: Array) -> Array:
    """Values (N, 3), no farther out than FAR standard deviations of most of them."""
    far = FAR * np.maximum(robust_std(values), 1e-9)
    return np.clip(values, -far, far)


def _floor(values: Array, recording_of: NDArray[np.intp]) -> float:
    """The same of what values (N, 3) show from sample to sample: noise, which no simulator can take off."""
    parts = [values[recording_of == index] for index in np.unique(recording_of)]
    second = np.concatenate([part[2:] - 2.0 * part[1:-1] + part[:-2] for part in parts])
    return _rms(second[np.isfinite(second).all(axis=1)]) / float(np.sqrt(6.0))


def _held_out(selection: EffectSelection, model: SimulatedModel) -> list[Array]:
    """(N, 3) m/s per recording: what a model, fitted without the fold that a sample is in, says the DVL measures.

    Of several recordings stretches are held out as well: the model's days must have been seen for their own delays.
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
    predicted = [np.full_like(each.dvl.values, np.nan) for each in problem.recordings]
    # at the times that a delay looks at, a reference's noise is another: taken twice it would be too much
    quiet = with_quiet_reference(problem)
    for fold, (fitted,) in fitted_without(fitter, [start], fit.noise, bins, fixed):
        for index in range(n):
            at = sample_folds[index] == fold
            predicted[index][at] = simulated(quiet, fitted.hypothesis, index)[at]
    return predicted


def _fold_of(problem: Problem, index: int) -> Array:
    """(N,) fold of every DVL sample of a recording: stretches of time in turn; -1 outside of what was fitted."""
    time = problem.recordings[index].dvl.time - problem.grids[index].late
    of = problem.grids[index].bin_time
    fold = stretch_of(time) % SETTINGS.folds
    inside = (time >= of[0]) & (time <= of[-1]) if len(of) else np.zeros(len(time), dtype=bool)
    return np.where(inside, fold, -1)


def _reference_noise(problem: Problem, hypothesis: Hypothesis, rng: np.random.Generator) -> list[Array]:
    """(MADE_UP, N, 3) m/s per recording: what made-up noise of the reference makes in the DVL's frame, where it is not
    taken off: slow, where the motion is.
    """
    quiet = with_quiet_reference(problem)
    noisy = [
        with_quiet_reference(
            replace(
                problem,
                recordings=tuple(replace(one, reference=one.reference.shaken(rng)) for one in problem.recordings),
            )
        )
        for _ in range(MADE_UP)
    ]
    return [
        np.stack([simulated(each, hypothesis, index) for each in noisy]) - simulated(quiet, hypothesis, index)
        for index in range(len(problem.recordings))
    ]


def noise_spectrum(of_reference: Array, white: Array) -> Array:
    """(N // 2 + 1, 3) power of noise by frequency, in (m/s)²: of references (R, N, 3) in bands, beside white noise of
    standard deviations (3,).
    """
    power = (np.abs(np.fft.rfft(of_reference, axis=1)) ** 2).mean(axis=0) / of_reference.shape[1]
    edges = np.unique(np.concatenate([[0], np.geomspace(1.0, len(power), BANDS)]).astype(int))
    counts = np.diff(edges)
    mean = np.add.reduceat(power, edges[:-1], axis=0) / counts[:, None]
    return np.asarray(np.repeat(mean, counts, axis=0) + np.maximum(white, 1e-9) ** 2)


def turned_over(residual: Array, spectrum: Array, rng: np.random.Generator) -> Array:
    """(N, 3) m/s: a residual, made white, turned over by chance and made as coloured again as its noise is: so it is as
    loud at every turn as it is there, and what lasts longer than noise of this spectrum is lost.

    Drawn from elsewhere, it would be too loud where the vehicle goes straight on, and windows were told apart by that.
    """
    n = len(residual)
    values = np.nan_to_num(residual - np.nanmedian(residual, axis=0))
    signs = rng.choice([-1.0, 1.0], n)[:, None]
    near = _drawn_in(values)  # outliers are not coloured
    gain = np.sqrt(spectrum)
    white = np.fft.irfft(np.fft.rfft(near, axis=0) / gain, n, axis=0)
    made = np.fft.irfft(np.fft.rfft(white * signs, axis=0) * gain, n, axis=0)
    return np.asarray(made + (values - near) * signs)


def _drawn(pool: Sequence[Array], like: Array, rng: np.random.Generator) -> Array:
    """(N, 3) m/s: noise put together of stretches of residuals."""
    joined = np.concatenate(list(pool))
    joined = joined - np.nanmedian(joined, axis=0)
    n = len(like)
    starts = rng.integers(0, max(len(joined) - STRETCH, 1), -(-n // STRETCH))
    at = (starts[:, None] + np.arange(STRETCH)).ravel()[:n] % len(joined)
    return np.asarray(np.nan_to_num(joined[at]))


# ------------------------------------------------------------------ two samples


def features(values: Array, windows: Array) -> Array:
    """(W, 6) of each window: mean and logarithm of the scatter on every axis."""
    _, index = np.unique(windows, return_inverse=True)
    count = np.bincount(index).astype(float)
    mean = np.stack([np.bincount(index, column) for column in values.T], axis=1) / count[:, None]
    left = values - mean[index]
    variance = np.stack([np.bincount(index, column**2) for column in left.T], axis=1) / count[:, None]
    full = count >= np.maximum(4.0, 0.5 * np.median(count))
    return np.column_stack([mean, 0.5 * np.log(np.maximum(variance, 1e-12))])[full]


def two_samples(one: Array, other: Array, windows: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Energy distance of the windows of two series (N, 3), its 95 per cent quantile if both are alike, and p."""
    a, b = features(one, windows), features(other, windows)
    scale = np.maximum(robust_std(np.concatenate([a, b])), 1e-9)
    both = np.concatenate([a, b]) / scale
    apart = np.linalg.norm(both[:, None] - both[None], axis=2)
    w = len(a)
    if w < 4:
        return np.nan, np.nan, np.nan
    sign = np.concatenate([np.ones(w), -np.ones(w)])

    def energy(signs: Array) -> Array:
        """-s'Ds / w² is 2 E|X-Y| - E|X-X'| - E|Y-Y'|."""
        return -np.einsum("...i,ij,...j->...", signs, apart, signs) / w**2

    swap = rng.choice([-1.0, 1.0], (PERMUTATIONS, w))
    null = energy(np.concatenate([swap, -swap], axis=1))
    value = float(energy(sign))
    p = (1.0 + np.count_nonzero(null >= value)) / (1.0 + PERMUTATIONS)
    null95 = float(np.quantile(null, 0.95))
    return float(np.sqrt(max(value, 0.0))), float(np.sqrt(max(null95, 0.0))), float(p)
