"""Test of whether the mounting moved between calibrations of one DVL.

Each quantity is tested separately, in the axes of a URDF: the difference of two calibrations is normally distributed
with the sum of their covariances. The p-values are corrected for the number of quantities (Holm) and of instants
(Bonferroni). The series is split at the most significant instant, and each part again (binary segmentation; Scott and
Knott, "A cluster analysis method for grouping means in the analysis of variance", 1974).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...verdict.answering import Answering
from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array, near_angles
from ..numerics.tests import CHANCE, Z_95_PERCENT, Z_FIFTY_TESTS, chance_of, chi2_sf, holm, smallest_found
from ..results.extrinsics import (
    ANGLES,
    COMPONENTS,
    GROUPS,
    LEVER_ARM,
    MOUNTING,
    N_AXES,
    N_COMPONENTS,
    ONLY_CLOCK,
    ONLY_SCALE,
    SCALE,
    TIME_OFFSET,
    Extrinsics,
)
from ..results.mounting_quantities import date

# False-alarm rates of one comparison, for any numbers of quantities and instants, of a moved and of a suspicious
# mounting; for scale and delay the rate is `CHANCE`.
MOVED, SUSPICIOUS = chance_of(Z_FIFTY_TESTS), chance_of(Z_95_PERCENT)
# Standard deviation of a lever arm between recordings without a movement, m: the phase centre of a GNSS antenna wanders
# by one to two centimetres with the satellites in view (IGS antenna calibrations)
ARM_WANDERS_M = 0.015
# Probability of finding a movement as large as `Comparison.smallest`
POWER = 0.9

_ALL = np.arange(N_COMPONENTS)


class ChiSquare(NamedTuple):
    """Test statistic d'S⁻¹d, degrees of freedom, and p-value, nan without degrees of freedom."""

    value: float
    freedom: int
    p: float


@dataclass(frozen=True)
class Difference:
    """Second minus first of two calibrations, each of one recording or of several together.

    value (8,), covariance (8, 8): of `extrinsics.COMPONENTS`. compared (8,): observable in both.
    """

    first: Extrinsics
    second: Extrinsics
    value: Array
    covariance: Array
    compared: NDArray[np.bool_]

    @staticmethod
    def between(first: Extrinsics, second: Extrinsics) -> Difference:
        """Subtract the first from the second; a bias of the same DVL cancels."""
        compared = first.shown & second.shown
        sum_covariance = first.covariance + second.covariance
        if first.dvl and first.dvl == second.dvl:
            bias_covariance = first.by_bias @ second.by_bias.T
            sum_covariance = sum_covariance - bias_covariance - bias_covariance.T
        sum_covariance = sum_covariance + np.diag(np.where(np.isin(_ALL, _ALL[LEVER_ARM]), ARM_WANDERS_M**2, 0.0))
        value = _near(second.value, first.value) - first.value
        covariance = np.where(np.outer(compared, compared), sum_covariance, 0.0)
        return Difference(first, second, np.where(compared, value, np.nan), covariance, compared)

    @property
    def std(self) -> Array:
        """(8,) standard deviations, nan if not compared."""
        return np.where(self.compared, np.sqrt(np.diag(self.covariance)), np.nan)

    @cached_property
    def p(self) -> Array:
        """(8,) two-sided p-values with Holm's correction, nan if not compared."""
        found = np.full(N_COMPONENTS, np.nan)
        found[self.compared] = holm([chi2_sf(z2, 1) for z2 in ((self.value / self.std) ** 2)[self.compared].tolist()])
        return found

    def chance(self, components: NDArray[np.intp] = _ALL) -> float:
        """Return the smallest p-value of some components; 1 if none of them is compared."""
        compared = components[self.compared[components]]
        return float(self.p[compared].min()) if len(compared) else 1.0

    def chi_square(self, components: NDArray[np.intp]) -> ChiSquare:
        """Test some components together."""
        compared = components[self.compared[components]]
        difference = self.value[compared]
        value = float(difference @ np.linalg.solve(self.covariance[np.ix_(compared, compared)], difference))
        return ChiSquare(value, len(compared), chi2_sf(value, len(compared)) if len(compared) else math.nan)


@dataclass(frozen=True)
class Change:
    """Difference between the averages of all calibrations before and after an instant, up to the next changes.

    last_before, first_after: the neighbours of the instant.
    """

    difference: Difference
    last_before: Extrinsics
    first_after: Extrinsics


class ComparisonAnswer(NamedTuple):
    """Severity for colours, and exit code of the command, of a comparison's verdict."""

    severity: Severity
    exit_code: int


ANSWERS = {
    "same": ComparisonAnswer(Severity.ACCEPT, 0),
    "suspicious": ComparisonAnswer(Severity.MARGINAL, 3),
    "moved": ComparisonAnswer(Severity.REJECT, 4),
}


@dataclass(frozen=True, repr=False)
class Comparison(Answering):
    """Comparison of several calibrations of one DVL.

    Parameters
    ----------
    calibrations
        In order of time.
    pairs
        All pairs.
    moved, suspicious
        Changes of angles or lever arm beyond `Z_FIFTY_TESTS` σ, and beyond `Z_95_PERCENT` σ.
    suspected
        Rejected calibrations that differ from the accepted one next to them.
    scale_changed, clock_changed
        Changes of scale and delay.
    scatter
        Of the mountings about the mean of each stretch between changes.
    smallest
        (3,) rad: movement of roll, pitch and yaw that is found with `POWER` at any instant; nan if not compared.
    """

    calibrations: tuple[Extrinsics, ...]
    pairs: tuple[Difference, ...]
    moved: tuple[Change, ...]
    suspicious: tuple[Change, ...]
    suspected: tuple[Change, ...]
    scale_changed: tuple[Change, ...]
    clock_changed: tuple[Change, ...]
    scatter: ChiSquare
    smallest: Array

    @property
    def verdict(self) -> str:
        """Verdict: moved, suspicious or same."""
        return "moved" if self.moved else "suspicious" if self.suspicious or self.suspected else "same"

    word = verdict

    @property
    def answer(self) -> ComparisonAnswer:
        """Severity and exit code of the verdict."""
        return ANSWERS[self.verdict]

    @property
    def contradicting(self) -> tuple[Change, ...]:
        """Changes of the mounting at 1 %, across which an average would be no calibration's mounting."""
        level = CHANCE / (len(self.calibrations) - 1)
        return tuple(move for move in (*self.moved, *self.suspicious) if move.difference.chance(MOUNTING) < level)

    @property
    def same_mounting(self) -> bool:
        """Return whether no movement is found or suspected."""
        return self.verdict == "same"


def contradicts(result: Extrinsics, initial: Extrinsics) -> Difference | None:
    """Return the difference of an initial calibration from another at 1 %; None if they agree."""
    difference = Difference.between(initial, result)
    return difference if difference.chance(MOUNTING) < CHANCE else None


def check_distinct(calibrations: Sequence[Extrinsics]) -> None:
    """Raise InputError for a calibration that is given twice: its differences would be zero."""
    for one, other in combinations(calibrations, 2):
        identity, other_identity = ((c.model, c.first_ns, c.last_ns, c.used) for c in (one, other))
        if identity == other_identity and np.allclose(one.covariance, other.covariance, rtol=1e-6, atol=0.0):
            raise InputError(
                f"{one.name}, {other.name}: are the same calibration, which cannot be compared with itself"
            )


def compare(calibrations: Sequence[Extrinsics]) -> Comparison:
    """Compare two or more calibrations. Raise InputError if no angle is observable in two of them.

    Rejected calibrations are excluded from tests of accepted ones, and alone can only be suspicious, because their σ is
    not reliable.
    """
    if len(calibrations) < 2:
        name = calibrations[0].name if calibrations else "nothing"
        raise InputError(f"{name}: one alone cannot be compared; name two")
    ordered = sorted(calibrations, key=lambda one: one.first_ns)  # stable for equal stamps
    ordered = [replace(calibration, value=_near(calibration.value, ordered[0].value)) for calibration in ordered]
    pairs = [Difference.between(*two) for two in combinations(ordered, 2)]
    if not any(pair.compared[MOUNTING].any() for pair in pairs):
        raise InputError(
            f"{', '.join(calibration.name for calibration in ordered)}: no angle is observable in two of them, so "
            "there is nothing to compare; calibrate on more data (dvl-calib doctor says what is missing)"
        )
    accepted = [calibration for calibration in ordered if not calibration.rejected]
    series = accepted or ordered
    instants = max(len(series) - 1, 1)
    together = cache(fused)
    changes = _changes(series, MOUNTING, SUSPICIOUS / instants, together)
    moved = [change for change in changes if accepted and change.difference.chance(MOUNTING) < MOVED / instants]
    return Comparison(
        calibrations=tuple(ordered),
        pairs=tuple(pairs),
        moved=tuple(moved),
        suspicious=tuple(change for change in changes if change not in moved),
        suspected=tuple(_suspected(series, [calibration for calibration in ordered if calibration not in series])),
        scale_changed=tuple(_changes(series, ONLY_SCALE, CHANCE / instants, together)),
        clock_changed=tuple(_changes(series, ONLY_CLOCK, CHANCE / instants, together)),
        scatter=_scatter(series, [change.first_after for change in changes], together),
        smallest=_smallest([change.difference for change in _splits(series, together)] or pairs),
    )


def fused(several: Sequence[Extrinsics]) -> Extrinsics:
    """Average calibrations of one mounting, weighted by their information.

    Mounting, scale and delay are averaged separately by their marginal covariances. Speed of sound and clocks change
    from day to day, which would otherwise bias the mounting. The bias of one DVL is common to all: it is a state, whose
    remaining σ is part of the result.
    """
    if len(several) == 1:
        return several[0]
    base = several[0]
    if any(not calibration.dvl or calibration.dvl != base.dvl for calibration in several):
        several = [replace(calibration, dvl="", by_bias=np.zeros_like(calibration.by_bias)) for calibration in several]
    observable = np.any([calibration.shown for calibration in several], axis=0)
    values = np.array([_near(calibration.value, base.value) for calibration in several])
    value, by_bias = values[0].copy(), np.zeros((N_COMPONENTS, N_AXES))  # not observable: value of the first
    covariance = np.zeros((N_COMPONENTS, N_COMPONENTS))
    informations = np.array([calibration.information for calibration in several])
    by_biases = np.array([calibration.by_bias for calibration in several])
    information, vector = informations.sum(axis=0), np.einsum("nij,nj->i", informations, values)
    bias_information = informations @ by_biases
    for index in (group[observable[group]] for group in GROUPS):
        # bias of σ 1 as an additional state
        cross_information = bias_information[:, index].sum(axis=0)
        own_information = np.eye(N_AXES) + np.einsum("nia,nib->ab", by_biases[:, index], bias_information[:, index])
        bias_vector = np.einsum("nia,ni->a", bias_information[:, index], values[:, index])
        gain = cross_information @ np.linalg.inv(own_information)
        p = np.linalg.inv(information[np.ix_(index, index)] - gain @ cross_information.T)
        value[index], by_bias[index] = p @ (vector[index] - gain @ bias_vector), p @ gain
        covariance[np.ix_(index, index)] = p - by_bias[index] @ by_bias[index].T
    return replace(
        base,
        name=f"{len(several)} together",
        model=" ".join(dict.fromkeys(calibration.model for calibration in several)),
        last_ns=max(calibration.last_ns for calibration in several),
        value=value,
        covariance=covariance + by_bias @ by_bias.T,
        shown=observable,
        dvl=several[0].dvl,
        by_bias=by_bias,
        used=sum(calibration.used for calibration in several),
        remarks=(),
    )


_Together = Callable[[tuple[Extrinsics, ...]], Extrinsics]


def _near(value: Array, base: Array) -> Array:
    """Return components (8,) with angles within half a turn of `base`."""
    return np.concatenate([near_angles(value[ANGLES], base[ANGLES]), value[ANGLES.stop :]])


def _splits(series: Sequence[Extrinsics], together: _Together) -> list[Change]:
    """Return the difference at every instant of a series in order of time."""
    parts = ((together(tuple(series[:k])), together(tuple(series[k:]))) for k in range(1, len(series)))
    return [Change(Difference.between(*two), *ends) for two, ends in zip(parts, pairwise(series), strict=True)]


def _changes(
    series: Sequence[Extrinsics], components: NDArray[np.intp], level: float, together: _Together
) -> list[Change]:
    """Find changes of some components of a series, in order of time."""

    def rank(change: Change) -> tuple[float, float]:  # the ratio decides where p underflows
        ratio = np.abs(change.difference.value / change.difference.std)[components]
        return change.difference.chance(components), -float(np.nan_to_num(ratio).max())

    splits = _splits(series, together)
    best = min(splits, key=rank, default=None)
    if best is None or best.difference.chance(components) >= level:
        return []
    split = series.index(best.first_after)
    before, after = (_changes(part, components, level, together) for part in (series[:split], series[split:]))
    return [*before, best, *after]


def _suspected(series: Sequence[Extrinsics], rejected: Sequence[Extrinsics]) -> list[Change]:
    """Compare each rejected calibration with the accepted one nearest in stamps."""
    found = []
    for doubted in rejected:
        nearest = min(series, key=lambda other: abs(other.first_ns - doubted.first_ns))
        first, second = sorted((nearest, doubted), key=lambda calibration: calibration.first_ns)
        found.append(Change(Difference.between(first, second), first, second))
    return [move for move in found if move.difference.chance(MOUNTING) < SUSPICIOUS / len(rejected)]


def _smallest(differences: Sequence[Difference]) -> Array:
    """Return the movement (3,) rad of each angle that is found with `POWER` in the least certain difference."""
    found = np.full(N_AXES, np.nan)
    for difference in differences:
        level = SUSPICIOUS / (len(differences) * max(int(difference.compared.sum()), 1))
        found = np.fmax(found, smallest_found(level, POWER) * difference.std[ANGLES])
    return found


def _scatter(series: Sequence[Extrinsics], starts: Sequence[Extrinsics], together: _Together) -> ChiSquare:
    """Test the mountings about the mean of each stretch that begins at one of `starts`."""
    total, freedom, begin = 0.0, 0, 0
    for k, calibration in enumerate(series):
        begin = k if calibration in starts else begin
        if k > begin:  # each against those before it: independent terms, the same sum
            test = Difference.between(together(tuple(series[begin:k])), calibration).chi_square(MOUNTING)
            total, freedom = total + test.value, freedom + test.freedom
    return ChiSquare(total, freedom, chi2_sf(total, freedom) if freedom else math.nan)


# Difference of lever arms, m, that a vehicle's builder would see; as an error it biases yaw by tenths of a degree.
ARM_MATTERS_M = 0.3
_ANGLE_NAMES = COMPONENTS[ANGLES]


def reasons(comparison: Comparison) -> list[Reason]:
    """Return the findings, the mounting first."""
    findings = [*map(moved, comparison.moved), *map(suspicious, comparison.suspicious)]
    findings = [*findings, *map(suspected, comparison.suspected)] or [_no_movement(comparison)]
    findings += map(scale_changed, comparison.scale_changed)
    for change in comparison.clock_changed:
        seconds, std = float(change.difference.value[TIME_OFFSET]), float(change.difference.std[TIME_OFFSET])
        way = "later" if seconds > 0.0 else "earlier"
        findings.append(finding("DELAY_CHANGED", seconds=abs(seconds), std=std, way=way, between=between(change)))
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        code = "SCATTER_BESIDE_MOVES" if comparison.moved or comparison.suspicious else "SCATTER"
        findings.append(finding(code, by=math.sqrt(scatter.value / scatter.freedom)))
    return findings


def _no_movement(comparison: Comparison) -> Reason:
    """Return the smallest movement that would be found, or that no single date explains the differences."""
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        change = max(float(np.nanmax(np.abs(pair.value[ANGLES]), initial=0.0)) for pair in comparison.pairs)
        numbers = {"chi_square": scatter.value, "freedom": scatter.freedom, "p": scatter.p}
        return finding("MOUNTING_SCATTERS", count=len(comparison.calibrations), apart=math.degrees(change), **numbers)
    smallest = np.degrees(comparison.smallest)
    found = [f"{name} {size:.1f}°" for name, size in zip(_ANGLE_NAMES, smallest, strict=True) if not math.isnan(size)]
    not_compared = [name for name, size in zip(_ANGLE_NAMES, smallest, strict=True) if math.isnan(size)]
    return finding(
        "MOUNTING_SAME",
        smallest=float(np.nanmax(smallest, initial=0.0)),
        angles=", ".join(found),
        power=100.0 * POWER,
        unseen=f"; {' and '.join(not_compared)} cannot be compared" if not_compared else "",
    )


def moved(change: Change) -> Reason:
    """Word a movement."""
    return finding("MOUNTING_MOVED", moved=moved_in_words(change.difference), between=between(change))


def suspicious(change: Change) -> Reason:
    """Word a possible movement."""
    often = float(f"{1.0 / max(change.difference.chance(MOUNTING), 1e-6):.2g}")
    words = moved_in_words(change.difference)
    return finding("MOUNTING_SUSPICIOUS", moved=words, between=between(change), often=often)


def suspected(change: Change) -> Reason:
    """Word a rejected calibration that differs from an accepted one."""
    rejected = change.first_after if change.first_after.rejected else change.last_before
    other = change.last_before if rejected is change.first_after else change.first_after
    words = moved_in_words(change.difference)
    return finding("MOUNTING_SUSPECTED", name=rejected.name, other=other.name, moved=words, why=rejected.rejected)


def scale_changed(change: Change) -> Reason:
    """Word a change of scale."""
    percent, std = (100.0 * float(part[SCALE]) for part in (change.difference.value, change.difference.std))
    return finding("SCALE_CHANGED", percent=percent, std=std, between=between(change))


def remarks(comparison: Comparison) -> list[Reason]:
    """Say what makes differences less reliable than their σ."""
    found = [
        finding("CALIBRATION_DOUBTED", name=calibration.name, remark=remark)
        for calibration in comparison.calibrations
        for remark in calibration.remarks
    ]
    models = dict.fromkeys(calibration.model for calibration in comparison.calibrations)
    if len(models) > 1:
        found.append(finding("MODELS_DIFFER", models=", ".join(models)))
    assumed = [calibration for calibration in comparison.calibrations if not calibration.shown[LEVER_ARM].any()]
    estimated = [calibration for calibration in comparison.calibrations if calibration.shown[LEVER_ARM].any()]
    for each in assumed:
        for other in (*estimated, *assumed):
            gap = np.where(
                other.shown[LEVER_ARM] | (other not in estimated), other.value[LEVER_ARM] - each.value[LEVER_ARM], 0.0
            )
            if float(np.linalg.norm(gap)) > ARM_MATTERS_M:
                arm = ", ".join(f"{value:.2f}" for value in other.value[LEVER_ARM])
                verb = "finds" if other in estimated else "assumes"
                found.append(finding("ARMS_DIFFER", name=each.name, other=other.name, verb=verb, arm=arm))
                break
    return found


def moved_in_words(difference: Difference) -> str:
    """Word the significant parts of a movement, such as ``in yaw by +0.70° ± 0.05°``; else the most significant one."""
    p = np.where(difference.compared, difference.p, 1.0)[MOUNTING]
    parts = []
    for at in np.flatnonzero((p < SUSPICIOUS) | (np.arange(len(p)) == p.argmin())):
        unit, factor = ("°", math.degrees(1.0)) if at < ANGLES.stop else (" m", 1.0)
        value, std = factor * difference.value[at], factor * difference.std[at]
        parts.append(f"{COMPONENTS[at].replace('_', ' ')} by {value:+.2f}{unit} ± {std:.2f}{unit}")
    return f"in {' and '.join(parts)}"


def between(change: Change) -> str:
    """Name the calibrations around a change, such as ``between 2025-06-16 16:06 (a) and 2025-06-17 15:06 (b)``."""
    before, after = change.last_before, change.first_after
    if before.last_ns > after.first_ns:  # simulated, or stamped from a start of their own
        return f"between {before.name} and {after.name}"
    return f"between {date(before.last_ns)} ({before.name}) and {date(after.first_ns)} ({after.name})"


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """Return plain data for `compare --json`, in SI units."""
    findings, remarked = reasons(comparison), remarks(comparison)
    return {
        "verdict": comparison.word,
        "same_mounting": comparison.same_mounting,
        "says": [reason.full_sentence for reason in findings],
        "remarks": [str(reason) for reason in remarked],
        "findings": [reason.as_dict() for reason in (*findings, *remarked)],
        "calibrations": [
            {name: getattr(calibration, name) for name in ("name", "model", "first_ns", "last_ns", "used", "rejected")}
            | {"value": _named(calibration.value), "std": _named(calibration.std)}
            for calibration in comparison.calibrations
        ],
        "pairs": [_difference_document(pair) for pair in comparison.pairs],
        **{
            name: [
                {"last_before": change.last_before.name, "first_after": change.first_after.name}
                | _difference_document(change.difference)
                for change in getattr(comparison, name)
            ]
            for name in ("moved", "suspicious", "suspected", "scale_changed", "clock_changed")
        },
        "scatter": comparison.scatter._asdict(),
        "smallest_seen": {"power": POWER} | dict(zip(_ANGLE_NAMES, comparison.smallest.tolist(), strict=True)),
    }


def _difference_document(difference: Difference) -> dict[str, Any]:
    """Return plain data of a difference."""
    return {
        "first": difference.first.name,
        "second": difference.second.name,
        "value": _named(difference.value),
        "std": _named(difference.std),
        "p": _named(difference.p),
    }


def _named(values: Array) -> dict[str, float]:
    return dict(zip(COMPONENTS, values.tolist(), strict=True))
