"""The diagnosis: from bags to an answer."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.stats import norm

from ..calibration.frames import Array
from ..calibration.parameters import Parameters
from ..effects.base import Effect
from ..effects.registry import EFFECTS
from ..errors import InputError
from ..replay.replay import Topics
from .closure import Gap, measure_gap
from .dictionary import is_time_of_run
from .fitting import Fit, Fitter
from .noise_findings import noise_findings
from .problem import PRIOR_STD, calibrated
from .recordings import Recording, load_recordings
from .results import Diagnosis, FoundEffect, Verdict, diagnosis_document
from .selection import LEVEL, Selected, Selection, select
from .series import collect_series
from .unexplained import Unexplained, unexplained
from .where import places

__all__ = ["diagnose", "diagnose_recordings", "diagnosis_document"]

# Fewer samples or less time than this say nothing
MIN_SAMPLES, MIN_SECONDS = 60, 60.0
# An effect could have been seen if one of its parameters could at so many times its typical size ...
VISIBLE_TIMES_TYPICAL = 3.0
# ... and a recording can only be cleared if that share of the effects could have been seen
MIN_VISIBLE_SHARE = 0.5
# The rest, as a share of the gap, from which a combination of effects does not explain it
UNEXPLAINED_SHARE = 0.25
POWER = 0.8
# p-value of a claim (adjusted) above which it must be sure to hold on data that was held out
WEAK = 1e-3
# Recordings whose mounting differs by more than this (rad) are not of one vehicle
SAME_MOUNTING = np.deg2rad(3.0)


def diagnose(
    paths: Sequence[Path],
    parameters: Parameters,
    topics: Topics | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    effects: Mapping[str, Effect] = EFFECTS,
    with_series: bool = False,
) -> Diagnosis:
    """Diagnose bags of one vehicle. Raises InputError for what cannot be compared at all."""
    loaded = load_recordings(paths, parameters, topics or Topics(), lambda share: on_progress(0.5 * share))
    diagnosis = diagnose_recordings(loaded.recordings, parameters, loaded.notes, effects, with_series)
    on_progress(1.0)
    return diagnosis


def diagnose_recordings(
    recordings: Sequence[Recording],
    parameters: Parameters,
    notes: Sequence[str] = (),
    effects: Mapping[str, Effect] = EFFECTS,
    with_series: bool = False,
) -> Diagnosis:
    """`diagnose`, of recordings that are read already."""
    says_nothing = _says_nothing(recordings)
    if says_nothing:
        return _nothing_to_say(says_nothing, notes)
    if len(recordings) > 1:
        _check_mountings(recordings, parameters.rotation_dvl_from_body)
    problem = calibrated(recordings, parameters.rotation_dvl_from_body)
    testable = {name: effect for name, effect in effects.items() if effect.needs <= problem.available}
    untestable = {
        name: ", ".join(sorted(need.value for need in effect.needs - problem.available))
        for name, effect in effects.items()
        if name not in testable
    }
    selection = select(problem, testable)
    rest = unexplained(selection.fitter, selection.fit)
    gap = measure_gap(selection, rest.columns)
    if selection.selected and not _is_borne_out(selection, gap, len(testable)):
        selection = selection.withdrawn()
        rest = unexplained(selection.fitter, selection.fit)
        gap = measure_gap(selection, rest.columns)
    detectable = {
        name: _minimum_detectable(selection.fitter, selection.fit, effect, len(testable))
        for name, effect in testable.items()
    }
    visible = [name for name, sizes in detectable.items() if _is_visible(testable[name], sizes)]
    verdict = _verdict(selection, rest, len(visible) / len(testable))
    found = tuple(_found(selection, each, len(testable), gap, rest.columns) for each in selection.selected)
    next_manoeuvre = _next_manoeuvre(verdict, selection.selected, testable, untestable, detectable)
    columns = rest.columns
    if selection.selected and verdict is not Verdict.UNKNOWN:
        fitter, fit = selection.fitter, selection.fit
        columns = np.concatenate([fitter.jacobian(e, fit.values[e.name])[1] for e in fit.effects], axis=2)
    is_gap = verdict in (Verdict.KNOWN, Verdict.AMBIGUOUS, Verdict.UNKNOWN)
    return Diagnosis(
        verdict=verdict,
        sentence=_sentence(verdict, gap, found, rest, visible, len(testable)),
        gap=gap,
        effects=found,
        noise=tuple(noise_findings(selection.fitter, selection.fit)),
        where=tuple(places(selection.fitter, selection.base, selection.fit, columns)) if is_gap else (),
        untestable=untestable,
        minimum_detectable=detectable,
        next_manoeuvre=next_manoeuvre,
        notes=tuple(notes),
        series=collect_series(selection, rest) if with_series else None,
    )


def _says_nothing(recordings: Sequence[Recording]) -> str:
    """Why recordings cannot say anything, '' if they can."""
    samples = sum(len(recording.bins) - 1 for recording in recordings)
    seconds = sum(recording.seconds for recording in recordings)
    if samples < MIN_SAMPLES or seconds < MIN_SECONDS:
        return f"{samples} samples over {seconds:.0f} s are too few; record {MIN_SECONDS:.0f} s at least, better 600 s"
    reference = [recording.reference_body for recording in recordings]
    turned = [
        np.einsum("nij,nj->ni", recording.rotation_enu_from_body, recording.reference_body)
        for recording in recordings
        if recording.rotation_enu_from_body is not None
    ]
    for values in (reference, turned):
        if values and max(float(np.ptp(each, axis=0).max()) for each in values) < 1e-6:
            return "the reference velocity is constant to the last digit; a receiver that has stopped says nothing"
    return ""


def _nothing_to_say(why: str, notes: Sequence[str]) -> Diagnosis:
    nan = float("nan")
    return Diagnosis(
        verdict=Verdict.INSUFFICIENT_EXCITATION,
        sentence=f"This recording cannot show a gap: {why}.",
        gap=Gap(nan, nan, nan, nan, (nan, nan)),
        effects=(),
        noise=(),
        where=(),
        untestable={},
        minimum_detectable={},
        next_manoeuvre="straight legs on several headings and at several speeds, with turns to both sides",
        notes=tuple(notes),
    )


def _check_mountings(recordings: Sequence[Recording], rotation_dvl_from_body: Array) -> None:
    """Raise InputError if recordings, each calibrated by itself, disagree by more than a mounting can drift."""
    fits = []
    for recording in recordings:
        problem = calibrated([recording], rotation_dvl_from_body)
        std = np.maximum(1.4826 * np.median(np.abs(problem.residual), axis=0), 1e-9)
        columns = (problem.base / std[:, None]).reshape(-1, 6)
        covariance = np.linalg.inv(columns.T @ columns + np.diag(PRIOR_STD**-2))
        fits.append((problem.calibration.phi, np.sqrt(np.diag(covariance))[:3]))
    for (i, (a, std_a)), (j, (b, std_b)) in itertools.combinations(enumerate(fits), 2):
        std = np.hypot(std_a, std_b)
        apart = (np.abs(a - b) > SAME_MOUNTING) & (np.abs(a - b) > 6.0 * std)
        if apart.any():
            axis = int(np.argmax(np.where(apart, np.abs(a - b), 0.0)))
            raise InputError(
                f"{recordings[i].name} and {recordings[j].name}: their misalignments differ by "
                f"{np.degrees(abs(a - b)[axis]):.1f}° about {'xyz'[axis]}, so the DVL was mounted differently; "
                "diagnose them one at a time, or give each its mounting_rpy"
            )


def _is_borne_out(selection: Selection, gap: Gap, n_tested: int) -> bool:
    """Whether what was selected shrinks the error on held-out data; surely so, if it is not that unlikely by chance."""
    p = n_tested * float(np.exp(max(each.log_p for each in selection.selected)))
    return gap.interval[0] > 0.0 if p > WEAK else gap.after < gap.before


def _verdict(selection: Selection, rest: Unexplained, visible_share: float) -> Verdict:
    explained = max(0.0, selection.base.deviance - selection.fit.deviance)
    if rest.found and rest.energy > UNEXPLAINED_SHARE * (explained + rest.energy):
        return Verdict.UNKNOWN
    if selection.selected:
        ambiguous = any(each.equivalent for each in selection.selected)
        return Verdict.AMBIGUOUS if ambiguous else Verdict.KNOWN
    return Verdict.NO_GAP if visible_share >= MIN_VISIBLE_SHARE else Verdict.INSUFFICIENT_EXCITATION


def _covariance(
    fitter: Fitter, fit: Fit, effects: Sequence[Effect], values: Mapping[str, Mapping[str, float]]
) -> Array:
    """Covariance of all parameters of effects, in order, with the calibration beside them."""
    columns = [fitter.problem.base]
    prior = [PRIOR_STD**-2]
    for effect in effects:
        specs, jacobian = fitter.jacobian(effect, values[effect.name])
        columns.append(jacobian)
        prior.append(np.array([(1e3 * spec.typical) ** -2 for spec in specs]))
    white = fit.noise.whiten(np.concatenate(columns, axis=2))
    left = fit.noise.whiten(fit.residual)
    variance = float(left @ left) / max(len(left) - white.shape[1], 1)
    covariance: Array = np.linalg.pinv(white.T @ white / variance + np.diag(np.concatenate(prior)), hermitian=True)
    return covariance[6:, 6:]


def _minimum_detectable(fitter: Fitter, fit: Fit, effect: Effect, n_tested: int) -> dict[str, float]:
    """Size of each parameter that is found with a power of 80 per cent at the level of the tests."""
    others = [other for other in fit.effects if other is not effect]
    values = {**fit.values, effect.name: effect.defaults}
    specs, _ = fitter.jacobian(effect, values[effect.name])
    covariance = _covariance(fitter, fit, [*others, effect], values)
    std = np.sqrt(np.diag(covariance))[-len(specs) :]
    factor = float(norm.isf(LEVEL / n_tested / 2.0) + norm.ppf(POWER))
    return {spec.name: factor * float(s) for spec, s in zip(specs, std, strict=True)}


def _is_visible(effect: Effect, sizes: Mapping[str, float]) -> bool:
    typical = {spec.name: spec.typical for spec in effect.parameters}
    return any(size <= VISIBLE_TIMES_TYPICAL * typical[name] for name, size in sizes.items())


def _found(selection: Selection, selected: Selected, n_tested: int, gap: Gap, dictionary: Array) -> FoundEffect:
    fitter, fit, effect = selection.fitter, selection.fit, selected.effect
    covariance = _covariance(fitter, fit, fit.effects, fit.values)
    stds = iter(np.sqrt(np.diag(covariance)).tolist())
    parameters: dict[str, tuple[float, float, float]] = {}
    for each in fit.effects:
        for spec in fitter.jacobian(each, fit.values[each.name])[0]:
            std = next(stds)
            if each is effect:
                value = fit.values[effect.name][spec.name]
                parameters[spec.name] = (value, value - 1.96 * std, value + 1.96 * std)
    for spec in effect.parameters:
        if is_time_of_run(spec):
            parameters[spec.name] = fitter.time_interval(fit, effect, spec)
    closure = gap.closure
    if len(fit.effects) > 1:
        closure = measure_gap(selection, dictionary, only=effect).closure
    ordered = {spec.name: parameters[spec.name] for spec in effect.parameters}
    p = min(1.0, float(np.exp(selected.log_p)) * n_tested)
    return FoundEffect(effect.name, selected.equivalent, ordered, closure, p)


def _next_manoeuvre(
    verdict: Verdict,
    selected: Sequence[Selected],
    testable: Mapping[str, Effect],
    untestable: Mapping[str, str],
    detectable: Mapping[str, Mapping[str, float]],
) -> str:
    """What to fly: to separate what was confounded, else to see what this data sees worst."""
    confounded = [each for each in selected if each.equivalent]
    if confounded:
        sets = [(each.effect, [testable[name] for name in each.equivalent]) for each in confounded]
        return "; ".join(
            f"to tell {effect.name} from {', '.join(other.name for other in others)}: "
            + "; ".join(dict.fromkeys(each.manoeuvre for each in (effect, *others)))
            for effect, others in sets
        )
    if verdict is Verdict.UNKNOWN:
        return "the same route again: what stays with the place, the time or the motion tells what it follows"

    def times_typical(name: str) -> float:
        typical = {spec.name: spec.typical for spec in testable[name].parameters}
        return min(size / typical[key] for key, size in detectable[name].items())

    worst = sorted(detectable, key=times_typical, reverse=True)[:2]
    if all(times_typical(name) <= 1.0 for name in worst):
        needs = ", ".join(sorted(set(untestable.values())))
        return f"record {needs} as well, to test {', '.join(untestable)}" if untestable else "nothing: all effects show"
    return "; ".join(f"to see {name}: {testable[name].manoeuvre}" for name in worst)


def _sentence(
    verdict: Verdict, gap: Gap, found: Sequence[FoundEffect], rest: Unexplained, visible: Sequence[str], n_tested: int
) -> str:
    names = " and ".join(" or ".join((effect.name, *effect.equivalent_to)) for effect in found)
    closes = f"which closes {100.0 * gap.closure:.0f} % of the gap of {1e3 * gap.before:.1f} mm/s on held-out data"
    if verdict is Verdict.KNOWN:
        return f"The gap is explained by {names}, {closes}."
    if verdict is Verdict.AMBIGUOUS:
        return f"The gap is explained by {names}, {closes}; this data cannot tell between them."
    if verdict is Verdict.UNKNOWN:
        beside = f" beside {names}" if found else ""
        return (
            f"There is a gap of {1e3 * gap.before:.1f} mm/s that no effect of the library explains{beside}; "
            f"what is left follows {rest.about}."
        )
    if verdict is Verdict.NO_GAP:
        return (
            f"No gap beyond the noise of {gap.noise_floor:.3f} m/s; {len(visible)} of {n_tested} effects would have "
            "shown at sizes that matter."
        )
    return f"This data could not have shown a gap: {len(visible)} of {n_tested} effects would have shown."
