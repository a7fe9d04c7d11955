"""Which cases a trial has, in an order of which any beginning is a fair part."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from .motion import BOAT, HELD_OUT_KINDS, RECORDED, TUNING_KINDS
from .truth import Category
from .vehicle import ODDITIES, of_one_recording

STRENGTHS = (5.0, 8.0, 12.0, 20.0, 40.0)
PAIR_STRENGTHS = (12.0, 20.0)
UNKNOWN_STRENGTHS = (12.0, 20.0, 40.0)
HARDNESSES = ("ar1", "heavy_tails", "jitter", "gaps", "covariance")
STRAIGHT, ONE_SPEED_BOX = "straight", "one_speed_box"
# Faults that a straight run at one speed hides in the calibration, and such that turns at one speed cannot tell apart
HIDDEN = ("velocity_bias", "quadratic_scale", "mount_flexure", "water_lock", "heading_error", "lever_arm")
ALIKE = ("lever_arm", "sideslip")
KINDS = (*TUNING_KINDS, *HELD_OUT_KINDS)
# What a DVL far from the reference has beside its lever arm, in all combinations: a reference that lags, stamps of one
# of both that are late, stamps that leap once or twice
BESIDE_THE_ARM = ("lag", "late", "leap", "leaps")
# Seen by the vertical alone, or not at all in how the sea trials move
NOT_AT_SEA = ("slow_heave", "roll_rate_surge")
# Keyed apart from the seed of a trial: a longer trial with the same seed has the shorter one in it
_ORDER_SEED = 20261121


class Family(str, Enum):
    """Where the motion of a case is from, and what is recorded of it.

    simulated: manoeuvres of a simulated body, faults of a strength wanted. half_real: motion recorded at sea, faults as
    large as at sea. horizontal: the same, with a reference that does not measure the vertical. several: several
    recordings at sea of one vehicle, each on a day with time offsets of its own. displaced: real motion, of the boat as
    well, a DVL up to 3.5 m from a horizontal reference, with lags, delays and leaps, at 1 to 10 Hz.
    """

    SIMULATED = "simulated"
    HALF_REAL = "half_real"
    HORIZONTAL = "horizontal"
    SEVERAL = "several"
    DISPLACED = "displaced"


@dataclass(frozen=True)
class Case:
    """One case, not drawn yet. name: its fault. q: strength wanted. hardness: what makes a null hard."""

    category: Category
    kind: str
    name: str = ""
    q: float = 0.0
    hardness: str | None = None
    number: int = 0
    family: Family = Family.SIMULATED

    @property
    def key(self) -> str:
        """Says everything about the case, so it stays with the truth."""
        parts = (
            self.family.value,
            self.category.value,
            self.kind,
            self.name,
            f"{self.q:g}",
            self.hardness,
            self.number,
        )
        return "/".join(map(str, parts))

    @property
    def id(self) -> str:
        """Says nothing about the case, so bags can be named by it."""
        return hashlib.sha256(self.key.encode()).hexdigest()[:12]

    @property
    def twin(self) -> Case:
        """Of a case with a horizontal reference, the one that is the same with all axes; else the case itself."""
        return replace(self, family=Family.HALF_REAL) if self.family is Family.HORIZONTAL else self

    def seeds(self, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
        """Random streams of what is drawn and of the noise; twins have the same."""
        sequence = np.random.SeedSequence([seed, *self.twin.key.encode()])
        drawn, noise = sequence.spawn(2)
        return np.random.default_rng(drawn), np.random.default_rng(noise)


def plan(kinds: Sequence[str] = KINDS, families: Sequence[Family] = tuple(Family)) -> list[Case]:
    """Every case of the full trial of these kinds of trajectory and families.

    Families take turns as long as they have cases; what is at sea goes with the kind `RECORDED`.
    """
    wanted = {*kinds, STRAIGHT, ONE_SPEED_BOX, *([BOAT] if RECORDED in kinds else [])}
    half_real = _mixed(
        _nulls_at_sea(), _hard_nulls_at_sea(), _singles_at_sea(), _several_faults_at_sea(), _unknowns_at_sea()
    )
    ordered = {
        Family.SIMULATED: _mixed(
            _nulls(), _hard_nulls(), _singles(), _pairs(), _unknowns(), _unidentifiables()
        ),
        Family.HALF_REAL: half_real,
        Family.HORIZONTAL: [replace(case, family=Family.HORIZONTAL) for case in half_real],
        Family.SEVERAL: _mixed(*_groups()),
        Family.DISPLACED: _mixed(_displaced(RECORDED, 8), _displaced(BOAT, 8), _displaced_nulls()),
    }  # fmt: skip
    turns = [
        (turn, list(Family).index(family), case)
        for family in families
        for turn, case in enumerate(case for case in ordered[family] if case.kind in wanted)
    ]
    return [case for *_, case in sorted(turns, key=lambda each: each[:2])]


def _mixed(*parts: list[Case]) -> list[Case]:
    """Parts in proportion."""
    rng = np.random.default_rng(_ORDER_SEED)
    ranked = []
    for cases in parts:
        order = rng.permutation(len(cases))
        ranked += [((rank + 0.5) / len(cases), cases[index]) for rank, index in enumerate(order)]
    return [case for _, case in sorted(ranked, key=lambda pair: (pair[0], pair[1].key))]


# ------------------------------------------------------------------ simulated


def _nulls() -> list[Case]:
    return [Case(Category.NULL, KINDS[n % len(KINDS)], number=n) for n in range(420)]


def _hard_nulls() -> list[Case]:
    return [
        Case(Category.HARD_NULL, KINDS[n % len(KINDS)], hardness=hardness, number=n)
        for hardness in HARDNESSES
        for n in range(49)
    ]


def _singles() -> list[Case]:
    return [
        Case(Category.SINGLE, kind, name, q, number=n)
        for name in of_one_recording(in_body=False)
        for q in STRENGTHS
        for kind in KINDS
        for n in range(2)
    ]


def _pairs() -> list[Case]:
    return [Case(Category.PAIR, kind, q=q, number=n) for q in PAIR_STRENGTHS for kind in KINDS for n in range(10)]


def _unknowns() -> list[Case]:
    return [
        Case(Category.UNKNOWN, kind, name, q, number=n)
        for name, oddity in ODDITIES.items()
        for q in UNKNOWN_STRENGTHS
        for kind in oddity.kinds
        for n in range(2 if q == UNKNOWN_STRENGTHS[0] else 1)
    ]


def _unidentifiables() -> list[Case]:
    straight = [Case(Category.UNIDENTIFIABLE, STRAIGHT, name, number=n) for name in HIDDEN for n in range(8)]
    one_speed = [
        Case(Category.UNIDENTIFIABLE, ONE_SPEED_BOX, name, 20.0, number=n) for name in ALIKE for n in range(12)
    ]
    return straight + one_speed


# ------------------------------------------------------------------ at sea


def _at_sea(
    category: Category, n: int, name: str = "", q: float = 0.0, family: Family = Family.HALF_REAL
) -> list[Case]:
    return [Case(category, RECORDED, name, q, number=number, family=family) for number in range(n)]


def _nulls_at_sea() -> list[Case]:
    return _at_sea(Category.NULL, 120)


def _hard_nulls_at_sea() -> list[Case]:
    return [replace(case, hardness=hardness) for hardness in HARDNESSES for case in _at_sea(Category.HARD_NULL, 12)]


def _singles_at_sea() -> list[Case]:
    return [case for name in of_one_recording(in_body=False) for case in _at_sea(Category.SINGLE, 6, name)]


def _several_faults_at_sea() -> list[Case]:
    return _at_sea(Category.PAIR, 100) + _at_sea(Category.TRIPLE, 60)


def _unknowns_at_sea() -> list[Case]:
    names = [name for name in ODDITIES if name not in NOT_AT_SEA]
    return [case for name in names for q in UNKNOWN_STRENGTHS for case in _at_sea(Category.UNKNOWN, 4, name, q)]


def _displaced(kind: str, n: int) -> list[Case]:
    """n cases of each combination of what is beside the arm; a clock leaps once or twice, not both."""
    category = {0: Category.SINGLE, 1: Category.PAIR}
    combinations = [
        names
        for size in range(len(BESIDE_THE_ARM))
        for names in itertools.combinations(BESIDE_THE_ARM, size)
        if not {"leap", "leaps"} <= {*names}
    ]
    return [
        Case(category.get(len(names), Category.TRIPLE), kind, "+".join(names), number=number, family=Family.DISPLACED)
        for names in combinations
        for number in range(n)
    ]


def _displaced_nulls() -> list[Case]:
    return [
        Case(Category.NULL, kind, number=number, family=Family.DISPLACED)
        for kind in (RECORDED, BOAT)
        for number in range(10)
    ]


def _groups() -> list[list[Case]]:
    """Nulls; a delay a day; what moved between days; these and what belongs to the vehicle, together."""
    moved, delays = "mounting_moved", "dvl_time_offset"
    return [
        _at_sea(Category.NULL, 30, family=Family.SEVERAL),
        _at_sea(Category.SINGLE, 15, delays, family=Family.SEVERAL),
        _at_sea(Category.SINGLE, 30, moved, family=Family.SEVERAL),
        _at_sea(Category.SINGLE, 15, "lever_arm", family=Family.SEVERAL),
        _at_sea(Category.SINGLE, 10, "sound_speed_moved", family=Family.SEVERAL),
        _at_sea(Category.PAIR, 50, delays, family=Family.SEVERAL),
        _at_sea(Category.PAIR, 20, moved, family=Family.SEVERAL),
        _at_sea(Category.TRIPLE, 40, moved, family=Family.SEVERAL),
    ]
