"""Wording of a comparison of calibrations: reasons, remarks, and plain data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import Array
from ..results.extrinsics import ANGLES, COMPONENTS, LEVER_ARM, MOUNTING, SCALE, TIME_OFFSET
from ..results.mounting_quantities import date
from .mounting_change import CHANCE, POWER, SUSPICIOUS, Change, Comparison, Difference

# Difference of lever arms, m, that a vehicle's builder would see; as an error it biases yaw by tenths of a degree.
ARM_MATTERS_M = 0.3
_ANGLE_NAMES = COMPONENTS[ANGLES]


def reasons(comparison: Comparison) -> list[Reason]:
    """Return the findings, the mounting first."""
    said = [*map(moved, comparison.moved), *map(suspicious, comparison.suspicious)]
    said = [*said, *map(suspected, comparison.suspected)] or [_same(comparison)]
    said += map(scale_changed, comparison.scale_changed)
    for change in comparison.clock_changed:
        seconds, std = float(change.difference.value[TIME_OFFSET]), float(change.difference.std[TIME_OFFSET])
        way = "later" if seconds > 0.0 else "earlier"
        said.append(finding("DELAY_CHANGED", seconds=abs(seconds), std=std, way=way, between=between(change)))
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        code = "SCATTER_BESIDE_MOVES" if comparison.moved or comparison.suspicious else "SCATTER"
        said.append(finding(code, by=math.sqrt(scatter.value / scatter.freedom)))
    return said


def _same(comparison: Comparison) -> Reason:
    """Return the smallest movement that would be found, or that no single date explains the differences."""
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        apart = max(float(np.nanmax(np.abs(pair.value[ANGLES]), initial=0.0)) for pair in comparison.pairs)
        numbers = {"chi_square": scatter.value, "freedom": scatter.freedom, "p": scatter.p}
        return finding("MOUNTING_SCATTERS", count=len(comparison.calibrations), apart=math.degrees(apart), **numbers)
    smallest = np.degrees(comparison.smallest)
    seen = [f"{name} {each:.1f}°" for name, each in zip(_ANGLE_NAMES, smallest, strict=True) if not math.isnan(each)]
    unseen = [name for name, each in zip(_ANGLE_NAMES, smallest, strict=True) if math.isnan(each)]
    return finding(
        "MOUNTING_SAME",
        smallest=float(np.nanmax(smallest, initial=0.0)),
        angles=", ".join(seen),
        power=100.0 * POWER,
        unseen=f"; {' and '.join(unseen)} cannot be compared" if unseen else "",
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
    percent, std = (100.0 * float(each[SCALE]) for each in (change.difference.value, change.difference.std))
    return finding("SCALE_CHANGED", percent=percent, std=std, between=between(change))


def remarks(comparison: Comparison) -> list[Reason]:
    """Say what makes differences less reliable than their σ."""
    found = [
        finding("CALIBRATION_DOUBTED", name=each.name, remark=remark)
        for each in comparison.calibrations
        for remark in each.remarks
    ]
    models = dict.fromkeys(each.model for each in comparison.calibrations)
    if len(models) > 1:
        found.append(finding("MODELS_DIFFER", models=", ".join(models)))
    assumed = [each for each in comparison.calibrations if not each.shown[LEVER_ARM].any()]
    known = [each for each in comparison.calibrations if each.shown[LEVER_ARM].any()]
    for each in assumed:
        for other in (*known, *assumed):
            off = np.where(
                other.shown[LEVER_ARM] | (other not in known), other.value[LEVER_ARM] - each.value[LEVER_ARM], 0.0
            )
            if float(np.linalg.norm(off)) > ARM_MATTERS_M:
                arm = ", ".join(f"{value:.2f}" for value in other.value[LEVER_ARM])
                verb = "finds" if other in known else "assumes"
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
    said, remarked = reasons(comparison), remarks(comparison)
    return {
        "verdict": comparison.word,
        "same_mounting": comparison.same_mounting,
        "says": [each.full_sentence for each in said],
        "remarks": [str(each) for each in remarked],
        "findings": [each.as_dict() for each in (*said, *remarked)],
        "calibrations": [
            {name: getattr(each, name) for name in ("name", "model", "first_ns", "last_ns", "used", "rejected")}
            | {"value": _named(each.value), "std": _named(each.std)}
            for each in comparison.calibrations
        ],
        "pairs": [_difference_document(each) for each in comparison.pairs],
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
    return {
        "first": difference.first.name,
        "second": difference.second.name,
        "value": _named(difference.value),
        "std": _named(difference.std),
        "p": _named(difference.p),
    }


def _named(values: Array) -> dict[str, float]:
    return dict(zip(COMPONENTS, values.tolist(), strict=True))
