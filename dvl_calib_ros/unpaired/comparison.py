"""Comparison of a simulator with a vehicle, from both sides' recordings to the answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..calibration.numerics.tests import holm
from ..diagnosis.answer.results import Diagnosis
from ..diagnosis.answer.results import DiagnosisVerdict as Explained
from ..diagnosis.diagnose import VISIBLE_TIMES_TYPICAL
from ..diagnosis.search.effect_selection import EffectSelection
from ..effects.base import Effect
from ..effects.registry import EFFECTS
from ..verdict.reasons import Reason, finding
from .both_sides import Log, RecordedSide, read_log
from .effect_comparison import (
    Size,
    common_names,
    compared_names,
    fitted,
    is_there,
    lies,
    p_alike,
    sizes,
    smallest_difference,
    trace_of,
    union,
)
from .gap_ladder import AS_IT_IS, NOISE, Shrunk, models, shrink
from .noise_comparison import compare_noise, levels_by_regime
from .results import ComparedEffect, ComparedNoise, ComparisonStatus, Rung, SimulatorVerdict, UnpairedComparison
from .stream_comparison import compare_streams
from .welch_tests import Candidate

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
    effects: Mapping[str, Effect] = EFFECTS,
    with_series: bool = False,
) -> UnpairedComparison:
    """Compare bags of a vehicle with bags of a simulator. Raises InputError if they cannot be compared."""
    real = read_log(vehicle, lambda share: on_progress(0.4 * share), effects, with_series)
    made = read_log(simulator, lambda share: on_progress(0.4 + 0.4 * share), effects, with_series)
    comparison = compare_logs(real, made, effects)
    on_progress(1.0)
    return comparison


def compare_logs(vehicle: Log, simulator: Log, effects: Mapping[str, Effect] = EFFECTS) -> UnpairedComparison:
    """Run `compare` for sides that are already read and diagnosed."""
    selections = vehicle.selection, simulator.selection
    if selections[0] is None or selections[1] is None:
        return _nothing_to_compare(vehicle.diagnosis, simulator.diagnosis)
    candidates = [*compare_noise(vehicle, simulator), *compare_streams(vehicle, simulator)]
    names = common_names(vehicle, simulator)
    compared = _Compared((vehicle, simulator), (selections[0], selections[1]), names, union(*names), effects)
    p = holm([*compared.p.values(), *(each.p for each in candidates)])
    found = [compared.effect(name, float(p[i])) for i, name in enumerate(compared.p)]
    found += [compared.untested(name) for name in compared.names if name not in compared.p]
    found.sort(key=lambda each: (ORDER.index(each.status), -each.adds_mps))
    noise = [_noise(each, float(adjusted)) for each, adjusted in zip(candidates, p[len(compared.p) :], strict=True)]
    noise.sort(key=lambda each: (ORDER.index(each.status), each.p))
    status = {each.name: each.status for each in found}
    both = {name: (*compared.sizes[name], status[name]) for name in compared.p}
    own_effects = [compared.sizes[name][0].effect for name in names[0].values() if name in compared.sizes]
    shrunk = shrink(vehicle, simulator, models(both, own_effects))
    levels = [levels_by_regime(log) for log in (vehicle, simulator)]
    verdict = _verdict(found, noise, vehicle.diagnosis, simulator.diagnosis)
    return UnpairedComparison(
        verdict=verdict,
        reasons=_reasons(verdict, found, noise, shrunk.rungs, vehicle.diagnosis, simulator.diagnosis),
        effects=tuple(found),
        noise=tuple(noise),
        levels={name: (level, levels[1][name]) for name, level in levels[0].items() if name in levels[1]},
        rungs=shrunk.rungs,
        floor_mps=shrunk.floor,
        not_shown={
            side: _not_shown(log.diagnosis, effects) for side, log in (("vehicle", vehicle), ("simulator", simulator))
        },
        vehicle=vehicle.diagnosis,
        simulator=simulator.diagnosis,
        notes=tuple(
            f"{side}: {note}"
            for side, log in (("vehicle", vehicle), ("simulator", simulator))
            for note in log.diagnosis.notes
        ),
        series=_series(shrunk, vehicle, simulator),
    )


def _series(shrunk: Shrunk, vehicle: Log, simulator: Log) -> dict[str, object]:
    """Return the data of the figures."""
    return {
        "shrunk": shrunk,
        "residuals": {"vehicle": vehicle.residuals, "simulator": simulator.residuals},
        "intervals": {
            side: [each.dvl.interval for each in log.recordings]
            for side, log in (("vehicle", vehicle), ("simulator", simulator))
        },
    }


class _Compared:
    """Union of the effects, fitted to both sides."""

    def __init__(
        self,
        logs: tuple[Log, Log],
        selections: tuple[EffectSelection, EffectSelection],
        renamed: tuple[Mapping[str, str], Mapping[str, str]],
        names: Sequence[str],
        effects: Mapping[str, Effect],
    ) -> None:
        self.names, self._effects = names, effects
        self._selections, self._logs, self._renamed = selections, logs, renamed
        self._fits = tuple(fitted(selection, names) for selection in selections)
        per_side = [
            sizes(selection, fit, list(own.values()))
            for selection, fit, own in zip(selections, self._fits, renamed, strict=True)
        ]
        self._per_side = per_side
        self.sizes: dict[str, tuple[Size, Size]] = {
            name: (per_side[0][name], per_side[1][name])
            for name in names
            if all(name in side for side in per_side) and compared_names(*(side[name] for side in per_side))
        }
        self.p = {name: p_alike(*both) for name, both in self.sizes.items()}

    def effect(self, name: str, p: float) -> ComparedEffect:
        """Compare an effect that both sides can be tested for. p: adjusted."""
        vehicle, simulator = self.sizes[name]
        is_present = is_there(vehicle, simulator), is_there(simulator, vehicle)
        status = _status(is_present, p < LEVEL)
        needs = ""
        if status is ComparisonStatus.CANNOT_TELL:
            blind = "simulator" if is_present[0] else "vehicle"
            least = smallest_difference(vehicle, simulator, len(self.p))
            smallest = ", ".join(f"{key} {value:.2g}" for key, value in least.items())
            needs = (
                f"the two logs together would show a difference of {smallest}; with the {blind}: "
                f"{self._effects[name].manoeuvre}"
            )
        side = 1 if status is ComparisonStatus.ONLY_SIMULATOR or not is_present[0] else 0
        trace = trace_of(self._selections[side], self._fits[side], self.sizes[name][side].effect)
        adds = float(np.sqrt((trace**2).sum(axis=1).mean()))
        where = lies(self._selections[side], self._fits[side], trace)
        return ComparedEffect(
            name, status, self._equivalent(name), vehicle.intervals(), simulator.intervals(), p, adds, where, needs
        )

    def untested(self, name: str) -> ComparedEffect:
        """Report an effect that one side cannot be tested for, or whose observable parts differ between the sides."""
        shown = [side[name].intervals() if name in side else {} for side in self._per_side]
        effect = self._effects[name]
        needs = f"no common part of it is observable in both logs: {effect.manoeuvre}"
        for side, selection in zip(("vehicle", "simulator"), self._selections, strict=True):
            if name not in selection.testable:
                lacks = ", ".join(sorted(need.value for need in effect.needs))
                needs = f"the {side}'s log lacks {'a second recording' if effect.relative_to_first else lacks}"
                break
        return ComparedEffect(
            name, ComparisonStatus.CANNOT_TELL, self._equivalent(name), shown[0], shown[1], float("nan"), needs=needs
        )

    def _equivalent(self, name: str) -> tuple[str, ...]:
        others: list[str] = []
        for log, renamed in zip(self._logs, self._renamed, strict=True):
            for each in log.diagnosis.effects:
                if renamed[each.name] == name:
                    others += [n for n in (each.name, *each.equivalent_to) if n != name]
        return tuple(dict.fromkeys(others))


def _status(there: tuple[bool, bool], differ: bool) -> ComparisonStatus:
    if there[0] and there[1]:
        return ComparisonStatus.OTHER_SIZE if differ else ComparisonStatus.ALIKE
    if not differ:
        return ComparisonStatus.CANNOT_TELL
    return ComparisonStatus.MISSING if there[0] else ComparisonStatus.ONLY_SIMULATOR


def _noise(candidate: Candidate, p: float) -> ComparedNoise:
    differ = p < LEVEL and candidate.matters
    status = _status(candidate.there, differ) if any(candidate.there) else ComparisonStatus.ALIKE
    if status is ComparisonStatus.CANNOT_TELL:
        status = ComparisonStatus.ALIKE
    return ComparedNoise(
        candidate.name, status, candidate.unit, candidate.vehicle, candidate.simulator, p, candidate.note
    )


def _not_shown(diagnosis: Diagnosis, effects: Mapping[str, Effect]) -> dict[str, str]:
    """Return effects unobservable on a side at relevant sizes -> the smallest detectable size, or the missing data."""
    found = {name: f"needs {needs}" for name, needs in diagnosis.untestable.items()}
    named = {each.name for each in diagnosis.effects}
    for name, least in diagnosis.minimum_detectable.items():
        typical = {spec.name: spec.typical for spec in effects[name].parameters}
        if name not in named and not any(size <= VISIBLE_TIMES_TYPICAL * typical[key] for key, size in least.items()):
            found[name] = "from " + ", ".join(f"{key} {size:.2g}" for key, size in least.items())
    return found


def _verdict(
    effects: Sequence[ComparedEffect], noise: Sequence[ComparedNoise], vehicle: Diagnosis, simulator: Diagnosis
) -> SimulatorVerdict:
    if any(each.status.is_claim for each in effects):
        return SimulatorVerdict.DIFFERENT
    if any(each.status.is_claim for each in noise):
        return SimulatorVerdict.ONLY_NOISE
    unsure = Explained.INSUFFICIENT_EXCITATION in (vehicle.verdict, simulator.verdict)
    if unsure or any(each.status is ComparisonStatus.CANNOT_TELL for each in effects):
        return SimulatorVerdict.CANNOT_TELL
    return SimulatorVerdict.NO_DIFFERENCE


_CLAIMED = {
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
    for status, code in _CLAIMED.items():
        named = [" or ".join((each.name, *each.equivalent_to)) for each in effects if each.status is status]
        if named:
            reasons.append(finding(code, names=" and ".join(named)))
    if reasons:
        error = {rung.name: 1e3 * rung.error_mps for rung in rungs}
        reasons.append(finding("SIMULATOR_PUT_RIGHT", before=error[AS_IT_IS], after=error[NOISE]))
    else:
        is_open = verdict is SimulatorVerdict.CANNOT_TELL
        reasons.append(finding("SIMULATOR_NOT_SHOWN" if is_open else "SIMULATOR_ALIKE"))
    if differing := [each.name for each in noise if each.status.is_claim]:
        reasons.append(finding("SIMULATOR_NOISE", names=", ".join(differing)))
    unknown = [side for side, d in (("vehicle", vehicle), ("simulator", simulator)) if d.verdict is Explained.UNKNOWN]
    if unknown:
        reasons.append(finding("SIMULATOR_UNKNOWN_REST", sides=" and of the ".join(unknown)))
    return tuple(reasons)


def _nothing_to_compare(vehicle: Diagnosis, simulator: Diagnosis) -> UnpairedComparison:
    reasons = tuple(
        finding("SIMULATOR_NOTHING_COMPARED", side=side, why=diagnosis.reasons)
        for side, diagnosis in (("vehicle", vehicle), ("simulator", simulator))
        if diagnosis.selection is None
    )
    sides: dict[str, dict[str, str]] = {"vehicle": {}, "simulator": {}}
    return UnpairedComparison(
        SimulatorVerdict.CANNOT_TELL, reasons, (), (), {}, (), float("nan"), sides, vehicle, simulator
    )
