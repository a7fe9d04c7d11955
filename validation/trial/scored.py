"""A case joined with its answer: what was said, and whether it is right."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from scipy import stats

from .truth import Category, Truth
from .vehicle import FAULTS

# Bags are named so, and by that in an answer
RECORDING = "recording"
CLAIMS = ("known", "ambiguous", "unknown")
EXPLAINED = ("known", "ambiguous")
FAMILY_LEVEL = 0.01
# Faults that even the likelihood would confuse more often than this are not told apart by anybody
CONFUSED = 0.02
# Change points have no regular interval
NOT_SCORED_PARAMETERS = frozenset({"from_s", "to_s", "at_s", "from_recording", "again_at_s"})


@dataclass(frozen=True)
class Interval:
    """Of a parameter of a fault that was named: the 95 % interval and the true value."""

    fault: str
    parameter: str
    low: float
    true: float
    high: float

    @property
    def holds(self) -> bool:
        """The true value is inside."""
        return self.low <= self.true <= self.high


@dataclass(frozen=True)
class Scored:
    """A case and its answer: what the figures are made of.

    named: names of the effects, the strongest first, each with the ones that it cannot be told from. noise: names of
    the findings about the noise. left_mps: error (rms) that what was said leaves beyond the calibration and the noise.
    after_mps: error after, noise included, as the diagnosis says it is.
    """

    truth: Truth
    verdict: str
    named: tuple[tuple[str, frozenset[str]], ...]
    closure: float | None
    intervals: tuple[Interval, ...]
    cpu_s: float
    noise: frozenset[str]
    left_mps: float
    after_mps: float | None = None

    @property
    def claimed(self) -> bool:
        """A systematic effect was claimed, be it by name or as unknown."""
        return self.verdict in CLAIMS or bool(self.named)

    @property
    def first(self) -> str:
        """The effect named first; the verdict where there is none."""
        return self.named[0][0] if self.named else self.verdict

    @property
    def named_set(self) -> frozenset[str]:
        """All names that the answer leaves possible."""
        return frozenset().union(*(names for _, names in self.named))

    @property
    def is_right_first(self) -> bool:
        """The fault of the truth was named first."""
        return self.first in self.truth.faults

    @property
    def is_in_set(self) -> bool:
        """A fault of the truth is among the names."""
        return bool(self.named_set & self.truth.faults.keys())

    @property
    def are_all_named(self) -> bool:
        """Each fault is named by an entry of its own, or is among the equals of that entry."""
        sets = [names for _, names in self.named]
        chosen = itertools.permutations(sets, len(self.truth.faults))
        return any(all(f in names for f, names in zip(self.truth.faults, each, strict=True)) for each in chosen)

    @property
    def is_exact(self) -> bool:
        """The true effects are named, each of them as the likeliest, and no other, as all that there is."""
        names = [name for name, _ in self.named]
        return self.verdict in EXPLAINED and sorted(names) == sorted(self.truth.faults)

    @property
    def no_guess(self) -> bool:
        """It says that the data cannot tell, or names a set that has the truth and others in it."""
        if self.verdict == "ambiguous":
            return self.is_in_set and len(self.named_set) > 1
        return self.verdict == "insufficient_excitation"

    @property
    def error_over_possible(self) -> float:
        """Error with what was said compensated, over that with the truth compensated, both with the noise in them."""
        return math.hypot(self.left_mps, self.truth.noise_mps) / self.truth.noise_mps

    @property
    def error_said_over_true(self) -> float:
        """Error after as the diagnosis says it is, over what it is."""
        return (self.after_mps or math.nan) / math.hypot(self.left_mps, self.truth.noise_mps)

    @property
    def chance_right(self) -> float:
        """Chance with which the likelihood prefers the truth over its nearest rival."""
        return NormalDist().cdf(min(self.truth.distances.values(), default=np.inf) / 2.0)

    @property
    def separable(self) -> bool:
        """Whether anybody could tell the fault from all others."""
        return self.chance_right >= 1.0 - CONFUSED

    @property
    def power(self) -> float:
        """Chance with which the test of the fault alone detects it, at the level of the family."""
        (name,) = self.truth.faults
        n = len(FAULTS[name].typical)
        threshold = stats.chi2.isf(FAMILY_LEVEL / len(FAULTS), n)
        return float(stats.ncx2.sf(threshold, n, self.truth.q[name] ** 2))

    @property
    def is_null(self) -> bool:
        """There is nothing to find."""
        return self.truth.category in (Category.NULL, Category.HARD_NULL)

    def agrees_with(self, twin: Scored) -> bool:
        """Same verdict, same names, and sizes whose intervals overlap."""
        if self.verdict != twin.verdict or {name for name, _ in self.named} != {name for name, _ in twin.named}:
            return False
        other = {(each.fault, each.parameter): each for each in twin.intervals}
        pairs = [(each, other.get((each.fault, each.parameter))) for each in self.intervals]
        return all(b is None or (a.low <= b.high and b.low <= a.high) for a, b in pairs)


def join(truths: Mapping[str, Truth], answers: Mapping[str, Mapping[str, Any]]) -> list[Scored]:
    """Truth and answer of every case that has both, in order of their ids."""
    return [_scored(truths[id_], answers[id_]) for id_ in sorted(truths.keys() & answers.keys())]


def _scored(truth: Truth, answer: Mapping[str, Any]) -> Scored:
    document = answer["document"]
    effects = document.get("effects", [])
    named = tuple((each["name"], frozenset([each["name"], *each.get("equivalent_to", [])])) for each in effects)
    gap = document.get("gap") or {}
    return Scored(
        truth,
        document["verdict"],
        named,
        _finite(gap.get("closure")),
        tuple(_intervals(truth, effects)),
        answer["cpu_s"],
        frozenset(each["name"] for each in document.get("noise", [])),
        answer.get("left_mps", 0.0),
        _finite(gap.get("after_mps")),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _intervals(truth: Truth, effects: Iterable[Mapping[str, Any]]) -> Iterable[Interval]:
    """Those of the faults that were named."""
    n_recordings = len(truth.scene.get("seconds", [None]))
    for effect in effects:
        parameters = parameters_of(effect)
        for name, true in _in_each(truth.faults.get(effect["name"], {}), n_recordings).items():
            given = parameters.get(name)
            if given is not None and given.get("ci95") is not None and name not in NOT_SCORED_PARAMETERS:
                low, high = given["ci95"]
                yield Interval(effect["name"], name, low, true, high)


def parameters_of(effect: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What an answer says of an effect's parameters, by name, "seconds@1" being that of recording 1."""
    parameters = dict(effect.get("parameters", {}))
    for recording, values in effect.get("by_recording", {}).items():
        number = recording.removeprefix(RECORDING)
        parameters |= {f"{name}@{number}": value for name, value in values.items()}
    return parameters


def _in_each(values: Mapping[str, float], n_recordings: int) -> dict[str, float]:
    """Parameters of a fault; of one that came between recordings, what it is in each against the first."""
    if "from_recording" not in values:
        return dict(values)
    return {
        f"{name}@{number}": value if number >= values["from_recording"] else 0.0
        for name, value in values.items()
        for number in range(1, n_recordings)
        if name not in NOT_SCORED_PARAMETERS
    }
