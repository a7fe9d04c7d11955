"""Diagnosis of bags."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.distributions import normal_isf
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import VelocityFrame
from ..effects.base import ClockEffect, Effect, EffectNeeds
from ..effects.registry import EFFECTS
from ..errors import InputError
from ..recordings.recording import Recording as Opened
from ..recordings.topics import Topics
from ..verdict.reasons import Reason, finding
from .answer.confidence_intervals import Times, Triple, covariance_of
from .answer.dvl_description import dvl_seen
from .answer.gap_closure import Gap, closure_alone, held_out, measure_gap, with_closure
from .answer.gap_location import places
from .answer.noise_findings import noise_findings
from .answer.plotted_series import collect_series
from .answer.results import Diagnosis, DiagnosisVerdict, FoundEffect, diagnosis_document
from .answer.simulated_twin import twins
from .fit.gauss_newton import around, prior_std
from .model.hypothesis import amplitudes
from .model.recorded_streams import RecordedStreams, load_recordings
from .model.settings import SETTINGS
from .noise.whitened_least_squares import WhitenedLeastSquares
from .search.arm_clock_ambiguity import (
    ARM,
    LAG,
    TWO_CLOCKS,
    Combination,
    ambiguous_combination,
    combination,
    with_ambiguity,
    with_changes,
)
from .search.effect_selection import EffectSelection, TooFewBinsError, select
from .search.identifiability import Selected
from .search.initial_guess import check_clocks
from .search.observable_parameters import default_values, with_observable
from .search.unexplained import Unexplained, find_unexplained, nuisance_shift, without_replaceable

__all__ = ["diagnose", "diagnose_recordings", "diagnosis_document"]

# An effect is observable if one of its parameters is detectable at this multiple of its typical size
VISIBLE_TIMES_TYPICAL = 3.0
# Least share of observable effects for the verdict NO_GAP
MIN_VISIBLE_SHARE = 0.5
POWER = 0.8
# Least closure of an explanation; below its complement nothing is explained, between them a part (issue 46)
FULL_CLOSURE = 0.8


def diagnose(
    source: Opened | Sequence[Path],
    parameters: Parameters,
    topics: Topics | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    effects: Mapping[str, Effect] = EFFECTS,
    with_series: bool = False,
    *,
    forget: bool = False,
) -> Diagnosis:
    """Diagnose bags of one vehicle. Raises InputError for data that cannot be compared.

    forget: as in `load_recordings`.
    """
    loaded = load_recordings(source, parameters, topics or Topics(), forget=forget)
    on_progress(0.5)
    diagnosis = diagnose_recordings(loaded.recordings, parameters, loaded.notes, effects, with_series)
    on_progress(1.0)
    return diagnosis


def diagnose_recordings(
    recordings: Sequence[RecordedStreams],
    parameters: Parameters,
    notes: Sequence[str] = (),
    effects: Mapping[str, Effect] = EFFECTS,
    with_series: bool = False,
) -> Diagnosis:
    """Select, fit and validate effects on recordings in memory. Raises InputError for too large clock offsets."""
    insufficiency = _insufficiency(recordings)
    if insufficiency:
        return _undiagnosed(insufficiency, notes)
    for recording in recordings:
        check_clocks(recording, parameters.rotation_dvl_from_body)
    available = frozenset.intersection(*(recording.available for recording in recordings))
    untestable = {name: why for name, effect in effects.items() if (why := _missing(effect, available, recordings))}
    try:
        selection = select(
            recordings,
            parameters.rotation_dvl_from_body,
            np.array(parameters.lever_arm),
            {name: effect for name, effect in effects.items() if name not in untestable},
        )
    except TooFewBinsError as error:
        return _undiagnosed(_too_short(error.samples, sum(each.seconds for each in recordings)), notes)
    testable = selection.testable
    _check_bounds(selection)
    selection, unexplained = without_replaceable(selection)
    residuals = held_out(selection, unexplained)
    gap = measure_gap(selection, residuals)
    # what one stretch alone determines, as a clock jump in the only turn, is not tested by leaving it out
    if selection.selected and gap.after**2 - gap.left_open**2 >= gap.before**2:
        selection = selection.without(selection.fit.values)
        unexplained = find_unexplained(selection.fitter, selection.fit)
        residuals = held_out(selection, unexplained)
        gap = measure_gap(selection, residuals)
    covariance, times = covariance_of(selection)
    gap = with_closure(gap, selection, covariance, residuals)
    detectable = {name: _minimum_detectable(selection, effect, len(testable)) for name, effect in testable.items()}
    times_typical = {name: _times_typical(testable[name], sizes) for name, sizes in detectable.items()}
    visible = [name for name, times in times_typical.items() if times <= VISIBLE_TIMES_TYPICAL]
    verdict = _verdict(selection, unexplained, gap, len(visible) / len(testable))
    if unexplained.found:  # the unknown cause may contribute
        shift = nuisance_shift(selection.fitter.problem, selection.fit, unexplained)
        covariance = covariance + np.outer(shift, shift)
    covariance = with_observable(selection.fitter.problem, selection.fit, covariance)
    unchanged, covariance = covariance, with_ambiguity(selection.fit, covariance, selection.trade_off)
    covariance = with_changes(selection.fit, covariance, selection.changes)
    found = tuple(
        _found_effect(selection, each, covariance, unchanged, times, len(testable), gap) for each in selection.selected
    )
    columns = unexplained.columns
    if selection.selected and not unexplained.found:
        columns = selection.fit.columns[:, :, 6:]
    is_gap = verdict in (DiagnosisVerdict.KNOWN, DiagnosisVerdict.AMBIGUOUS, DiagnosisVerdict.UNKNOWN)
    hypothesis = selection.fit.hypothesis
    calibration = zip([*hypothesis.phi, *hypothesis.scale], np.sqrt(np.diag(covariance)[:6]).tolist(), strict=True)
    return Diagnosis(
        verdict=verdict,
        reasons=_reasons(verdict, gap, found, unexplained, visible, len(testable)),
        gap=gap,
        effects=found,
        noise=tuple(noise_findings(selection.fitter, selection.fit)),
        where=tuple(places(selection.fitter, selection.base, selection.fit, columns)) if is_gap else (),
        untestable=untestable,
        minimum_detectable=detectable,
        next_steps=_next_steps(verdict, selection.selected, testable, untestable, times_typical),
        notes=tuple(notes),
        series=collect_series(selection, residuals, unexplained, covariance) if with_series else None,
        calibration=tuple(around(float(value), std) for value, std in calibration),
        compared_axes=_compared_axes(selection),
        recordings=tuple((recording.name, recording.first_ns) for recording in recordings),
        twins=twins(selection),
        dvl=dvl_seen(selection, parameters),
        selection=selection,
        covariance=covariance,
    )


def _check_bounds(selection: EffectSelection) -> None:
    """Raise InputError for a clock offset at its bound: it is larger, and biases all other parameters."""
    hypothesis = selection.fit.hypothesis
    for each in hypothesis.parameters():
        value, spec = hypothesis.value(each), each.spec
        if isinstance(each.effect, ClockEffect) and abs(value) >= 0.999 * spec.high:
            name = selection.fitter.problem.recordings[each.recording or 0].name
            raise InputError(
                f"{name}: {each.effect.name} comes out at {value:+.3g} {spec.unit}, the largest that can be diagnosed "
                "and subtracted: set that clock, or use the recording times (--restamp log)"
            )


def _missing(effect: Effect, available: frozenset[EffectNeeds], recordings: Sequence[RecordedStreams]) -> str:
    """Return the inputs that an effect needs and recordings lack, '' if none."""
    lacking = [need.value for need in effect.needs - available]
    if effect.relative_to_first and len(recordings) < 2:
        lacking.append("a second recording")
    return ", ".join(sorted(lacking))


def _compared_axes(selection: EffectSelection) -> str:
    """Return the compared axes in words."""
    problem = selection.fitter.problem
    axes = "".join(name for name, measured in zip("xyz", problem.measured, strict=True) if measured)
    if len(axes) == 3:
        return axes
    in_body = all(recording.frame is VelocityFrame.BODY for recording in problem.recordings)
    return f"{axes} of the body" if in_body else f"{axes} of the body held level" if axes == "xy" else f"{axes} (ENU)"


def _insufficiency(recordings: Sequence[RecordedStreams]) -> Reason | None:
    """Return the reason against diagnosing recordings. Return None if there is none."""
    seconds = sum(recording.seconds for recording in recordings)
    samples = sum(min(len(recording.dvl.time), len(recording.reference.time)) for recording in recordings)
    if samples < SETTINGS.min_bins or seconds < SETTINGS.min_seconds:
        return _too_short(samples, seconds)
    if max(float(np.ptp(recording.reference.values, axis=0).max()) for recording in recordings) < 1e-6:
        return finding("GAP_REFERENCE_CONSTANT")
    if not any(recording.measured[0] and recording.measured[1] for recording in recordings):
        return finding("GAP_REFERENCE_VERTICAL")
    return None


def _too_short(samples: int, seconds: float) -> Reason:
    return finding("GAP_TOO_SHORT", samples=samples, seconds=seconds, wanted=SETTINGS.min_seconds)


def _undiagnosed(why: Reason, notes: Sequence[str]) -> Diagnosis:
    """Return a diagnosis without numbers, for data that cannot answer."""
    nan = float("nan")
    return Diagnosis(
        verdict=DiagnosisVerdict.INSUFFICIENT_EXCITATION,
        reasons=(why,),
        gap=Gap(nan, nan, nan, nan, (nan, nan)),
        effects=(),
        noise=(),
        where=(),
        untestable={},
        minimum_detectable={},
        next_steps=(finding("NEXT_ANYTHING"),),
        notes=tuple(notes),
    )


# Reason code of each verdict
CODES = {
    DiagnosisVerdict.KNOWN: "GAP_EXPLAINED",
    DiagnosisVerdict.AMBIGUOUS: "GAP_AMBIGUOUS",
    DiagnosisVerdict.UNKNOWN: "GAP_UNKNOWN",
    DiagnosisVerdict.NO_GAP: "NO_GAP",
    DiagnosisVerdict.INSUFFICIENT_EXCITATION: "GAP_NOT_TESTABLE",
}


def _verdict(selection: EffectSelection, unexplained: Unexplained, gap: Gap, visible_share: float) -> DiagnosisVerdict:
    """Return the verdict; a systematic residual or a failure on held-out data makes it unknown."""
    if unexplained.found or gap.fails_held_out:
        return DiagnosisVerdict.UNKNOWN
    if selection.selected and gap.closure < 1.0 - FULL_CLOSURE:
        return DiagnosisVerdict.UNKNOWN
    if selection.selected:
        ambiguous = any(each.equivalent for each in selection.selected)
        return DiagnosisVerdict.AMBIGUOUS if ambiguous else DiagnosisVerdict.KNOWN
    if visible_share < MIN_VISIBLE_SHARE:
        return DiagnosisVerdict.INSUFFICIENT_EXCITATION
    return DiagnosisVerdict.UNKNOWN if gap.is_reported else DiagnosisVerdict.NO_GAP


def _minimum_detectable(selection: EffectSelection, effect: Effect, n_tested: int) -> dict[str, float]:
    """Return the size of each parameter that is detected with a power of 80 per cent at the level of the tests."""
    fit, problem = selection.fit, selection.fitter.problem
    columns = [fit.columns]
    std = [prior_std(fit.hypothesis)]
    at = fit.hypothesis.indices_of(effect.name)
    if not len(at):
        columns.append(problem.columns(fit.hypothesis, fit.seen, effect, default_values(effect, problem)))
        std.append(np.full(columns[-1].shape[2], 1e6))
        at = len(std[0]) + np.arange(len(std[1]))
    white = fit.noise.whiten(np.concatenate(columns, axis=2))
    prior = np.concatenate(std)
    system = WhitenedLeastSquares.of(white, np.zeros(len(white)), prior, np.zeros(len(prior)))
    own = np.sqrt(np.maximum(np.diag(system.covariance())[at], 0.0))
    factor = float(normal_isf(SETTINGS.level / n_tested / 2.0) + normal_isf(1.0 - POWER))
    return {spec.name: factor * float(each) for spec, each in zip(amplitudes(effect), own, strict=False)}


def _times_typical(effect: Effect, sizes: Mapping[str, float]) -> float:
    """Return the least ratio of detectable sizes to the parameters' typical sizes."""
    return min(sizes[spec.name] / spec.typical for spec in effect.parameters if spec.name in sizes)


def _found_effect(
    selection: EffectSelection,
    selected: Selected,
    covariance: Array,
    unchanged: Array,
    times: Times,
    n_tested: int,
    gap: Gap,
) -> FoundEffect:
    """Return a selected effect with intervals of its sizes and times."""
    fit, effect = selection.fit, selected.effect
    stds = np.sqrt(np.diag(covariance))[fit.hypothesis.indices_of(effect.name)].tolist()
    known = times | {
        (effect.name, each.recording or 0, each.spec.name): around(fit.hypothesis.value(each), std)
        for each, std in zip(fit.hypothesis.parameters_of(effect), stds, strict=True)
    }
    ordered = {
        recording: {spec.name: known[effect.name, recording, spec.name] for spec in effect.parameters}
        for recording in dict.fromkeys(each.recording or 0 for each in fit.hypothesis.parameters_of(effect))
    }
    names = [recording.name for recording in selection.fitter.problem.recordings]
    together = _weighted_mean(list(ordered.values())) if len(ordered) > 1 else next(iter(ordered.values()))
    is_of_each = effect.per_recording and len(names) > 1
    return FoundEffect(
        effect.name,
        selected.equivalent,
        together,
        closure_alone(selection, gap, effect.name),
        min(1.0, float(np.exp(selected.log_p)) * n_tested),
        {names[recording]: parameters for recording, parameters in ordered.items()} if is_of_each else {},
        _known_together(selection, unchanged, selected),
    )


def _known_together(selection: EffectSelection, covariance: Array, selected: Selected) -> Combination | None:
    """Return the observable combination of an ambiguous lever arm and clock, the most precise of several."""
    fit, name, others = selection.fit, selected.effect.name, selected.equivalent
    if LAG in fit.values:  # a lag absorbs part of the delay
        return None
    if name == ARM and others and not {*TWO_CLOCKS} & fit.values.keys():
        return ambiguous_combination(fit, covariance, selection.trade_off)
    clocks = [name] if ARM in others else [each for each in others if each in TWO_CLOCKS] if name == ARM else []
    each = [found for clock in clocks if (found := combination(fit, covariance, clock)) is not None]
    return min(each, key=lambda one: one.value[2] - one.value[1], default=None)


def _weighted_mean(each: Sequence[Mapping[str, Triple]]) -> dict[str, Triple]:
    """Return the weighted mean of values with 95 per cent intervals; infinite ones as in the first."""
    mean: dict[str, Triple] = {}
    for name, first in each[0].items():
        values = np.array([one[name] for one in each])
        if not np.isfinite(values).all():
            mean[name] = first
            continue
        weight = 1.0 / np.maximum((values[:, 2] - values[:, 1]) / 3.92, 1e-12) ** 2
        mean[name] = around(float(weight @ values[:, 0] / weight.sum()), float(weight.sum() ** -0.5))
    return mean


def _next_steps(
    verdict: DiagnosisVerdict,
    selected: Sequence[Selected],
    testable: Mapping[str, Effect],
    untestable: Mapping[str, str],
    times_typical: Mapping[str, float],
) -> tuple[Reason, ...]:
    """Return manoeuvres that separate equivalent effects, or that make the least observable effects observable."""
    confounded = [(each.effect, [testable[name] for name in each.equivalent]) for each in selected if each.equivalent]
    if confounded:
        return tuple(
            finding(
                "NEXT_TELL_APART",
                name=effect.name,
                others=", ".join(other.name for other in others),
                manoeuvre="; ".join(dict.fromkeys(each.manoeuvre for each in (effect, *others))),
            )
            for effect, others in confounded
        )
    if verdict is DiagnosisVerdict.UNKNOWN:
        return (finding("NEXT_SAME_ROUTE"),)
    worst = sorted(times_typical, key=lambda name: times_typical[name], reverse=True)[:2]
    if all(times_typical[name] <= 1.0 for name in worst):
        needs = ", ".join(sorted(set(untestable.values())))
        return (finding("NEXT_RECORD", needs=needs, names=", ".join(untestable)) if needs else finding("NEXT_NOTHING"),)
    return tuple(finding("NEXT_SHOW", name=name, manoeuvre=testable[name].manoeuvre) for name in worst)


def _reasons(
    verdict: DiagnosisVerdict,
    gap: Gap,
    found: Sequence[FoundEffect],
    unexplained: Unexplained,
    visible: Sequence[str],
    n_tested: int,
) -> tuple[Reason, ...]:
    """Return the verdict and the unexplained error as reasons."""
    numbers = {
        "names": " and ".join(" or ".join((effect.name, *effect.equivalent_to)) for effect in found),
        "explained": "explained" if gap.closure >= FULL_CLOSURE else f"partly ({100.0 * gap.closure:.0f} %) explained",
        "before": 1e3 * gap.before,
        "after": 1e3 * gap.after,
        "noise": 1e3 * gap.noise_floor,
        "visible": len(visible),
        "tested": n_tested,
    }
    is_unknown = verdict is DiagnosisVerdict.UNKNOWN
    code = "GAP_PARTLY_UNKNOWN" if is_unknown and found else CODES[verdict]
    reasons = [finding(code, **numbers)]
    if found and gap.is_reported:
        reasons.append(finding("REST_UNEXPLAINED", rest=1e3 * gap.not_explained))
    if is_unknown:
        reasons.append(unexplained.follows if unexplained.found else finding("REST_FOLLOWS_NOTHING"))
    return tuple(reasons)
