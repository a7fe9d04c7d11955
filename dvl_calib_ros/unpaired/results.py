"""Results of a comparison, and the JSON of `diagnose --simulator --json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from ..diagnosis.answer.results import Diagnosis, diagnosis_document
from ..verdict.answering import Answering
from ..verdict.reasons import Reason

Triple = tuple[float, float, float]
"""A value and its 95 per cent interval."""


class ComparisonStatus(str, Enum):
    """Comparison of an effect, or of a property of the noise."""

    MISSING = "missing_in_simulator"
    OTHER_SIZE = "other_size"
    ONLY_SIMULATOR = "only_in_simulator"
    ALIKE = "alike"
    CANNOT_TELL = "cannot_tell"

    @property
    def is_claim(self) -> bool:
        """Return whether it is a difference."""
        return self in (ComparisonStatus.MISSING, ComparisonStatus.OTHER_SIZE, ComparisonStatus.ONLY_SIMULATOR)

    @property
    def words(self) -> str:
        """Return the displayed text."""
        return {
            ComparisonStatus.MISSING: "the simulator lacks it",
            ComparisonStatus.OTHER_SIZE: "another size",
            ComparisonStatus.ONLY_SIMULATOR: "only in the simulator",
            ComparisonStatus.ALIKE: "alike",
            ComparisonStatus.CANNOT_TELL: "cannot tell",
        }[self]


class SimulatorVerdict(str, Enum):
    """Verdict of a comparison."""

    DIFFERENT = "different"
    ONLY_NOISE = "only_noise"
    NO_DIFFERENCE = "no_difference"
    CANNOT_TELL = "cannot_tell"


@dataclass(frozen=True)
class Lies:
    """Location of most of an effect: axis, motion regime, frequency band; each with its share of the energy."""

    axis: str
    axis_share: float
    regime: str
    regime_share: float
    band_hz: tuple[float, float]
    band_share: float

    def __str__(self) -> str:
        regime = "" if self.regime == "all" else f", {self.regime}"
        return f"{self.axis}{regime}, {self.band_hz[0]:.2g} .. {self.band_hz[1]:.2g} Hz"


@dataclass(frozen=True)
class ComparedEffect:
    """One effect on both sides. equivalent_to: effects that the data cannot distinguish from it.

    vehicle, simulator: parameters; empty if not observable on that side.
    p: of equal sizes, adjusted (Holm) over all claims; nan if not tested.
    adds_mps: rms of its addition to the vehicle's DVL (or, if only in the simulator, to that), without the part
      absorbed by misalignment and scale.
    needs: what would make it observable.
    """

    name: str
    status: ComparisonStatus
    equivalent_to: tuple[str, ...]
    vehicle: Mapping[str, Triple]
    simulator: Mapping[str, Triple]
    p: float
    adds_mps: float = 0.0
    lies: Lies | None = None
    needs: str = ""


@dataclass(frozen=True)
class ComparedNoise:
    """One property of the noise or of the stream. vehicle, simulator: value and interval in unit. p: adjusted."""

    name: str
    status: ComparisonStatus
    unit: str
    vehicle: Triple
    simulator: Triple
    p: float
    note: str = ""


@dataclass(frozen=True)
class Rung:
    """One model of the vehicle's DVL. name: the original simulator, or the effects added to it.

    error_mps: rms of recorded minus simulated without noise, with limited outliers, on held-out stretches.
    distance: energy distance between windows of both, with noise, in units of their spread.
    null95: its 95 % quantile if both are alike.
    p: its p-value.
    """

    name: str
    error_mps: float
    distance: float
    null95: float
    p: float


@dataclass(frozen=True, repr=False)
class UnpairedComparison(Answering):
    """Result of a comparison of a simulator with a vehicle.

    reasons: the verdict first.
    effects: claims first, the largest first.
    noise: likewise, the most significant first.
    levels: by regime, m/s RMS over the axes of vehicle and simulator.
    floor_mps: noise in `rungs` that no simulator can remove.
    not_shown: per side, effects not observable at relevant sizes, with their smallest detectable size.
    """

    verdict: SimulatorVerdict
    reasons: tuple[Reason, ...]
    effects: tuple[ComparedEffect, ...]
    noise: tuple[ComparedNoise, ...]
    levels: Mapping[str, tuple[float, float]]
    rungs: tuple[Rung, ...]
    floor_mps: float
    not_shown: Mapping[str, Mapping[str, str]]
    vehicle: Diagnosis
    simulator: Diagnosis
    notes: tuple[str, ...] = ()
    series: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def sentence(self) -> str:
        """Return the verdict as a sentence."""
        return " ".join(reason.full_sentence for reason in self.reasons)

    @property
    def missing(self) -> tuple[ComparedEffect, ...]:
        """Return the vehicle's effects that the simulator lacks, the largest first."""
        return tuple(effect for effect in self.effects if effect.status is ComparisonStatus.MISSING)


def unpaired_document(comparison: UnpairedComparison) -> dict[str, Any]:
    """Return the JSON, with the diagnosis of each side as in `diagnose --json`."""
    return {
        "verdict": comparison.verdict.value,
        "sentence": comparison.sentence,
        "reasons": [reason.as_dict() for reason in comparison.reasons],
        "effects": [_row(effect, p="p_adjusted", lies="where") for effect in comparison.effects],
        "noise": [_row(entry, p="p_adjusted") for entry in comparison.noise],
        "noise_level_mps": {
            regime: {"vehicle": vehicle, "simulator": simulator}
            for regime, (vehicle, simulator) in comparison.levels.items()
        },
        "shrinks": [_row(rung, name="model", distance="energy_distance") for rung in comparison.rungs],
        "noise_floor_mps": comparison.floor_mps,
        "not_shown": {side: dict(names) for side, names in comparison.not_shown.items()},
        "notes": list(comparison.notes),
        "vehicle": diagnosis_document(comparison.vehicle),
        "simulator": diagnosis_document(comparison.simulator),
    }


def _row(compared: ComparedEffect | ComparedNoise | Rung | Lies, **renamed: str) -> dict[str, Any]:
    """Return the fields of one result as plain data. renamed: field -> its name in the JSON."""
    return {renamed.get(name, name): _plain(value) for name, value in vars(compared).items()}


def _plain(value: Any) -> Any:
    """Convert for JSON; a triple (value, low, high) becomes ``{"value": ..., "ci95": [low, high]}``."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Lies):
        return _row(value)
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if not isinstance(value, tuple):
        return value
    if len(value) != 3 or isinstance(value[0], str):
        return list(value)
    middle, low, high = map(float, value)
    return {"value": middle, "ci95": [low, high]}
