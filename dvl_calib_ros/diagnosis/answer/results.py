"""Result of a diagnosis, and the JSON of `diagnose --json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from ...calibration.numerics.frames import Array
from ...effects.registry import EFFECTS
from ...verdict.answering import Answering
from ...verdict.reasons import Reason, is_cause
from ..model.hypothesis import is_time_of_run
from ..search.arm_clock_ambiguity import Combination
from ..search.effect_selection import EffectSelection
from .dvl_description import DvlSeen
from .gap_closure import Gap
from .gap_location import GapPlace
from .noise_findings import NoiseFinding
from .plotted_series import DiagnosisSeries
from .simulated_twin import Twin


class DiagnosisVerdict(str, Enum):
    """Verdict of a diagnosis."""

    NO_GAP = "no_gap"
    KNOWN = "known"
    AMBIGUOUS = "ambiguous"
    UNKNOWN = "unknown"
    INSUFFICIENT_EXCITATION = "insufficient_excitation"


@dataclass(frozen=True)
class FoundEffect:
    """Effect in the result. equivalent_to: effects that explain the data equally well. closure: of the gap, alone.

    parameters: value, low, high (95 per cent) by name; of parameters per recording the weighted mean, and by_recording
      each one's.
    p: adjusted over the library.
    combination: observable combination of an ambiguous lever arm and clock.
    """

    name: str
    equivalent_to: tuple[str, ...]
    parameters: Mapping[str, tuple[float, float, float]]
    closure: float
    p: float
    by_recording: Mapping[str, Mapping[str, tuple[float, float, float]]] = field(default_factory=dict)
    combination: Combination | None = None

    @property
    def is_certain(self) -> bool:
        """Return whether the interval of any size excludes zero, in any recording."""
        each = self.by_recording.values() or (self.parameters,)
        return any(certain_sizes(self.name, parameters) for parameters in each)


def certain_sizes(name: str, parameters: Mapping[str, tuple[float, float, float]]) -> dict[str, float]:
    """Return the sizes of an effect whose intervals exclude zero."""
    times = {spec.name for spec in EFFECTS[name].parameters if is_time_of_run(spec)}
    return {each: value for each, (value, low, high) in parameters.items() if each not in times and low * high > 0.0}


@dataclass(frozen=True, repr=False)
class Diagnosis(Answering):
    """Result of a diagnosis. reasons: the verdict first. notes: on the data. series: for pictures, if requested.
    calibration: value, low, high of φ (rad) and δk, three of each. compared_axes: in words. recordings: names and first
    stamps (ns). twins: of the recordings. dvl: description for another simulator. selection: the fits, None without
    one. covariance: (6 + p, 6 + p) of the fit's parameters."""

    verdict: DiagnosisVerdict
    reasons: tuple[Reason, ...]
    gap: Gap
    effects: tuple[FoundEffect, ...]
    noise: tuple[NoiseFinding, ...]
    where: tuple[GapPlace, ...]
    untestable: Mapping[str, str]
    minimum_detectable: Mapping[str, Mapping[str, float]]
    next_steps: tuple[Reason, ...]
    notes: tuple[str, ...]
    series: DiagnosisSeries | None = None
    calibration: tuple[tuple[float, float, float], ...] = ()
    compared_axes: str = "xyz"
    recordings: tuple[tuple[str, int], ...] = ()
    twins: tuple[Twin, ...] = ()
    dvl: DvlSeen | None = None
    selection: EffectSelection | None = field(default=None, repr=False, compare=False)
    covariance: Array | None = field(default=None, repr=False, compare=False)

    def led_by(self, rejection: Reason | None) -> Diagnosis:
        """Return the diagnosis with the calibration's reason against the recording first.

        A named effect comes before it, unless that reason is in frames, clocks or mounting, which look like effects.
        """
        is_named = self.verdict not in (DiagnosisVerdict.NO_GAP, DiagnosisVerdict.UNKNOWN)
        if rejection is None or (is_named and not any(map(is_cause, rejection.causes))):
            return self
        return replace(self, reasons=(rejection, *self.reasons))

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        return " ".join(reason.full_sentence for reason in self.reasons)

    @property
    def next_manoeuvre(self) -> str:
        """Return the next recording's manoeuvre in words."""
        return "; ".join(each.sentence for each in self.next_steps)


def diagnosis_document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the JSON document of diagnosis.md."""
    gap = diagnosis.gap
    return {
        "verdict": diagnosis.verdict.value,
        "reasons": [reason.as_dict() for reason in diagnosis.reasons],
        "gap": {
            "before_mps": gap.before,
            "after_mps": gap.after,
            "noise_floor_mps": gap.noise_floor,
            "not_explained_mps": gap.not_explained,
            "reported_noise_mps": gap.reported,
            "closure": gap.closure,
            "closure_ci95": list(gap.interval),
            "held_out": True,
            "drift_m_per_km": dict(zip(("before", "after"), (each.per_km for each in gap.drift or ()), strict=False)),
            **_given(by_recording={n: {"before_mps": b, "after_mps": a} for n, (b, a) in gap.by_recording.items()}),
        },
        "effects": [
            {
                "name": effect.name,
                "equivalent_to": list(effect.equivalent_to),
                "parameters": _parameters(effect.parameters),
                "closure": effect.closure,
                "p_adjusted": effect.p,
                **_given(by_recording={name: _parameters(each) for name, each in effect.by_recording.items()}),
                **_given(combination=_combination_document(effect.combination)),
            }
            for effect in diagnosis.effects
        ],
        "noise": [
            {"name": finding.name, "parameters": _parameters(finding.parameters), "p_adjusted": finding.p}
            for finding in diagnosis.noise
        ],
        "where": [
            {
                "axis": place.axis,
                "regime": place.regime,
                "segment_s": list(place.segment_s),
                "band_hz": list(place.band_hz),
                "share": place.share,
                "p_adjusted": place.p,
            }
            for place in diagnosis.where
        ],
        "untestable": [{"name": name, "needs": needs} for name, needs in diagnosis.untestable.items()],
        "minimum_detectable": {name: dict(sizes) for name, sizes in diagnosis.minimum_detectable.items()},
        "next_manoeuvre": diagnosis.next_manoeuvre,
        "next_steps": [each.as_dict() for each in diagnosis.next_steps],
        "calibration": {
            "phi_rad": {axis: _value(each) for axis, each in zip("xyz", diagnosis.calibration[:3], strict=False)},
            "delta_k": {axis: _value(each) for axis, each in zip("xyz", diagnosis.calibration[3:], strict=False)},
        },
        **({} if diagnosis.dvl is None else {"dvl": _dvl_document(diagnosis.dvl)}),
        "compared_axes": diagnosis.compared_axes,
        "notes": list(diagnosis.notes),
    }


def _given(**values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values that are not empty, by name."""
    return {name: value for name, value in values.items() if value}


def _combination_document(found: Combination | None) -> dict[str, Any]:
    """Return plain data of the observable combination of lever arm and clock, empty without one."""
    if found is None:
        return {}
    return {
        "parameter": found.parameter,
        "clock": found.clock,
        "speed_mps": found.speed,
        "arm_less_speed_times_delay_m": _value(found.value),
    }


def _dvl_document(dvl: DvlSeen) -> dict[str, Any]:
    """Return plain data of the DVL on its vehicle."""
    return {
        "mounting_rpy": list(dvl.mounting_rpy),
        "lever_arm_m": list(dvl.lever_arm),
        "time_offset_s": dvl.time_offset,
        "clock_drift": dvl.clock_drift,
        "rate_hz": dvl.rate_hz,
        "noise_std_mps": list(dvl.noise_std),
        "speed_mps": list(dvl.speed),
        "sizes_mps": dict(dvl.sizes),
    }


def _parameters(parameters: Mapping[str, tuple[float, float, float]]) -> dict[str, Any]:
    return {name: _value(each) for name, each in parameters.items()}


def _value(each: tuple[float, float, float]) -> dict[str, Any]:
    value, low, high = each
    return {"value": value, "ci95": [low, high]}
