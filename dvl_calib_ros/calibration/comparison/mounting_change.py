"""Calibrations of one DVL compared: what differs by more than its σ, and between which of them it changed.

Every calibration is an estimate with a covariance, of other data than the others'. The difference of two has the sum of
their covariances; d'S⁻¹d of it is chi-square distributed if nothing changed. Of a series in time the instant is looked
for that parts it best into before and after, then within either part ("binary segmentation"; Scott and Knott, "A
cluster analysis method for grouping means in the analysis of variance", 1974).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...verdict.answering import Answering
from ...verdict.kinds import Severity
from ..numerics.frames import Array, rotation_of, rotation_vector
from ..numerics.tests import chi2_sf
from ..results.extrinsics import (
    GROUPS,
    LEVER_ARM,
    MOUNTING,
    N_AXES,
    N_COMPONENTS,
    ONLY_CLOCK,
    ONLY_SCALE,
    SCALE,
    TIME_OFFSET,
    TURN,
    Extrinsics,
)

# A difference that chance brings more seldom than this is none of chance, over all that is looked at together.
CHANCE = 0.01
# Of a mounting: as seldom as a normal error is beyond 4 σ it has moved, beyond 2 σ that is suspicious.
MOVED, SUSPICIOUS = chi2_sf(16.0, 1), chi2_sf(4.0, 1)

_ALL = np.arange(N_COMPONENTS)


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
        (value,) = _values([second], first) - _values([first], first)
        compared = first.shown & second.shown
        both = first.covariance + second.covariance
        if first.dvl and first.dvl == second.dvl:
            common = first.by_bias @ second.by_bias.T
            both = both - common - common.T
        covariance = np.where(np.outer(compared, compared), both, 0.0)
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

    def chance(self, components: NDArray[np.intp] = _ALL, together: ChiSquare | None = None) -> float:
        """How often chance makes as much of some components: of all together, or of the one that stands out most.

        Both, as one angle that moved is little among five that did not; by Bonferroni. 1 if there are none.
        together: their `test`, where that is known.
        """
        at = components[self.compared[components]]
        if not len(at):
            return 1.0
        p = (together or self.test(at)).p
        if len(at) == 1:
            return p
        one = chi2_sf(float(((self.value / self.std)[at] ** 2).max()), 1)
        return min(1.0, 2.0 * min(p, len(at) * one))


@dataclass(frozen=True)
class Change:
    """Between two neighbours in time. before, after: all up to the next change, taken together, whose difference it is.
    last_before, first_after: the neighbours."""

    difference: Difference
    last_before: Extrinsics
    first_after: Extrinsics


class ComparisonAnswer(NamedTuple):
    """What comes of a comparison's word. severity: as of a verdict, which colours it. exit_code: of the command."""

    severity: Severity
    exit_code: int


ANSWERS = {
    "same": ComparisonAnswer(Severity.ACCEPT, 0),
    "suspicious": ComparisonAnswer(Severity.MARGINAL, 3),
    "moved": ComparisonAnswer(Severity.REJECT, 1),
}


@dataclass(frozen=True, repr=False)
class Comparison(Answering):
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
    def answer(self) -> ComparisonAnswer:
        """What comes of the word."""
        return ANSWERS[self.word]

    @property
    def contradicting(self) -> tuple[Change, ...]:
        """Changes of the mounting by which one average of all is the mounting of none: by a limit of its own, as an
        average of two mountings does more harm than a warning."""
        surely = CHANCE / (len(self.calibrations) - 1)
        return tuple(each for each in (*self.moved, *self.suspicious) if each.difference.chance(MOUNTING) < surely)

    @property
    def same_mounting(self) -> bool:
        """Whether nothing says that the mounting moved, nor makes it suspicious."""
        return self.word == "same"


def contradicts(found: Extrinsics, initial: Extrinsics) -> Difference | None:
    """What takes an initial calibration to one of other data, where that is no chance; None where they agree."""
    if not (initial.shown[MOUNTING] & found.shown[MOUNTING]).any():
        return None
    difference = Difference.between(initial, found)
    return difference if difference.chance(MOUNTING) < CHANCE else None


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
    day to day, and what is forced to be common where it is not would bend the others. The bias of one DVL is common to
    all, so it does not average out: it is a state beside the others, and what is left of it is left in the result.
    """
    if len(several) == 1:
        return several[0]
    base = several[0]
    if any(not each.dvl or each.dvl != base.dvl for each in several):
        several = [replace(each, dvl="", by_bias=np.zeros_like(each.by_bias)) for each in several]
    shown = np.any([each.shown for each in several], axis=0)
    found, by_bias = np.zeros(N_COMPONENTS), np.zeros((N_COMPONENTS, N_AXES))
    of_groups: list[Array] = []
    values = _values(several, base)
    own, columns = (np.array([getattr(each, name) for each in several]) for name in ("information", "by_bias"))
    information, vector = own.sum(axis=0), np.einsum("nij,nj->i", own, values)
    turned = own @ columns
    groups = [group[shown[group]] for group in GROUPS]
    for index in groups:
        # with a bias of σ 1 as a state beside them
        across = turned[:, index].sum(axis=0)
        of_bias = np.eye(N_AXES) + np.einsum("nia,nib->ab", columns[:, index], turned[:, index])
        of_vector = np.einsum("nia,ni->a", turned[:, index], values[:, index])
        share = across @ np.linalg.inv(of_bias)
        p = np.linalg.inv(information[np.ix_(index, index)] - share @ across.T)
        found[index], by_bias[index] = p @ (vector[index] - share @ of_vector), p @ share
        of_groups.append(p)
    covariance = by_bias @ by_bias.T
    for index, p in zip(groups, of_groups, strict=True):
        covariance[np.ix_(index, index)] = p
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
        dvl=several[0].dvl,
        by_bias=by_bias,
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


def _values(several: Sequence[Extrinsics], base: Extrinsics) -> Array:
    """(N, 8) components, the turn being that from the mounting of `base`."""
    values = np.array([each.components for each in several])
    x, y, z, w = base.components[:4].tolist()
    # quaternions times the conjugate of that of base
    back = np.array([[w, -z, y, -x], [z, w, -x, -y], [-y, x, w, -z], [x, y, z, w]])
    return np.concatenate([rotation_vector(values[:, :4] @ back.T), values[:, 4:]], axis=1)


def _changes(
    series: list[Extrinsics], components: NDArray[np.intp], chance: float, together: _Together
) -> list[Change]:
    """Where some components of a series in time change, in order of time."""
    best, at = None, 0
    for k in range(1, len(series)):
        difference = Difference.between(together(series[:k]), together(series[k:]))
        # by how surprising it is: where few components are compared, a smaller sum is as much. Beyond what a double
        # holds as a probability the sum itself decides
        test = difference.test(components)
        surprise = difference.chance(components, test), -test.value
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
