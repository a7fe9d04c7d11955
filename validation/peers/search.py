"""Every set of at most two effects, fitted by nonlinear least squares: what peers (a) and (b) choose from.

Effects that are linear are solved for; a clock's size is looked for on a grid, at which the products of all columns are
kept by part of the run, so that each set costs one small solution and leaps and spells of water lock are sums of parts.
The best sets are then refined by Gauss-Newton. The noise is whitened by a short filter made of what everything together
leaves.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .forward import (
    CLOCKS,
    COLUMNS,
    LARGEST_OFFSET_S,
    LINEAR,
    N_CALIBRATION,
    N_PARTS,
    PLACES,
    Clock,
    Forward,
)
from .streams import Floats

OFFSETS = np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + 0.01, 0.25)
GRIDS: dict[str, Floats] = {
    "dvl_time_offset": OFFSETS,
    "reference_time_offset": OFFSETS,
    "attitude_time_offset": np.arange(-2.0, 2.01, 0.25),
    "reference_lag": np.array([0.05, 0.15, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0]),
    "clock_drift": np.arange(-4.0, 4.01, 0.4),  # s at the end of the run
}
STEPS = {"clock_drift": 0.5, "reference_lag": 0.02}
STEP_S = 0.05
ORDER = 3  # of the whitening filter
N_REFINED = 8
N_CLOCKS_PAIRED = 3
LAST = len(COLUMNS)
ALWAYS = (0, N_PARTS)


@dataclass(frozen=True)
class Member:
    """One effect of a set, and when it is there: parts of the run from and to; of a leap, from."""

    name: str
    spell: tuple[int, int] = ALWAYS

    @property
    def places(self) -> list[int]:
        """Of its columns; a clock has none but its derivative."""
        return PLACES.get(self.name, [])

    @property
    def n_times(self) -> int:
        """How many times of the run it has as parameters."""
        return sum(edge not in (0, N_PARTS) for edge in self.spell)


@dataclass(frozen=True)
class Fitted:
    """A set of effects, fitted. chi2: of the whitened rows. n: rows. values, covariance: of the columns in `names`."""

    members: tuple[Member, ...]
    clock: Clock
    chi2: float
    n: int
    values: Floats = field(default_factory=lambda: np.zeros(0))
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    names: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Names, in order."""
        return tuple(sorted(member.name for member in self.members))

    @property
    def n_parameters(self) -> int:
        """With the times that were looked for."""
        return N_CALIBRATION + sum(max(len(each.places), 1) + each.n_times for each in self.members)

    @property
    def bic(self) -> float:
        """Bayes's information criterion, of a variance that is free."""
        return float(self.n * np.log(self.chi2 / self.n) + self.n_parameters * np.log(self.n))


class Whitening:
    """What makes the noise white: a short filter and a size for each axis."""

    def __init__(self, left: Floats | None = None, n_axes: int = 3) -> None:
        self.taps = np.zeros((n_axes, ORDER))
        self.std = np.ones(n_axes)
        for axis, values in enumerate(left if left is not None else ()):
            lags = np.array([values[k:] @ values[: len(values) - k] for k in range(ORDER + 1)]) / len(values)
            table = lags[np.abs(np.subtract.outer(range(ORDER), range(ORDER)))] + 1e-9 * lags[0] * np.eye(ORDER)
            self.taps[axis] = np.linalg.solve(table, lags[1:])
            self.std[axis] = np.sqrt(max(lags[0] - self.taps[axis] @ lags[1:], 1e-12))

    def __call__(self, rows: Floats) -> Floats:
        """(C, N, k) -> the same, whitened; the first rows, which have none before them, are left out."""
        white = rows[:, ORDER:].copy()
        for k in range(ORDER):
            white -= self.taps[:, k, None, None] * rows[:, ORDER - 1 - k : rows.shape[1] - 1 - k]
        return np.asarray(white / self.std[:, None, None])


@dataclass(frozen=True)
class _Products:
    """Of a point of a grid, (N_PARTS, P + 2, P + 2) by part of the run: columns, difference, the clock's slope."""

    clock: Clock
    by_part: Floats


class Search:
    """All sets of at most `most` effects of a model, at a whitening."""

    def __init__(self, model: Forward, whitening: Whitening | None = None, most: int = 2) -> None:
        self.model, self.most = model, most
        self.whiten = whitening or Whitening(n_axes=model.n_axes)
        self.part = model.part[ORDER:]
        self.n = len(self.part) * model.n_axes
        self._linear = [name for name in model.effects if name in LINEAR]

    def best(self, n: int = N_REFINED) -> list[Fitted]:
        """The calibration alone, and the n best sets, refined, the best first."""
        found = {fitted.effects: fitted for fitted in self.rough()}
        alone = found.pop(())
        ranked = sorted(found.values(), key=lambda fitted: fitted.bic)
        singles = [fitted for fitted in ranked if len(fitted.members) == 1]
        chosen = {fitted.effects: fitted for fitted in [*ranked[:n], *singles[:3]]}
        return sorted([self.refined(alone), *map(self.refined, chosen.values())], key=lambda fitted: fitted.bic)

    # -------------------------------------------------------------- rough

    def rough(self) -> Iterator[Fitted]:
        """The best of each set on the grids; the last of a name is its best."""
        base = self._products(Clock())
        best: dict[tuple[str, ...], Fitted] = {}
        for members in self._linear_sets():
            _keep(best, self._fitted(base.by_part, members, Clock(), None))
        grids = {name: self._grid(name) for name in GRIDS if name in self.model.effects}
        grids["time_offset_jump"] = list(self._leaps(base, grids["dvl_time_offset"]))
        for name, points in grids.items():
            for point, spell in points:
                clock_alone = Member(name, spell)
                others = self._linear if self.most > 1 else []
                for members in [(clock_alone,), *((clock_alone, Member(other)) for other in others)]:
                    _keep(best, self._fitted(point.by_part, members, point.clock, name))
        if self.most > 1:
            for fitted in self._two_clocks(best):
                _keep(best, fitted)
        yield from best.values()

    def _linear_sets(self) -> Iterator[tuple[Member, ...]]:
        yield ()
        spells = [(a, b) for a in range(N_PARTS) for b in range(a + 2, N_PARTS + 1)]
        singles = [[Member(name, s) for s in (spells if name == "water_lock" else [ALWAYS])] for name in self._linear]
        for each in singles:
            yield from ((member,) for member in each)
        if self.most > 1:
            for one, other in itertools.combinations(singles, 2):
                yield from itertools.product(one, other)

    def _grid(self, name: str) -> list[tuple[_Products, tuple[int, int]]]:
        scale = 3600.0 / self.model.seconds if name == "clock_drift" else 1.0
        points = (Clock({name: float(size) * scale}) for size in GRIDS[name])
        return [(self._products(clock, name), ALWAYS) for clock in points]

    def _leaps(
        self, base: _Products, offsets: Sequence[tuple[_Products, tuple[int, int]]]
    ) -> Iterator[tuple[_Products, tuple[int, int]]]:
        """Before a leap the clock is as it is, after it as with an offset: parts of both together."""
        for start in range(1, N_PARTS):
            for point, _ in offsets:
                sums = np.concatenate([base.by_part[:start], point.by_part[start:]])
                clock = Clock({"time_offset_jump": point.clock.size("dvl_time_offset")}, start / N_PARTS)
                yield _Products(clock, sums), (start, N_PARTS)

    def _two_clocks(self, best: dict[tuple[str, ...], Fitted]) -> Iterator[Fitted]:
        """Pairs of clocks, by Gauss-Newton from the better of the two alone."""
        alone = sorted((best[(name,)] for name in CLOCKS if (name,) in best), key=lambda fitted: fitted.bic)
        for one in alone[:N_CLOCKS_PAIRED]:
            for other in alone:
                if other.members[0].name == one.members[0].name or alone.index(other) < alone.index(one):
                    continue
                start = 0.1 if other.effects == ("reference_lag",) else 0.0
                clock = Clock({**one.clock.sizes, other.effects[0]: start}, _leap_at(one, other))
                members = (*one.members, replace(other.members[0]))
                yield self.refined(Fitted(members, clock, np.inf, self.n), n_steps=3)

    def _products(self, clock: Clock, name: str | None = None) -> _Products:
        rows = self.whiten(self.model.at(clock))
        slope = np.zeros((*rows.shape[:2], 1))
        if name is not None:
            step = step_of(name)
            ahead, behind = (self.model.differences(clock.moved(name, by)) for by in (step, -step))
            slope = self.whiten(((behind - ahead) / (2.0 * step))[..., None])
        whole = np.concatenate([rows, slope], axis=2)
        by_part = np.zeros((N_PARTS, LAST + 2, LAST + 2))
        for part in range(N_PARTS):
            here = whole[:, self.part == part]
            by_part[part] = np.einsum("cni,cnj->ij", here, here, optimize=True)
        return _Products(clock, by_part)

    def _fitted(self, by_part: Floats, members: tuple[Member, ...], clock: Clock, name: str | None) -> Fitted:
        total = by_part.sum(axis=0)
        places = list(range(N_CALIBRATION))
        for member in members:
            places += member.places
            if member.spell != ALWAYS and member.places:
                here = by_part[member.spell[0] : member.spell[1]].sum(axis=0)
                total = total.copy()
                total[member.places, :], total[:, member.places] = here[member.places, :], here[:, member.places]
            elif member.spell != ALWAYS:
                here = by_part[member.spell[0] :].sum(axis=0)
                total = total.copy()
                total[LAST + 1, :], total[:, LAST + 1] = here[LAST + 1, :], here[:, LAST + 1]
        if name is not None:
            places.append(LAST + 1)
        return Fitted(members, clock, _left(total, places), self.n)

    # -------------------------------------------------------------- fine

    def refined(self, fitted: Fitted, n_steps: int = 4) -> Fitted:
        """The set by Gauss-Newton in its clocks; its values and their covariance."""
        clocks = [member.name for member in fitted.members if member.name in CLOCKS]
        clock, result = fitted.clock, fitted
        for _ in range(n_steps if clocks else 1):
            result = self._solved(fitted.members, clock, clocks)
            moves = result.values[len(result.values) - len(clocks) :]
            for name, move in zip(clocks, moves.tolist(), strict=True):
                limit = 0.5 * step_of(name) / STEP_S
                clock = clock.moved(name, float(np.clip(move, -limit, limit)))
                if name == "reference_lag":
                    clock = replace(clock, sizes={**clock.sizes, name: max(clock.size(name), 0.02)})
        return result

    def rows_of(self, members: Sequence[Member], clock: Clock, values: Floats | None = None) -> Floats:
        """(C, N, k + 1): not whitened columns of a set, the slopes of its clocks and, last, the difference."""
        rows = self.model.at(clock)
        parts = [rows[..., :N_CALIBRATION]]
        for member in members:
            there = (self.model.part >= member.spell[0]) & (self.model.part < member.spell[1])
            parts.append(rows[..., member.places] * (there[:, None] if member.places else 1.0))
        linear = np.concatenate(parts, axis=2)
        for member in members:
            if member.name in CLOCKS:
                parts.append(self._slope(members, clock, member.name, values, linear.shape[2]))
        return np.concatenate([*parts, rows[..., LAST:]], axis=2)

    def _slope(
        self, members: Sequence[Member], clock: Clock, name: str, values: Floats | None, n_linear: int
    ) -> Floats:
        """(C, N, 1): how what the set predicts changes with a clock."""
        step = step_of(name)
        sides = []
        for by in (step, -step):
            if values is None:
                sides.append(self.model.differences(clock.moved(name, by)))
                continue
            linear = [member for member in members if member.name not in CLOCKS]
            rows = self.rows_of(linear, clock.moved(name, by))
            sides.append(rows[..., -1] - rows[..., :-1] @ values[:n_linear])
        return np.asarray((sides[1] - sides[0])[..., None] / (2.0 * step))

    def _solved(self, members: tuple[Member, ...], clock: Clock, clocks: Sequence[str]) -> Fitted:
        values: Floats | None = None
        for _ in range(2 if clocks and len(members) > len(clocks) else 1):
            white = self.whiten(self.rows_of(members, clock, values))
            flat = white.reshape(-1, white.shape[2])
            solution, covariance, chi2 = solved(flat[:, :-1], flat[:, -1])
            values = solution
        names = [f"{each.name}.{p}" for each in members for p in LINEAR.get(each.name, ())]
        names = [*COLUMNS[:N_CALIBRATION], *names, *(f"{name}.{CLOCKS[name]}" for name in clocks)]
        assert values is not None
        return Fitted(members, clock, chi2, self.n, values, covariance, tuple(names))


def step_of(name: str) -> float:
    """By how much a clock is moved for its slope."""
    return STEPS.get(name, STEP_S)


def sizes_of(fitted: Fitted) -> dict[str, tuple[float, float]]:
    """Column -> value and standard deviation, with the noise as large as it was left; clocks with their step taken."""
    std = np.sqrt(np.maximum(np.diag(fitted.covariance) * fitted.chi2 / fitted.n, 0.0))
    found = {}
    for name, value, each in zip(fitted.names, fitted.values.tolist(), std.tolist(), strict=True):
        effect = name.split(".")[0]
        found[name] = (value + (fitted.clock.size(effect) if effect in CLOCKS else 0.0), each)
    return found


def solved(columns: Floats, wanted: Floats) -> tuple[Floats, Floats, float]:
    """Least squares: values, their covariance at unit noise, and the sum of squares left."""
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    inverse = np.linalg.pinv((columns / scale).T @ (columns / scale), rcond=1e-10, hermitian=True)
    values = inverse @ ((columns / scale).T @ wanted) / scale
    left = wanted - columns @ values
    return values, inverse / np.outer(scale, scale), float(left @ left)


def _left(products: Floats, places: list[int]) -> float:
    """Sum of squares that columns leave of the difference."""
    table, right = products[np.ix_(places, places)], products[places, LAST]
    scale = np.sqrt(np.maximum(np.diag(table), 1e-20))
    table = table / np.outer(scale, scale) + 1e-9 * np.eye(len(places))
    explained = (right / scale) @ np.linalg.solve(table, right / scale)
    return float(max(products[LAST, LAST] - explained, 1e-9 * products[LAST, LAST] + 1e-30))


def _keep(best: dict[tuple[str, ...], Fitted], fitted: Fitted) -> None:
    known = best.get(fitted.effects)
    if known is None or fitted.bic < known.bic:
        best[fitted.effects] = fitted


def _leap_at(*fitted: Fitted) -> float:
    return next((each.clock.leap_at for each in fitted if each.effects == ("time_offset_jump",)), 0.5)


def residual_of_all(model: Forward, clock: Clock, members: Iterable[Member] = ()) -> Floats:
    """(C, N) what everything, also what is no effect, leaves at a clock; as large as if nothing had been fitted."""
    rows = model.at(clock, generic=True)
    columns = rows[..., :-1]
    for member in members:
        if member.spell != ALWAYS and member.places:
            there = (model.part >= member.spell[0]) & (model.part < member.spell[1])
            columns = np.concatenate([columns, rows[..., member.places] * there[:, None]], axis=2)
    flat, wanted = columns.reshape(-1, columns.shape[2]), rows[..., -1].ravel()
    weight: NDArray[np.float64] = np.ones(rows.shape[0])
    for _ in range(2):
        w = np.repeat(1.0 / weight, rows.shape[1])
        values, _, _ = solved(flat * w[:, None], wanted * w)
        left = (wanted - flat @ values).reshape(rows.shape[:2])
        weight = left.std(axis=1) + 1e-9
    return left * np.sqrt(wanted.size / (wanted.size - columns.shape[2]))
