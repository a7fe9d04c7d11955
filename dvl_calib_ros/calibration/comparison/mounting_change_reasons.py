"""What there is to say of calibrations compared: reasons, remarks, and plain data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import rpy_from_rotation
from ..results.extrinsics import COMPONENTS, LEVER_ARM, MOUNTING, ONLY_CLOCK, ONLY_SCALE, SCALE, TIME_OFFSET, TURN
from ..results.mounting_quantities import date
from .mounting_change import CHANCE, Change, Comparison, Difference

# An axis that takes more than this share of a turn is the one that it is about.
ABOUT = 0.9
# What a vehicle's builder would not have let pass unseen, m: a lever arm taken as known that is off by more turns the
# yaw by tenths of a degree.
ARM_MATTERS = 0.3


def reasons(comparison: Comparison) -> list[Reason]:
    """What there is to say, the mounting first."""
    said = [moved(change) for change in comparison.moved]
    said = said + [suspicious(change) for change in comparison.suspicious] or [_same(comparison)]
    said += [scale_changed(change) for change in comparison.scale_changed]
    for change in comparison.clock_changed:
        seconds, std = float(change.difference.value[TIME_OFFSET]), float(change.difference.std[TIME_OFFSET])
        way = "later" if seconds > 0.0 else "earlier"
        said.append(finding("DELAY_CHANGED", seconds=abs(seconds), std=std, way=way, between=between(change)))
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        code = "SCATTER_BESIDE_MOVES" if comparison.moved else "SCATTER"
        said.append(finding(code, by=math.sqrt(scatter.value / scatter.freedom)))
    return said


def _same(comparison: Comparison) -> Reason:
    pairs = [pair for pair in comparison.pairs if pair.compared[TURN].any()]
    apart = max((float(np.nanmax(np.abs(pair.value[TURN]))) for pair in pairs), default=0.0)
    scatter = comparison.scatter
    return finding(
        "MOUNTING_SCATTERS" if scatter.freedom and scatter.p < CHANCE else "MOUNTING_SAME",
        count=len(comparison.calibrations),
        apart=math.degrees(apart),
        chi_square=scatter.value,
        freedom=scatter.freedom,
        p=scatter.p,
    )


def moved(change: Change) -> Reason:
    """Of a mounting that moved."""
    return finding("MOUNTING_MOVED", moved=moved_in_words(change.difference), between=between(change))


def suspicious(change: Change) -> Reason:
    """Of a mounting that may have moved."""
    often = 1.0 / change.difference.chance(MOUNTING)
    words = moved_in_words(change.difference)
    return finding("MOUNTING_SUSPICIOUS", moved=words, between=between(change), often=often)


def scale_changed(change: Change) -> Reason:
    """Of a scale that changed."""
    percent, std = (100.0 * float(each[SCALE]) for each in (change.difference.value, change.difference.std))
    return finding("SCALE_CHANGED", percent=percent, std=std, between=between(change))


def remarks(comparison: Comparison) -> list[Reason]:
    """What makes the differences worth less than they look."""
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
            off = np.where(other.shown[LEVER_ARM] | (other not in known), other.lever_arm - each.lever_arm, 0.0)
            if float(np.linalg.norm(off)) > ARM_MATTERS:
                arm = ", ".join(f"{value:.2f}" for value in other.lever_arm)
                verb = "finds" if other in known else "assumes"
                found.append(finding("ARMS_DIFFER", name=each.name, other=other.name, verb=verb, arm=arm))
                break
    return found


def moved_in_words(difference: Difference) -> str:
    """By how much a mounting moved, such as ``by 0.70° ± 0.05° about z``."""
    turn, arm = difference.test(MOUNTING[TURN]), difference.test(MOUNTING[LEVER_ARM])
    parts = []
    if turn.freedom and (turn.p < CHANCE or not arm.p < CHANCE):
        parts.append(f"by {turn_in_words(difference)}")
    if arm.freedom and (arm.p < CHANCE or not parts):
        found = ((axis, difference.value[LEVER_ARM][i], difference.std[LEVER_ARM][i]) for i, axis in enumerate("xyz"))
        shown = (f"{axis} {value:+.2f} m ± {std:.2f} m" for axis, value, std in found if std == std)
        parts.append(f"in its place (lever arm {', '.join(shown)})")
    return " and ".join(parts)


def turn_in_words(difference: Difference) -> str:
    """Size, σ and axis of a turn, such as ``0.70° ± 0.05° about z``."""
    turn = np.where(difference.compared[TURN], difference.value[TURN], 0.0)
    angle = float(np.linalg.norm(turn))
    if angle == 0.0:
        return "0.00°"
    axis = turn / angle
    std = math.sqrt(float(axis @ difference.covariance[TURN, TURN] @ axis))
    size = f"{math.degrees(angle):.2f}° ± {math.degrees(std):.2f}°"
    most = int(np.argmax(np.abs(axis)))
    if abs(axis[most]) > ABOUT:
        return f"{'-' if axis[most] < 0.0 else ''}{size} about {'xyz'[most]}"
    each = (
        f"{name} {math.degrees(value):+.2f}°"
        for name, value, known in zip("xyz", turn, difference.compared[TURN], strict=True)
        if known
    )
    return f"{size} ({', '.join(each)})"


def between(change: Change) -> str:
    """Between which calibrations, such as ``between 2025-06-16 16:06 (a) and 2025-06-17 15:06 (b)``."""
    before, after = change.last_before, change.first_after
    if before.last_ns > after.first_ns:  # simulated, or stamped from a start of their own
        return f"between {before.name} and {after.name}"
    return f"between {date(before.last_ns)} ({before.name}) and {date(after.first_ns)} ({after.name})"


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """`compare --json`: SI units, turns about the body's axes."""
    said, remarked = reasons(comparison), remarks(comparison)
    return {
        "verdict": comparison.word,
        "same_mounting": comparison.same_mounting,
        "says": [each.full_sentence for each in said],
        "remarks": [str(each) for each in remarked],
        "findings": [each.as_dict() for each in (*said, *remarked)],
        "calibrations": [
            {
                "name": each.name,
                "model": each.model,
                "first_ns": each.first_ns,
                "last_ns": each.last_ns,
                "used": each.used,
                "mounting_rpy": rpy_from_rotation(each.rotation_body_from_dvl).tolist(),
                "lever_arm": each.lever_arm.tolist(),
                "scale": each.scale,
                "dvl_time_offset": each.time_offset,
                "std": dict(zip(COMPONENTS, each.std.tolist(), strict=True)),
            }
            for each in comparison.calibrations
        ],
        "pairs": [_difference_document(each) for each in comparison.pairs],
        "against_rest": [_difference_document(each) for each in comparison.against_rest],
        **{
            name: [
                {
                    "last_before": change.last_before.name,
                    "first_after": change.first_after.name,
                    **_difference_document(change.difference),
                }
                for change in getattr(comparison, name)
            ]
            for name in ("moved", "suspicious", "scale_changed", "clock_changed")
        },
        "scatter": comparison.scatter._asdict(),
    }


def _difference_document(difference: Difference) -> dict[str, Any]:
    return {
        "first": difference.first.name,
        "second": difference.second.name,
        "value": dict(zip(COMPONENTS, difference.value.tolist(), strict=True)),
        "std": dict(zip(COMPONENTS, difference.std.tolist(), strict=True)),
        "chi_square": {
            "mounting": difference.test(MOUNTING)._asdict(),
            "scale": difference.test(ONLY_SCALE)._asdict(),
            "clock": difference.test(ONLY_CLOCK)._asdict(),
            "all": difference.test()._asdict(),
        },
    }
