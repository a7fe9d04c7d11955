"""Comparison of a simulator with a vehicle, from both sides' recordings to the answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution
from scipy.stats import norm

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import robust_std
from ..calibration.numerics.tests import holm
from ..diagnosis.answer.gap_location import regimes
from ..diagnosis.answer.noise_findings import NoiseFinding
from ..diagnosis.answer.results import Diagnosis
from ..diagnosis.answer.results import DiagnosisVerdict as Explained
from ..diagnosis.diagnose import VISIBLE_TIMES_TYPICAL
from ..diagnosis.fit.gauss_newton import around
from ..diagnosis.model.stream_curve import FAST_ENOUGH_S
from ..diagnosis.search.effect_selection import EffectSelection
from ..effects.base import EffectInput
from ..effects.registry import EFFECTS
from ..verdict.reasons import Reason, finding
from .both_sides import (
    BLOCK,
    FEWEST_BLOCKS,
    OUTLIER,
    Candidate,
    Log,
    RecordedSide,
    compare_streams,
    mean_of,
    read_log,
    shares_of,
    welch,
)
from .effect_comparison import (
    AS_IT_IS,
    NOISE,
    Size,
    common_names,
    compared_names,
    fitted,
    is_there,
    location_of,
    models,
    p_alike,
    shrink,
    sizes,
    smallest_difference,
    trace_of,
    union,
)
from .results import ComparedEffect, ComparedNoise, ComparisonStatus, Rung, SimulatorVerdict, UnpairedComparison

# Comparison of both sides' noise: level per axis, growth with motion, tails, colour.
#
# The level of a fast DVL is estimated from differences between neighbouring samples, which exclude motion and
# reference; for a slow one from its residual, which includes the reference's noise. Levels are compared over blocks
# of equal size on both sides, so the scatter between blocks accounts for any distribution of the noise.

# smaller ratios of levels are irrelevant
RELEVANT_RATIO = 1.15
# limit of the tails in standard deviations, below outliers
TAIL = 3.7
# smallest share of samples with motion astern to estimate its noise
ASTERN_SHARE, ASTERN_MPS = 0.05, 0.1
# significance level for growth of the log level, and for colour, on either side
GROWS = 1e-4
# smallest standard deviations of speed, m/s, turn rate, rad/s, and speed astern, m/s, to estimate growth
SPREAD = {"speed": 0.1, "turn_rate": 0.01, "astern": 0.05}

Slopes = dict[str, tuple[float, float]]
"""Growth of the log level and its standard deviation, by covariate."""


@dataclass(frozen=True)
class Scatter:
    """Noise samples of one recording. values: (N, 3) m/s, white if the DVL's noise is, of its standard deviation.

    motion: at the samples.
    thin: step between independent samples.
    of_reference: m/s, upper limit of the reference's part.
    """

    values: Array
    motion: EffectInput
    thin: int
    of_reference: float


def compare_noise(vehicle: Log, simulator: Log) -> list[Candidate]:
    """Compare the noise of both sides: level per axis, growth with motion, tails, colour."""
    found: list[Candidate | None] = []
    sides = [scatter(log) for log in (vehicle, simulator)]
    if all(sides) and not (vehicle.exact or simulator.exact):
        slopes = [slopes_of(side) for side in sides]
        of_vehicle, of_simulator = at_one_motion(sides, slopes)
        found += [_level(of_vehicle, of_simulator, axis) for axis in range(3)]
        found += _growth(slopes)
        found += [_tails(of_vehicle, of_simulator)]
    found.append(_colour(vehicle, simulator))
    return [candidate for candidate in found if candidate is not None]


def scatter(log: Log) -> list[Scatter]:
    """Return the noise samples of each recording; empty if there are too few."""
    if log.selection is None:
        return []
    problem, hypothesis = log.selection.fitter.problem, log.selection.fit.hypothesis
    scatters = []
    for index, (recording, residual) in enumerate(zip(log.recordings, log.residuals, strict=True)):
        dvl = recording.dvl
        if dvl.interval <= FAST_ENOUGH_S:
            values, middle, white_norm = _differences(dvl.time, dvl.values, dvl.interval, (1.0, -4.0, 6.0, -4.0, 1.0))
            of_reference, thin = 0.0, 5
        else:
            values, middle, white_norm = _differences(dvl.time, residual, dvl.interval, (1.0, -2.0, 1.0))
            of_reference, thin = float(np.mean(recording.reference.noise)), 3
        if len(values) < FEWEST_BLOCKS * BLOCK:
            continue
        motion = problem.seen(hypothesis, index, dvl.time[middle]).motion
        scatters.append(Scatter(values / white_norm, motion, thin, of_reference))
    return scatters


def _differences(
    time: Array, values: Array, interval: float, weights: Sequence[float]
) -> tuple[Array, NDArray[np.intp], float]:
    """Return gapless weighted sums (K, 3) of consecutive samples, their middle indices, and the gain of white noise."""
    w, n_aside = np.array(weights), len(weights) // 2
    n = len(time) - 2 * n_aside
    if n < 1:
        return np.zeros((0, values.shape[1])), np.zeros(0, dtype=np.intp), 1.0
    middle = np.arange(n_aside, n_aside + n)
    sums = np.sum([weight * values[shift : shift + n] for shift, weight in enumerate(w)], axis=0)
    adjacent = np.abs(time[2 * n_aside :] - time[:n] - 2 * n_aside * interval) < 0.5 * interval
    return sums[adjacent], middle[adjacent], float(np.sqrt(w @ w))


def block_levels(scattered: Sequence[Scatter], axis: int) -> Array:
    """Return the log standard deviation (B,) of one axis in blocks of equal size."""
    levels = []
    for recorded in scattered:
        values = recorded.values[:, axis]
        blocks = values[: len(values) // BLOCK * BLOCK].reshape(-1, BLOCK)
        levels.append(np.log(np.maximum(np.median(np.abs(blocks), axis=1) / norm.ppf(0.75), 1e-9)))
    return np.concatenate(levels)


def _level(vehicle: Sequence[Scatter], simulator: Sequence[Scatter], axis: int) -> Candidate | None:
    """Compare the level of one DVL axis. The possible part of the reference in a slow DVL's level is not claimed."""
    blocks = [block_levels(side, axis) for side in (vehicle, simulator)]
    if min(map(len, blocks)) < FEWEST_BLOCKS:
        return None
    of_reference = [max(recorded.of_reference for recorded in side) for side in (vehicle, simulator)]
    intervals = []
    for levels, reference in zip(blocks, of_reference, strict=True):
        value, low, high = np.exp(np.array(mean_of(levels)))
        intervals.append((float(value), float(np.sqrt(max(low**2 - reference**2, 0.0))), float(high)))
    larger = 0 if intervals[0][0] >= intervals[1][0] else 1
    own_levels = [np.asarray(block) for block in blocks]
    if of_reference[larger] > 0.0:
        own_variance = np.exp(2.0 * own_levels[larger]) - of_reference[larger] ** 2
        own_levels[larger] = 0.5 * np.log(np.maximum(own_variance, 1e-12))
    ratio = float(np.exp(own_levels[larger].mean() - own_levels[1 - larger].mean()))
    note = "DVL and reference together" if max(of_reference) > 0.0 else ""
    return Candidate(
        f"level_{'xyz'[axis]}", "m/s", intervals[0], intervals[1], welch(own_levels[0], own_levels[1]),
        matters=ratio > RELEVANT_RATIO, note=note,
    )  # fmt: skip


def levels_by_regime(log: Log) -> dict[str, float]:
    """Return regime of motion -> m/s, root of the sum over axes of the squared noise level."""
    noise_samples = scatter(log)
    if not noise_samples or log.selection is None:
        return {}
    values = np.concatenate([noise_sample.values for noise_sample in noise_samples])
    masks = {"all": np.ones(len(values), dtype=bool)}
    has_motion: Any = noise_samples  # per sample, `regimes` reads nothing but the motion
    masks |= regimes(log.selection.fitter.problem, has_motion, per_sample=True)
    return {
        name: float(np.linalg.norm(robust_std(values[mask])))
        for name, mask in masks.items()
        if np.count_nonzero(mask) > BLOCK
    }


def _growth(slopes: Sequence[Slopes]) -> list[Candidate | None]:
    """Compare slopes of the log level with speed, turn rate, and speed astern.

    If a simulator's σ depends on the signed speed, its level astern is below that ahead.
    """
    units = {"speed": "1/(m/s)", "turn_rate": "1/(rad/s)", "astern": "1/(m/s)"}
    found: list[Candidate | None] = []
    for name, unit in units.items():
        if not all(name in slope for slope in slopes):
            continue
        (vehicle_slope, vehicle_std), (simulator_slope, simulator_std) = (slope[name] for slope in slopes)
        vehicle, simulator = around(vehicle_slope, vehicle_std), around(simulator_slope, simulator_std)
        is_present = _is_significant(slopes[0], name), _is_significant(slopes[1], name)
        p = float(2.0 * norm.sf(abs(vehicle_slope - simulator_slope) / np.hypot(vehicle_std, simulator_std)))
        found.append(Candidate(f"growth_with_{name}", unit, vehicle, simulator, p, is_present, any(is_present)))
    return found


def _is_significant(slopes: Slopes, name: str) -> bool:
    """Return whether a slope is significant."""
    value, std = slopes[name]
    return bool(2.0 * norm.sf(abs(value) / std) < GROWS)


def at_one_motion(sides: Sequence[Sequence[Scatter]], slopes: Sequence[Slopes]) -> list[list[Scatter]]:
    """Scale the noise of both sides to a common motion, by the significant growth of each side.

    sides: noise of the recordings of vehicle and simulator. slopes: growth of both.
    """
    scaled = [list(side) for side in sides]
    for name in SPREAD:
        grows = [name in slope and _is_significant(slope, name) for slope in slopes]
        covariates = [[_covariates(recorded) for recorded in side] for side in sides]
        if not any(grows) or not all(name in known for side in covariates for known in side):
            continue
        values = [[known[name] for known in side] for side in covariates]
        common = float(np.mean([np.mean(np.concatenate(side)) for side in values]))
        for side in (side for side in range(len(sides)) if grows[side]):
            for index, value in enumerate(values[side]):
                factor = np.exp(-slopes[side][name][0] * (value - common))
                noise = scaled[side][index]
                scaled[side][index] = replace(noise, values=noise.values * factor[:, None])
    return scaled


def _covariates(scattered: Scatter) -> dict[str, Array]:
    """Return speed m/s, turn rate rad/s if known, and speed astern m/s; each (N,)."""
    motion = scattered.motion
    found = {"speed": motion.speed}
    if motion.angular_velocity is not None:
        found["turn_rate"] = np.abs(motion.turn_rate[:, 2])
    return found | {"astern": np.maximum(-motion.velocity_body[:, 0], 0.0)}


def slopes_of(scattered: Sequence[Scatter]) -> Slopes:
    """Fit slope and standard deviation by covariate to log squares, with the scatter of blocks (sandwich estimate)."""
    covariates = [_covariates(side) for side in scattered]
    names = [name for name in SPREAD if all(name in side for side in covariates)]
    columns = {name: np.concatenate([side[name] for side in covariates]) for name in names}
    if np.mean(columns["astern"] > ASTERN_MPS) <= ASTERN_SHARE:
        del columns["astern"]
    columns = {name: column for name, column in columns.items() if np.std(column) > SPREAD[name]}
    if not columns:
        return {}
    values = np.concatenate([covariates.values for covariates in scattered])
    scale = robust_std(values)
    log_square = np.log(np.maximum(((values / scale) ** 2).mean(axis=1), 1e-12))
    design = np.column_stack([np.ones(len(values)), *(column - column.mean() for column in columns.values())])
    inverse = np.linalg.pinv(design.T @ design)
    parameters = inverse @ design.T @ log_square
    block = np.arange(len(design)) // BLOCK
    sample_scores = (log_square - design @ parameters)[:, None] * design
    scores = np.stack([np.bincount(block, column) for column in sample_scores.T], axis=1)
    n = len(scores)
    covariance = inverse @ (scores.T @ scores) @ inverse * n / max(n - design.shape[1], 1)
    std = np.sqrt(np.diag(covariance))
    return {name: (0.5 * float(parameters[i]), 0.5 * float(std[i])) for i, name in enumerate(columns, start=1)}


def _tails(vehicle: Sequence[Scatter], simulator: Sequence[Scatter]) -> Candidate | None:
    """Compare shares of independent samples beyond TAIL standard deviations; those beyond OUTLIER are outliers."""
    counts = []
    for side in (vehicle, simulator):
        far = n = 0
        for recorded in side:
            size = np.abs(recorded.values[:: recorded.thin]) / robust_std(recorded.values)
            far += int(((size > TAIL) & (size < OUTLIER)).sum())
            n += size.size
        counts.append((far, n))
    return shares_of("heavy_tails", counts[0], counts[1])


def _colour(vehicle: Log, simulator: Log) -> Candidate | None:
    """Compare slow noise: means over blocks, against white noise of the same level.

    Only if it is significant on one side: the reference's noise, and its motion between samples, also contribute to
    these means and differ between the sides.
    """
    of_vehicle, of_simulator = _colour_finding(vehicle), _colour_finding(simulator)
    if of_vehicle is None and of_simulator is None:
        return None
    vehicle_means, simulator_means = _block_means(vehicle), _block_means(simulator)
    if min(len(vehicle_means), len(simulator_means)) < 3 * FEWEST_BLOCKS:
        return None
    ratio = float(np.mean(vehicle_means**2) / np.mean(simulator_means**2))
    above = float(f_distribution.sf(ratio, len(vehicle_means), len(simulator_means)))
    p = 2.0 * min(above, 1.0 - above)
    times = [f.parameters["time_constant_s"] if f is not None else (0.0, 0.0, 0.0) for f in (of_vehicle, of_simulator)]
    is_present = of_vehicle is not None, of_simulator is not None
    return Candidate("colour", "s", times[0], times[1], p, is_present, note="of DVL or reference")


def _colour_finding(log: Log) -> NoiseFinding | None:
    """Return the diagnosis's finding of slow noise, if it is significant."""
    found = (entry for entry in log.diagnosis.noise if entry.name == "coloured_reference_noise" and entry.p < GROWS)
    return next(found, None)


def _block_means(log: Log) -> Array:
    """Return block means (B,) of residuals, in standard deviations expected for white noise."""
    means = []
    for residual in log.residuals:
        size = max(BLOCK, 1)
        blocks = residual[: len(residual) // size * size].reshape(-1, size, 3)
        level = robust_std(np.diff(residual, axis=0)) / np.sqrt(2.0)
        means.append((np.median(blocks, axis=1) / np.maximum(level, 1e-9) * np.sqrt(size / 1.57)).ravel())
    return np.concatenate(means) if means else np.zeros(0)


# family-wise level over all claimed differences
LEVEL = 0.01
ORDER = (
    ComparisonStatus.MISSING,
    ComparisonStatus.OTHER_SIZE,
    ComparisonStatus.ONLY_SIMULATOR,
    ComparisonStatus.ALIKE,
    ComparisonStatus.CANNOT_TELL,
)


def compare(
    vehicle: RecordedSide,
    simulator: RecordedSide,
    on_progress: Callable[[float], None] = lambda _: None,
    with_series: bool = False,
) -> UnpairedComparison:
    """Compare bags of a vehicle with bags of a simulator. Raises InputError if they cannot be compared."""
    real = read_log(vehicle, lambda share: on_progress(0.4 * share), with_series)
    simulated = read_log(simulator, lambda share: on_progress(0.4 + 0.4 * share), with_series)
    comparison = compare_logs(real, simulated)
    on_progress(1.0)
    return replace(comparison, reasons=(*comparison.reasons, *other_frame(vehicle, simulator)))


def other_frame(vehicle: RecordedSide, simulator: RecordedSide) -> tuple[Reason, ...]:
    """Return the reason for a simulator whose DVL has other axes or another mounting, as configured or discovered."""
    frames = []
    for side in (vehicle, simulator):
        roll, pitch, yaw = np.rad2deg(side.parameters.mounting_rpy).round().astype(int).tolist()
        frames.append(f"{roll}° {pitch}° {yaw}° (dvl_axes {side.parameters.dvl_axes})")
    return () if frames[0] == frames[1] else (finding("SIMULATOR_FRAME", vehicle=frames[0], simulator=frames[1]),)


def compare_logs(vehicle: Log, simulator: Log) -> UnpairedComparison:
    """Run `compare` for sides that are already read and diagnosed."""
    selections = vehicle.selection, simulator.selection
    sides = {"vehicle": vehicle, "simulator": simulator}
    if selections[0] is None or selections[1] is None:
        return _nothing_to_compare({side: log.diagnosis for side, log in sides.items()})
    candidates = [*compare_noise(vehicle, simulator), *compare_streams(vehicle, simulator)]
    names = common_names(vehicle, simulator)
    compared = _Compared((vehicle, simulator), (selections[0], selections[1]), names, union(*names))
    p = holm([*compared.p.values(), *(candidate.p for candidate in candidates)])
    effects = [compared.effect(name, float(p[i])) for i, name in enumerate(compared.p)]
    effects += [compared.untested(name) for name in compared.names if name not in compared.p]
    effects.sort(key=lambda effect: (ORDER.index(effect.status), -effect.adds_mps))
    of_noise = p[len(compared.p) :].tolist()
    noise = [_noise(candidate, adjusted) for candidate, adjusted in zip(candidates, of_noise, strict=True)]
    noise.sort(key=lambda entry: (ORDER.index(entry.status), entry.p))
    status = {effect.name: effect.status for effect in effects}
    compared_sizes = {name: (*compared.sizes[name], status[name]) for name in compared.p}
    own_effects = [compared.sizes[name][0].effect for name in names[0].values() if name in compared.sizes]
    shrunk = shrink(vehicle, simulator, models(compared_sizes, own_effects))
    levels = [levels_by_regime(log) for log in (vehicle, simulator)]
    verdict = _verdict(effects, noise, vehicle.diagnosis, simulator.diagnosis)
    return UnpairedComparison(
        verdict=verdict,
        reasons=_reasons(verdict, effects, noise, shrunk.rungs, vehicle.diagnosis, simulator.diagnosis),
        effects=tuple(effects),
        noise=tuple(noise),
        levels={name: (level, levels[1][name]) for name, level in levels[0].items() if name in levels[1]},
        rungs=shrunk.rungs,
        floor_mps=shrunk.floor,
        not_shown={side: _unobserved(log.diagnosis) for side, log in sides.items()},
        vehicle=vehicle.diagnosis,
        simulator=simulator.diagnosis,
        notes=tuple(f"{side}: {note}" for side, log in sides.items() for note in log.diagnosis.notes),
        series={
            "shrunk": shrunk,
            "residuals": {side: log.residuals for side, log in sides.items()},
            "intervals": {side: [one.dvl.interval for one in log.recordings] for side, log in sides.items()},
        },
    )


class _Compared:
    """Effects found on either side, fitted to both, with the p-value of equal sizes."""

    def __init__(
        self,
        logs: tuple[Log, Log],
        selections: tuple[EffectSelection, EffectSelection],
        renamed: tuple[Mapping[str, str], Mapping[str, str]],
        names: Sequence[str],
    ) -> None:
        """Fit the effects of both sides. All pairs are (vehicle, simulator).

        renamed: name of an effect in a side's diagnosis -> name under which both sides are compared.
        names: effects to fit on both sides.
        """
        self.names = names
        self._selections, self._logs, self._renamed = selections, logs, renamed
        self._fits = tuple(fitted(selection, names) for selection in selections)
        vehicle, simulator = self._sizes_of_sides = [
            sizes(selection, fit, list(side_names.values()))
            for selection, fit, side_names in zip(selections, self._fits, renamed, strict=True)
        ]
        self.sizes: dict[str, tuple[Size, Size]] = {
            name: (vehicle[name], simulator[name])
            for name in names
            if name in vehicle and name in simulator and compared_names(vehicle[name], simulator[name])
        }
        self.p = {name: p_alike(*both) for name, both in self.sizes.items()}

    def effect(self, name: str, p: float) -> ComparedEffect:
        """Compare an effect that both sides can be tested for. p: corrected for multiple tests."""
        vehicle, simulator = self.sizes[name]
        is_present = is_there(vehicle, simulator), is_there(simulator, vehicle)
        status = _status(is_present, p < LEVEL)
        needs = ""
        if status is ComparisonStatus.CANNOT_TELL:
            blind = "simulator" if is_present[0] else "vehicle"
            detectable = smallest_difference(vehicle, simulator, len(self.p))
            smallest = ", ".join(f"{key} {value:.2g}" for key, value in detectable.items())
            needs = (
                f"the two logs together would show a difference of {smallest}; with the {blind}: "
                f"{EFFECTS[name].manoeuvre}"
            )
        side = 1 if status is ComparisonStatus.ONLY_SIMULATOR or not is_present[0] else 0
        trace = trace_of(self._selections[side], self._fits[side], self.sizes[name][side].effect)
        adds = float(np.sqrt((trace**2).sum(axis=1).mean()))
        where = location_of(self._selections[side], self._fits[side], trace)
        return ComparedEffect(
            name, status, self._equivalent(name), vehicle.intervals(), simulator.intervals(), p, adds, where, needs
        )

    def untested(self, name: str) -> ComparedEffect:
        """Report an effect that one side cannot be tested for, or whose observable parts differ between the sides."""
        sizes = [side[name].intervals() if name in side else {} for side in self._sizes_of_sides]
        effect = EFFECTS[name]
        needs = f"no common part of it is observable in both logs: {effect.manoeuvre}"
        for side, selection in zip(("vehicle", "simulator"), self._selections, strict=True):
            if name not in selection.testable:
                lacks = ", ".join(sorted(need.value for need in effect.needs))
                needs = f"the {side}'s log lacks {'a second recording' if effect.relative_to_first else lacks}"
                break
        return ComparedEffect(
            name, ComparisonStatus.CANNOT_TELL, self._equivalent(name), sizes[0], sizes[1], float("nan"), needs=needs
        )

    def _equivalent(self, name: str) -> tuple[str, ...]:
        """Return the effects that either diagnosis cannot distinguish from this one."""
        others: list[str] = []
        for log, renamed in zip(self._logs, self._renamed, strict=True):
            for effect in log.diagnosis.effects:
                if renamed[effect.name] == name:
                    others += [n for n in (effect.name, *effect.equivalent_to) if n != name]
        return tuple(dict.fromkeys(others))


def _status(present: tuple[bool, bool], differ: bool) -> ComparisonStatus:
    """Return the status of an effect from its presence on (vehicle, simulator) and whether the sizes differ."""
    if present[0] and present[1]:
        return ComparisonStatus.OTHER_SIZE if differ else ComparisonStatus.ALIKE
    if not differ:
        return ComparisonStatus.CANNOT_TELL
    return ComparisonStatus.MISSING if present[0] else ComparisonStatus.ONLY_SIMULATOR


def _noise(candidate: Candidate, p: float) -> ComparedNoise:
    """Compare a noise property of vehicle and simulator at its p corrected for multiple tests.

    On one side only, but without a significant difference, or on neither side, it counts as alike.
    """
    differ = p < LEVEL and candidate.matters
    status = _status(candidate.there, differ) if any(candidate.there) else ComparisonStatus.ALIKE
    if status is ComparisonStatus.CANNOT_TELL:
        status = ComparisonStatus.ALIKE
    return ComparedNoise(
        candidate.name, status, candidate.unit, candidate.vehicle, candidate.simulator, p, candidate.note
    )


def _unobserved(diagnosis: Diagnosis) -> dict[str, str]:
    """Return effects unobservable on a side at relevant sizes -> the smallest detectable size, or the missing data."""
    found = {name: f"needs {needs}" for name, needs in diagnosis.untestable.items()}
    named = {effect.name for effect in diagnosis.effects}
    for name, least in diagnosis.minimum_detectable.items():
        typical = {spec.name: spec.typical for spec in EFFECTS[name].parameters}
        if name not in named and not any(size <= VISIBLE_TIMES_TYPICAL * typical[key] for key, size in least.items()):
            found[name] = "from " + ", ".join(f"{key} {size:.2g}" for key, size in least.items())
    return found


def _verdict(
    effects: Sequence[ComparedEffect], noise: Sequence[ComparedNoise], vehicle: Diagnosis, simulator: Diagnosis
) -> SimulatorVerdict:
    """Return the verdict: effects weigh more than noise, and a difference more than missing excitation."""
    if any(effect.status.is_claim for effect in effects):
        return SimulatorVerdict.DIFFERENT
    if any(entry.status.is_claim for entry in noise):
        return SimulatorVerdict.ONLY_NOISE
    unsure = Explained.INSUFFICIENT_EXCITATION in (vehicle.verdict, simulator.verdict)
    if unsure or any(effect.status is ComparisonStatus.CANNOT_TELL for effect in effects):
        return SimulatorVerdict.CANNOT_TELL
    return SimulatorVerdict.NO_DIFFERENCE


CLAIMED = {
    ComparisonStatus.MISSING: "SIMULATOR_LACKS",
    ComparisonStatus.OTHER_SIZE: "SIMULATOR_OTHER_SIZE",
    ComparisonStatus.ONLY_SIMULATOR: "SIMULATOR_ALONE_HAS",
}


def _reasons(
    verdict: SimulatorVerdict,
    effects: Sequence[ComparedEffect],
    noise: Sequence[ComparedNoise],
    rungs: Sequence[Rung],
    vehicle: Diagnosis,
    simulator: Diagnosis,
) -> tuple[Reason, ...]:
    """Return the verdict's reasons, and the unexplained remainder."""
    reasons = []
    for status, code in CLAIMED.items():
        named = [" or ".join((effect.name, *effect.equivalent_to)) for effect in effects if effect.status is status]
        if named:
            reasons.append(finding(code, names=" and ".join(named)))
    if reasons:
        error = {rung.name: 1e3 * rung.error_mps for rung in rungs}
        reasons.append(finding("SIMULATOR_PUT_RIGHT", before=error[AS_IT_IS], after=error[NOISE]))
    else:
        is_open = verdict is SimulatorVerdict.CANNOT_TELL
        reasons.append(finding("SIMULATOR_NOT_SHOWN" if is_open else "SIMULATOR_ALIKE"))
    if differing := [entry.name for entry in noise if entry.status.is_claim]:
        reasons.append(finding("SIMULATOR_NOISE", names=", ".join(differing)))
    unknown = [side for side, d in (("vehicle", vehicle), ("simulator", simulator)) if d.verdict is Explained.UNKNOWN]
    if unknown:
        reasons.append(finding("SIMULATOR_UNKNOWN_REST", sides=" and of the ".join(unknown)))
    return tuple(reasons)


def _nothing_to_compare(sides: Mapping[str, Diagnosis]) -> UnpairedComparison:
    """Return the comparison if at least one side could not be diagnosed."""
    reasons = tuple(
        finding("SIMULATOR_NOTHING_COMPARED", side=side, why=diagnosis.reasons)
        for side, diagnosis in sides.items()
        if diagnosis.selection is None
    )
    not_shown: dict[str, dict[str, str]] = {side: {} for side in sides}
    vehicle, simulator = sides.values()
    return UnpairedComparison(
        SimulatorVerdict.CANNOT_TELL, reasons, (), (), {}, (), float("nan"), not_shown, vehicle, simulator
    )
