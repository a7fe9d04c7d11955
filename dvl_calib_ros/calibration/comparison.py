"""Calibrations of one DVL compared: what differs by more than its σ, and between which of them it changed.

Every calibration is an estimate with a covariance, of other data than the others'. The difference of two has the sum of
their covariances; d'S⁻¹d of it is chi-square distributed if nothing changed. Of a series in time the instant is looked
for that parts it best into before and after, then within either part ("binary segmentation"; Scott and Knott, "A
cluster analysis method for grouping means in the analysis of variance", 1974). (Long, because what is compared and how
it is worded stand together.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .chi_square import chi2_sf
from .extrinsics import (
    COMPONENTS,
    LEVER_ARM,
    N_COMPONENTS,
    SCALE,
    TIME_OFFSET,
    TURN,
    Extrinsics,
    rotation_of,
    turn_between,
)
from .frames import Array, rpy_from_rotation

# A difference that chance brings more seldom than this is none of chance, over all that is looked at together.
CHANCE = 0.01
# Of a mounting: as seldom as a normal error is beyond 4 σ it has moved, beyond 2 σ that is suspicious.
MOVED, SUSPICIOUS = chi2_sf(16.0, 1), chi2_sf(4.0, 1)
# An axis that takes more than this share of a turn is the one that it is about.
ABOUT = 0.9
# What a vehicle's builder would not have let pass unseen, m: a lever arm taken as known that is off by more turns the
# yaw by tenths of a degree.
ARM_MATTERS = 0.3

_ALL = np.arange(N_COMPONENTS)
MOUNTING, ONLY_SCALE, ONLY_CLOCK = _ALL[: LEVER_ARM.stop], _ALL[[SCALE]], _ALL[[TIME_OFFSET]]


class ChiSquare(NamedTuple):
    """d'S⁻¹d, how many components it is of, and how often chance makes it as large; nan if there are none."""

    value: float
    freedom: int
    p: float

    @staticmethod
    def of(value: float, freedom: int) -> ChiSquare:
        """With the probability."""
        return ChiSquare(value, freedom, chi2_sf(value, freedom) if freedom else math.nan)


@dataclass(frozen=True)
class Difference:
    """Second less first of two calibrations, each of one or of several together.

    value (8,), covariance (8, 8): of `extrinsics.COMPONENTS`; the turn (rad, body axes) takes the first mounting to the
    second. compared (8,): what both have shown.
    """

    first: Extrinsics
    second: Extrinsics
    value: Array
    covariance: Array
    compared: NDArray[np.bool_]

    @staticmethod
    def between(first: Extrinsics, second: Extrinsics) -> Difference:
        """What takes the first to the second."""
        value = _values(second, first) - _values(first, first)
        compared = first.shown & second.shown
        covariance = np.where(np.outer(compared, compared), first.covariance + second.covariance, 0.0)
        return Difference(first, second, np.where(compared, value, np.nan), covariance, compared)

    @property
    def std(self) -> Array:
        """(8,), nan for what is not compared."""
        return np.where(self.compared, np.sqrt(np.diag(self.covariance)), np.nan)

    def test(self, components: NDArray[np.intp] = _ALL) -> ChiSquare:
        """Chi-square of some components together."""
        at = components[self.compared[components]]
        if not len(at):
            return ChiSquare.of(0.0, 0)
        d = self.value[at]
        return ChiSquare.of(float(d @ np.linalg.solve(self.covariance[np.ix_(at, at)], d)), len(at))

    def chance(self, components: NDArray[np.intp] = _ALL) -> float:
        """How often chance makes as much of some components: of all together, or of the one that stands out most.

        Both, as one angle that moved is little among five that did not; by Bonferroni. 1 if there are none.
        """
        at = components[self.compared[components]]
        if len(at) <= 1:
            return self.test(at).p if len(at) else 1.0
        one = chi2_sf(float(((self.value / self.std)[at] ** 2).max()), 1)
        return min(1.0, 2.0 * min(self.test(at).p, len(at) * one))


@dataclass(frozen=True)
class Change:
    """Between two neighbours in time. before, after: all up to the next change, taken together, whose difference it is.
    last_before, first_after: the neighbours."""

    difference: Difference
    last_before: Extrinsics
    first_after: Extrinsics


@dataclass(frozen=True)
class Comparison:
    """Several calibrations of one DVL.

    calibrations: in order of time. pairs: every two. against_rest: each against all others taken together; empty for
    two. moved, suspicious: where the mounting (turn and lever arm) changed by more than 4 σ, and by 2 to 4 σ.
    scale_changed, clock_changed: where scale and delay did. scatter: of all about what is common between the changes of
    the mounting.
    """

    calibrations: tuple[Extrinsics, ...]
    pairs: tuple[Difference, ...]
    against_rest: tuple[Difference, ...]
    moved: tuple[Change, ...]
    suspicious: tuple[Change, ...]
    scale_changed: tuple[Change, ...]
    clock_changed: tuple[Change, ...]
    scatter: ChiSquare

    @property
    def word(self) -> str:
        """The answer: moved, suspicious or same."""
        return "moved" if self.moved else "suspicious" if self.suspicious else "same"

    @property
    def same_mounting(self) -> bool:
        """Whether nothing says that the mounting moved, nor makes it suspicious."""
        return self.word == "same"


def check_distinct(calibrations: Sequence[Extrinsics]) -> None:
    """Raise InputError if two are one calibration by two names, which would confirm itself."""
    for one, other in combinations(calibrations, 2):
        of_one, of_other = ((each.model, each.first_ns, each.last_ns, each.used) for each in (one, other))
        if of_one == of_other and np.allclose(one.covariance, other.covariance, rtol=1e-6, atol=0.0):
            raise InputError(
                f"{one.name}, {other.name}: are one calibration by two names, which cannot be compared with itself"
            )


def compare(calibrations: Sequence[Extrinsics]) -> Comparison:
    """Compare two calibrations and more. Raises InputError if there is nothing that two of them have shown."""
    if len(calibrations) < 2:
        name = calibrations[0].name if calibrations else "nothing"
        raise InputError(f"{name}: one alone cannot be compared; name two")
    ordered = sorted(calibrations, key=lambda each: each.first_ns)  # stable: of equal ones as they are given
    n = len(ordered)
    pairs = [Difference.between(ordered[i], ordered[j]) for i in range(n) for j in range(i + 1, n)]
    if not any(pair.compared[MOUNTING].any() for pair in pairs):
        raise InputError(
            f"{', '.join(each.name for each in ordered)}: no angle that two of them have shown, so there is nothing to "
            "compare; calibrate on more data (dvl-calib doctor says what is missing)"
        )
    rest = [Difference.between(fused(ordered[:i] + ordered[i + 1 :]), ordered[i]) for i in range(n)] if n > 2 else []
    together, chance = _Together(), CHANCE / (n - 1)
    changes = _changes(ordered, MOUNTING, SUSPICIOUS / (n - 1), together)
    moved = [change for change in changes if change.difference.chance(MOUNTING) < MOVED / (n - 1)]
    return Comparison(
        calibrations=tuple(ordered),
        pairs=tuple(pairs),
        against_rest=tuple(rest),
        moved=tuple(moved),
        suspicious=tuple(change for change in changes if change not in moved),
        scale_changed=tuple(_changes(ordered, ONLY_SCALE, chance, together)),
        clock_changed=tuple(_changes(ordered, ONLY_CLOCK, chance, together)),
        scatter=_scatter(ordered, [change.first_after for change in moved], together),
    )


def fused(several: Sequence[Extrinsics]) -> Extrinsics:
    """What several calibrations of one and the same say together: weighted by their information.

    Mounting, scale and delay each for themselves, by their marginal covariances: speed of sound and clocks change from
    day to day, and what is forced to be common where it is not would bend the others.
    """
    if len(several) == 1:
        return several[0]
    base = several[0]
    shown = np.any([each.shown for each in several], axis=0)
    covariance, found = np.zeros((N_COMPONENTS, N_COMPONENTS)), np.zeros(N_COMPONENTS)
    values = [_values(each, base) for each in several]
    for group in (MOUNTING, ONLY_SCALE, ONLY_CLOCK):
        information, vector = np.zeros((N_COMPONENTS, N_COMPONENTS)), np.zeros(N_COMPONENTS)
        for each, own_values in zip(several, values, strict=True):
            index = group[each.shown[group]]
            at = np.ix_(index, index)
            own = np.linalg.inv(each.covariance[at])
            information[at] += own
            vector[index] += own @ own_values[index]
        index = group[shown[group]]
        at = np.ix_(index, index)
        covariance[at] = np.linalg.inv(information[at])
        found[index] = covariance[at] @ vector[index]
    # what nobody has shown stays as the first assumes it
    found = np.where(shown, found, values[0])
    return replace(
        base,
        name=f"{len(several)} together",
        model=" ".join(dict.fromkeys(each.model for each in several)),
        last_ns=max(each.last_ns for each in several),
        rotation_body_from_dvl=rotation_of(found[TURN]) @ base.rotation_body_from_dvl,
        lever_arm=found[LEVER_ARM],
        scale=float(found[SCALE]),
        time_offset=float(found[TIME_OFFSET]),
        covariance=covariance,
        shown=shown,
        used=sum(each.used for each in several),
        remarks=(),
    )


class _Together:
    """`fused`, remembering what several gave: stretches of one series are asked for again and again."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], Extrinsics] = {}

    def __call__(self, several: Sequence[Extrinsics]) -> Extrinsics:
        """Of some of one series, which lives as long as this."""
        key = tuple(map(id, several))
        if key not in self._known:
            self._known[key] = fused(several)
        return self._known[key]


def _values(each: Extrinsics, base: Extrinsics) -> Array:
    """(8,) components, the turn being that from the mounting of `base`."""
    turn = turn_between(base.rotation_body_from_dvl, each.rotation_body_from_dvl)
    return np.array([*turn, *each.lever_arm, each.scale, each.time_offset])


def _changes(
    series: list[Extrinsics], components: NDArray[np.intp], chance: float, together: _Together
) -> list[Change]:
    """Where some components of a series in time change, in order of time."""
    best, at = None, 0
    for k in range(1, len(series)):
        difference = Difference.between(together(series[:k]), together(series[k:]))
        # by how surprising it is: where few components are compared, a smaller sum is as much. Beyond what a double
        # holds as a probability the sum itself decides
        surprise = difference.chance(components), -difference.test(components).value
        if surprise[0] < chance and (best is None or surprise < best):
            best, found, at = surprise, difference, k
    if best is None:
        return []
    change = Change(found, series[at - 1], series[at])
    before, after = (_changes(part, components, chance, together) for part in (series[:at], series[at:]))
    return [*before, change, *after]


def _scatter(series: list[Extrinsics], starts: list[Extrinsics], together: _Together) -> ChiSquare:
    """Of the mountings about what is common to each stretch between changes."""
    total, freedom = 0.0, 0
    stretches: list[list[Extrinsics]] = [[]]
    for each in series:
        if any(each is start for start in starts):
            stretches.append([])
        stretches[-1].append(each)
    for stretch in stretches:
        for k in range(1, len(stretch)):  # each against those before it: independent terms, the same sum
            test = Difference.between(together(stretch[:k]), stretch[k]).test(MOUNTING)
            total, freedom = total + test.value, freedom + test.freedom
    return ChiSquare.of(total, freedom)


# ------------------------------------------------------------------ in words


def sentences(comparison: Comparison) -> list[str]:
    """What there is to say, the mounting first."""
    said = [_moved(change) for change in comparison.moved]
    said = said + [_suspicious(change) for change in comparison.suspicious] or [_same(comparison)]
    said += [
        f"The scale has changed by {100 * change.difference.value[SCALE]:+.2f} % ± "
        f"{100 * change.difference.std[SCALE]:.2f} % {_between(change)}: the speed of sound, or the DVL's settings."
        for change in comparison.scale_changed
    ]
    for change in comparison.clock_changed:
        seconds, std = change.difference.value[TIME_OFFSET], change.difference.std[TIME_OFFSET]
        way = "later" if seconds > 0.0 else "earlier"
        said.append(
            f"The DVL's stamps come {abs(seconds):.2f} s ± {std:.2f} s {way} {_between(change)}: a clock, not the "
            "mounting."
        )
    scatter = comparison.scatter
    if scatter.freedom and scatter.p < CHANCE:
        by = math.sqrt(scatter.value / scatter.freedom)
        said.append(
            f"Beside that they scatter by {by:.1f} times their σ: what is said to have moved is as uncertain as that."
            if comparison.moved
            else f"They scatter by {by:.1f} times their σ, without one instant that would explain it: σ is too small."
        )
    return said


def _same(comparison: Comparison) -> str:
    pairs = [pair for pair in comparison.pairs if pair.compared[TURN].any()]
    apart = max((float(np.nanmax(np.abs(pair.value[TURN]))) for pair in pairs), default=0.0)
    scatter = comparison.scatter
    scattered = scatter.freedom and scatter.p < CHANCE
    begins = "The mounting has moved at no one instant" if scattered else "The same mounting within σ"
    return (
        f"{begins}: {len(comparison.calibrations)} calibrations differ by at most "
        f"{math.degrees(apart):.2f}° about any axis (χ² {scatter.value:.1f} of {scatter.freedom}, p {_p(scatter.p)})."
    )


def _moved(change: Change) -> str:
    """The sentence on a mounting that moved."""
    return f"The mounting has moved {moved_in_words(change.difference)} {_between(change)}."


def _suspicious(change: Change) -> str:
    """The sentence on a mounting that may have moved."""
    often = 1.0 / change.difference.chance(MOUNTING)
    return (
        f"The mounting may have moved {moved_in_words(change.difference)} {_between(change)}; chance makes as much of "
        f"one that did not in 1 of {often:.0f} comparisons. Calibrate once more before you rely on either."
    )


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


def _between(change: Change) -> str:
    before, after = change.last_before, change.first_after
    if before.last_ns > after.first_ns:  # simulated, or stamped from a start of their own
        return f"between {before.name} and {after.name}"
    return f"between {date(before.last_ns)} ({before.name}) and {date(after.first_ns)} ({after.name})"


def date(stamp_ns: int) -> str:
    """A stamp as people read it, UTC."""
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).strftime("%Y-%m-%d %H:%M")
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns * 1e-9:.0f} s"


def _p(p: float) -> str:
    return f"{p:.2f}" if p >= 0.01 else f"{p:.0e}"


def remarks(comparison: Comparison) -> list[str]:
    """What makes the differences worth less than they look, in sentences."""
    found = [f"{each.name}: {remark}" for each in comparison.calibrations for remark in each.remarks]
    models = dict.fromkeys(each.model for each in comparison.calibrations)
    if len(models) > 1:
        found.append(
            f"the models differ ({', '.join(models)}): so may their errors; calibrate all with one model (-p model:=G2)"
        )
    assumed = [each for each in comparison.calibrations if not each.shown[LEVER_ARM].any()]
    known = [each for each in comparison.calibrations if each.shown[LEVER_ARM].any()]
    for each in assumed:
        for other in (*known, *assumed):
            off = np.where(other.shown[LEVER_ARM] | (other not in known), other.lever_arm - each.lever_arm, 0.0)
            if float(np.linalg.norm(off)) > ARM_MATTERS:
                numbers = ", ".join(f"{value:.2f}" for value in other.lever_arm)
                verb = "finds" if other in known else "assumes"
                found.append(
                    f"{each.name} assumes another lever arm than {other.name} {verb}, {numbers} m, and its angles "
                    f"suffer: calibrate it again with -p lever_arm:=[{numbers}]"
                )
                break
    return found


# ------------------------------------------------------------------ plain data


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """`compare --json`: SI units, turns about the body's axes."""
    return {
        "verdict": comparison.word,
        "same_mounting": comparison.same_mounting,
        "says": sentences(comparison),
        "remarks": remarks(comparison),
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
