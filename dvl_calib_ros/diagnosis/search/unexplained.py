"""What is left after the best combination of effects: does it still follow the vehicle's motion, or time?

A dictionary of what a vehicle's error could follow, each with a free vector in the body frame. Noise of the sky does
not know the vehicle's motion, so what follows it is systematic, whatever its cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.distributions import chi2_isf, chi2_logsf
from ...calibration.numerics.frames import Array
from ...calibration.streams.interpolation import shortened
from ...effects.base import Effect
from ...verdict.reasons import Reason, finding
from ..fit.cross_validation import predictive_gain
from ..fit.gauss_newton import Fit, Fitter
from ..fit.parametric_bootstrap import simulated_recordings
from ..fit.selection_criteria import NuisanceFit
from ..model.forward_model import Problem
from ..model.seen import Seen
from ..noise.noise_model import Noise
from .alternative_regressors import ALTERNATIVES, dictionary

LEVEL = 0.001
# Of lines in the spectrum: longer than waves are, and more of them than the dictionary in time has
SHORTEST_PERIOD_S, FEWEST_PERIODS = 16.0, 3.0
# The series whose spectrum is taken has so many steps for each bin at most: memory must not grow with pauses
STEPS_OF_A_BIN = 16
# Standard deviations that were taken off an outlier
OUTLYING = 5.0
# Made-up recordings that tell what is chance, and degrees of freedom of the belief that this is as it should be
MADE_UP, PRIOR_DOF = 12, 4.0
# Of what explains the rest as well, but for a factor of 400 in p, the simplest is named: a step in time beside fifteen
# functions of the turn rate, which turned otherwise after it
AS_LIKELY = 6.0
# A column of which others leave less than this share of its squares is one of their functions
OF_GROUP = 0.02
# Directions of the dictionary that hold less of their length than this beside the others are left out
INDEPENDENT = 1e-3


@dataclass(frozen=True)
class Unexplained:
    """log_p: of the best entry or of all together, adjusted for having looked at all. energy: in units of the noise
    variance, beyond what chance brings. about: what the rest follows, by name, or a period (s). columns: (M, A, f), the
    dictionary; empty if nothing is left, since it would only explain noise. clearest: (M, A, c), those of them that are
    clearest; clear_energy: of these; price: what the best of as many would explain by chance, once in 1 / LEVEL
    recordings.
    """

    log_p: float
    energy: float
    about: str | float
    columns: Array
    clearest: Array
    clear_energy: float = 0.0
    price: float = 0.0

    @property
    def found(self) -> bool:
        """Whether something is left."""
        return self.log_p < np.log(LEVEL)

    @property
    def follows(self) -> Reason:
        """What the rest follows, as it is said."""
        if isinstance(self.about, float):
            return finding("REST_FOLLOWS_PERIOD", seconds=self.about)
        return finding("REST_FOLLOWS", about=self.about)


def unexplained(fitter: Fitter, fit: Fit, asked: float = -np.inf) -> Unexplained:
    """Look for what the residual of a fit still follows.

    What is found is held against made-up recordings: in these nothing but the fit is there. asked: by how much it has
    to be clearer than its price to be of use; where that cannot be, nothing is found, and at once.
    """
    problem, noise = fitter.problem, fit.noise
    looks, white, raw, basis = _looked(fitter, fit, problem, fit.seen, fit.residual)
    nothing = raw["time"][:, :, :0]
    # Noise in the columns keeps a fit from standing where the residual is at right angles to them. Put there, it would
    # follow the vehicle's speed, and have its periods
    left = noise.whiten(fit.residual)
    left = left / np.sqrt(float(left @ left) / (left.size - basis.shape[1]))
    followed = lines(problem, left.reshape(-1, problem.axes))
    tested = len(looks) + len(followed) + noise.is_coloured * (len(raw) - 1)
    if asked > -np.inf:
        most = [(look.energy - look.dof + len(look.at), len(look.at)) for look in looks]
        for line in followed:
            waves = _along_axes(line.waves, problem.axes)
            energy = explained(basis[: left.size, :0], noise.whiten(waves), left, 1.0)[1]
            most.append((energy + waves.shape[2], waves.shape[2]))
        prices = {columns: _price(tested, columns) for columns in {columns for _, columns in most}}
        if max(each - prices[columns] for each, columns in most) < asked:
            return Unexplained(0.0, 0.0, "", nothing, nothing)
    recoloured: list[FollowTest] = []
    if noise.is_coloured:  # what changes with time alone may as well be noise
        beside = NuisanceFit.of_fit(problem, fit)
        alone = _coloured_anew(noise, beside, nothing, fit.residual)
        for name, columns in raw.items():
            if name != "time":
                drop, rank = alone.lowered_by(_coloured_anew(noise, beside, columns, fit.residual))
                recoloured.append(FollowTest(name, np.arange(columns.shape[2]), True, drop, rank))
    looked_at = float(np.log(tested))
    nominal = [
        *(look.log_p() for look in looks),
        *(line.log_p for line in followed),
        *(each.log_p() for each in recoloured),
    ]
    if min(nominal) + looked_at > np.log(LEVEL):
        return Unexplained(min(min(nominal) + looked_at, 0.0), 0.0, "", nothing, nothing)
    grown = _grown(fitter, fit, looks)
    of_group = {look.name: by for look, by in zip(looks, grown, strict=True) if look.is_whole}
    tests: list[tuple[float, str | float, Array]]
    tests = [(look.log_p(by), look.name, raw[look.name][:, :, look.at]) for look, by in zip(looks, grown, strict=True)]
    tests += [(line.log_p, line.period_s, _along_axes(line.waves, problem.axes)) for line in followed]
    recoloured = [replace(each, energy=each.energy / of_group[each.name]) for each in recoloured]
    others: list[tuple[float, str | float, Array]] = []
    for number, each in enumerate(recoloured):
        if each.log_p() + looked_at < np.log(LEVEL):
            recoloured[number] = each = replace(each, energy=each.energy / _chance(fitter, fit, each.name))
        others.append((each.log_p(), each.name, raw[each.name]))
    best = min(tests, key=_first)
    if best[0] + looked_at > np.log(LEVEL):  # else what is left is told by what explains it under one noise
        tests += others
        best = min(tests, key=_first)
    about = _plainest(tests, best[0])
    log_p = min(best[0], *(each[0] for each in others), 0.0) + looked_at
    whole = [(look.energy / by, look.dof) for look, by in zip(looks, grown, strict=True) if look.is_whole]
    energy = max(*(each - dof for each, dof in whole), *(each.energy - each.dof for each in recoloured), 0.0)
    # the best of many lines would always explain some of the noise
    clear = [_along_axes(line.waves, problem.axes) for line in followed if line.log_p < np.log(LEVEL)]
    columns = np.concatenate([*raw.values(), *clear], axis=2)
    clearest = noise.whiten(best[2])
    held_against = (basis[: left.size, :0], clearest, left)
    if not isinstance(best[1], float):
        held_against = (basis, clearest, white)
    clear_energy = explained(*held_against, 1.0)[1]
    clear_energy = (clear_energy + best[2].shape[2]) / of_group.get(str(best[1]), 1.0)
    energy = max(energy, clear_energy - best[2].shape[2])  # a period is of no group
    cost = _price(tested, best[2].shape[2])
    found = Unexplained(min(log_p, 0.0), energy, about[1], columns, best[2], clear_energy, cost)
    return found if found.found else replace(found, columns=nothing, clearest=nothing)


def _price(tested: int, columns: int) -> float:
    """What the best of so many tests of so many columns explains by chance, once in 1 / LEVEL recordings."""
    return float(chi2_isf(LEVEL / tested, columns))


def _plainest(tests: Sequence[tuple[float, str | float, Array]], log_p: float) -> tuple[float, str | float, Array]:
    """Of those about as likely as the best, at log_p, the one with the fewest columns; -inf is as likely as itself."""
    likely = (each for each in tests if each[0] <= log_p + AS_LIKELY)
    return min(likely, key=lambda each: (each[2].shape[2], each[0]))


def _first(each: tuple[float, str | float, Array]) -> float:
    return each[0]


@dataclass(frozen=True)
class FollowTest:
    """One test. name: of the group of functions; at: which of its columns. energy: explained, chi-square of so many
    dof; is_whole: of the whole group.
    """

    name: str
    at: NDArray[np.intp]
    is_whole: bool
    energy: float
    dof: int

    def log_p(self, grown: float = 1.0) -> float:
        """Of the energy, which by chance is larger by a factor."""
        return float(chi2_logsf(self.energy / grown, max(self.dof, 1))) if self.dof else 0.0


def _looked(
    fitter: Fitter, fit: Fit, problem: Problem, seen: Sequence[Seen], residual: Array
) -> tuple[list[FollowTest], Array, dict[str, Array], Array]:
    """All looks at a residual (M, A) of a problem seen through a fit; what it is whitened, of unit variance, beside
    the fit's columns, with the rows of its prior; the columns of every group; and the basis of the fit's.
    """
    noise = fit.noise
    own = replace(fitter, problem=problem).columns(fit.hypothesis, seen)
    known = NuisanceFit.of(problem, fit.hypothesis, seen, own)
    q, white = _beside_prior(known, noise.whiten(known.columns), noise.whiten(residual))
    white = white - q @ (q.T @ white)
    unshown = known.columns.shape[2] - own.shape[2]
    white = white / np.sqrt(float(white @ white) / (residual.size - q.shape[1] + unshown))
    looks: list[FollowTest] = []
    raw: dict[str, Array] = {}
    sound = ~_upset(fitter, noise)[:, None]
    for name, functions in dictionary(problem, seen).items():
        raw[name] = _along_axes(functions * sound, problem.axes)
        told = _Told.by(q, noise.whiten(raw[name]), white)
        for number, at in enumerate(_looks(name, functions.shape[1], problem.axes)):
            looks.append(FollowTest(name, at, number == 0, *told.energy(at)))
    return looks, white, raw, q


def _beside_prior(known: NuisanceFit, columns: Array, white: Array) -> tuple[Array, Array]:
    """Orthonormal basis of the columns (M A, k) of what is known, whitened, and a whitened series (M A,), each with the
    rows of the prior below: k more.

    Without it the scale of a sway that is hardly there, which is noise, would explain that noise.
    """
    basis = orthonormal(np.concatenate([columns, np.diag(1.0 / known.std)]))
    return basis, np.concatenate([white, known.centre / known.std])


def _upset(fitter: Fitter, noise: Noise) -> NDArray[np.bool_]:
    """(M,) bins with an outlier in or beside them: it is in the motion as well that the error is held against."""
    if not isinstance(fitter.outliers, np.ndarray):
        return np.zeros(len(noise.level), dtype=bool)
    far = np.abs(noise.whiten(fitter.outliers)).reshape(noise.level.shape).max(axis=1) > OUTLYING
    return np.asarray(far | np.append(far[1:], False) | np.append(False, far[:-1]))


def _grown(fitter: Fitter, fit: Fit, looks: Sequence[FollowTest]) -> list[float]:
    """By what factor each look's energy is larger than chi-square in made-up recordings, at least 1."""
    energy, dof = np.full(len(looks), PRIOR_DOF), np.full(len(looks), PRIOR_DOF)
    for other, seen, residual in simulated_recordings(fitter.problem, fit, MADE_UP):
        found, *_ = _looked(fitter, fit, other, seen, residual)
        energy += [look.energy for look in found]
        dof += [look.dof for look in found]
    return np.maximum(energy / dof, 1.0).tolist()


@dataclass(frozen=True)
class SpectralLine:
    """The clearest line in the spectrum of one recording. log_p: adjusted for all frequencies looked at, up to a
    factor. waves: (M, 2) cosine and sine, zero in other recordings.
    """

    period_s: float
    log_p: float
    waves: Array


def lines(problem: Problem, innovations: Array) -> list[SpectralLine]:
    """Lines in the innovations (M, A), of unit variance, of each recording that is long enough.

    Noise of the sky has no period, coloured as it may be. Waves have: what is left of them at the pairing of two
    sensors is no finding, so only periods longer than theirs count.
    """
    found = []
    for index, recording in enumerate(problem.recordings):
        at = problem.recording_of == index
        step = SHORTEST_PERIOD_S / 5.0
        time = problem.time
        steps = np.diff(time[at])
        shorter = shortened(steps, STEPS_OF_A_BIN * step * np.count_nonzero(at))
        if shorter is not steps:
            time = time.copy()
            time[at] = time[at][0] + np.append(0.0, np.cumsum(shorter))
        position = ((time[at] - time[at][0]) / step).astype(int)
        sums = np.stack([np.bincount(position, series) for series in innovations[at].T])
        n = 2 * sums.shape[1]  # twice as fine as independent frequencies are
        frequency = np.fft.rfftfreq(n, step)
        power = 2.0 * np.abs(np.fft.rfft(sums, n)) ** 2 / np.count_nonzero(at)  # chi-square of 2 degrees of freedom
        inside = (frequency >= FEWEST_PERIODS / recording.seconds) & (frequency <= 1.0 / SHORTEST_PERIOD_S)
        if not inside.any():
            continue
        log_p = np.vstack([chi2_logsf(power, 2), chi2_logsf(power.sum(axis=0), 2 * innovations.shape[1])])[:, inside]
        best = int(np.argmin(log_p.min(axis=0)))
        period = 1.0 / float(frequency[inside][best])
        phase = 2.0 * np.pi * time / period
        waves = np.where(at[:, None], np.column_stack([np.cos(phase), np.sin(phase)]), 0.0)
        found.append(SpectralLine(period, float(log_p.min() + np.log(log_p.size)), waves))
    return found


def matters(problem: Problem, fit: Fit, rest: Unexplained) -> bool:
    """Return whether what the residual follows predicts held-out data better than slow noise and chance do."""
    return rest.found and holds_out(problem, fit, rest) > rest.price - rest.clearest.shape[2]


def holds_out(problem: Problem, fit: Fit, rest: Unexplained) -> float:
    """Return the held-out deviance gain of what the residual of a fit follows most clearly."""
    known = NuisanceFit.of_fit(problem, fit)
    both = known.and_rest(rest.clearest, fit.residual)
    return predictive_gain(problem, fit.noise, (known, fit.residual), (both, fit.residual))


def moved_by(problem: Problem, fit: Fit, rest: Unexplained) -> Array:
    """(6 + p,) by how much the parameters of a fit move with what the rest follows most clearly fitted beside them."""
    noise, raw, known = fit.noise, rest.clearest, NuisanceFit.of_fit(problem, fit)
    if noise.is_coloured:
        noise = _coloured_anew(noise, known, raw, fit.residual).noise
    both = known.and_rest(raw, fit.residual)
    stands = both._replace(centre=np.zeros_like(both.centre))  # about where the fit stands, whatever its prior
    return stands.step(noise, fit.residual).solution()[: fit.columns.shape[2]]


def is_of_group(problem: Problem, fit: Fit, effects: Sequence[Effect], about: str | float) -> bool:
    """Whether what effects of a fit are to first order, beside its calibration, are functions of one group.

    about: name of the group, or a period, which is none.
    """
    if isinstance(about, float):
        return False
    noise, parameters = fit.noise, fit.hypothesis.parameters()
    own = [6 + at for at, each in enumerate(parameters) if each.effect in effects]
    functions = _along_axes(dictionary(problem, fit.seen)[about], problem.axes)
    calibration = orthonormal(noise.whiten(fit.columns[:, :, :6]))
    asked = noise.whiten(fit.columns[:, :, own])
    asked = asked - calibration @ (calibration.T @ asked)
    group = orthonormal(np.concatenate([calibration, noise.whiten(functions)], axis=1))
    left = asked - group @ (group.T @ asked)
    return bool(((left**2).sum(axis=0) < OF_GROUP * (asked**2).sum(axis=0)).all())


def _chance(fitter: Fitter, fit: Fit, name: str) -> float:
    """By what factor a group of functions lowers the deviance more than chi-square in made-up recordings, as the noise
    that is estimated anew bends to them; at least 1.
    """
    lowered, dof, sound = PRIOR_DOF, PRIOR_DOF, ~_upset(fitter, fit.noise)[:, None]
    for other, seen, residual in simulated_recordings(fitter.problem, fit, MADE_UP // 2):
        columns = replace(fitter, problem=other).columns(fit.hypothesis, seen)
        known = NuisanceFit.of(other, fit.hypothesis, seen, columns)
        raw = _along_axes(dictionary(other, seen)[name] * sound, other.axes)
        alone = _coloured_anew(fit.noise, known, raw[:, :, :0], residual)
        drop, rank = alone.lowered_by(_coloured_anew(fit.noise, known, raw, residual))
        lowered, dof = lowered + drop, dof + rank
    return max(1.0, lowered / dof)


class _Coloured(NamedTuple):
    """deviance: of what columns leave of a residual under noise that is estimated anew from it, else it has their
    colour. rank: of the columns.
    """

    deviance: float
    rank: int
    noise: Noise

    def lowered_by(self, beside: _Coloured) -> tuple[float, int]:
        """By how much further columns lower the deviance, and how many of them are independent."""
        return max(self.deviance - beside.deviance, 0.0), max(beside.rank - self.rank, 1)


def _coloured_anew(noise: Noise, known: NuisanceFit, raw: Array, residual: Array) -> _Coloured:
    """A residual (M, A) under columns (M, A, c) beside known ones, and noise like the given one."""
    joined = np.concatenate([known.columns, raw], axis=2)
    size = np.maximum(np.sqrt((joined**2).mean(axis=(0, 1))), 1e-12)
    joined = joined / size
    std = known.std * size[: len(known.std)]
    held = np.eye(joined.shape[2])[: len(std)] / std[:, None]
    left, colour = residual, noise.white
    for _ in range(2):
        white = colour.whiten(joined)
        rows = np.concatenate([white, held])
        series = np.concatenate([colour.whiten(residual), known.centre / known.std])
        left = residual - joined @ np.linalg.lstsq(rows, series, rcond=INDEPENDENT)[0]
        colour = noise.like(left)
    return _Coloured(colour.deviance(left), orthonormal(white).shape[1], colour)


def _along_axes(functions: Array, axes: int) -> Array:
    """(M, c) -> (M, A, A c): every function on every axis."""
    m, c = functions.shape
    return np.einsum("mc,ij->mijc", functions, np.eye(axes)).reshape(m, axes, axes * c)


def _looks(name: str, c: int, axes: int) -> list[NDArray[np.intp]]:
    """Columns of `_along_axes` that are tested together: all, each axis, and each of those that are alternatives."""
    index = np.arange(axes * c).reshape(axes, c)
    looks = [index.ravel(), *index]
    if name not in ALTERNATIVES:
        return looks
    together = ALTERNATIVES[name]
    return [*looks, *(index[:, at : at + together].ravel() for at in range(0, c, together))]


def orthonormal(white: Array) -> Array:
    """(m, r) basis of whitened columns (m, n), of which some may be zero or alike."""
    lengths = np.linalg.norm(white, axis=0)
    white = white[:, lengths > 0.0] / lengths[lengths > 0.0]
    u, s, _ = np.linalg.svd(white, full_matrices=False)
    return u[:, s > INDEPENDENT]


def explained(q: Array, white_columns: Array, white: Array, variance: float) -> tuple[float, float]:
    """log p of what columns explain of a whitened series, and their energy beyond chance."""
    energy, dof = _Told.by(q, white_columns, white).energy(np.arange(white_columns.shape[1]))
    energy /= variance
    return (float(chi2_logsf(energy, dof)), energy - dof) if dof else (0.0, 0.0)


@dataclass(frozen=True)
class _Told:
    """What columns tell of a whitened series beside those of an orthonormal basis. Both may have further rows, of a
    prior, which says nothing of these columns.

    gram: (c, c) of unit columns less what the basis tells of them. along: (c,) their products with the series. has:
    (c,) whether there is more left of a column than its rounding.
    """

    gram: Array
    along: Array
    has: NDArray[np.bool_]

    @staticmethod
    def by(q: Array, white_columns: Array, white: Array) -> _Told:
        rows = len(white_columns)
        known, square = q[:rows].T @ white_columns, white_columns.T @ white_columns
        left = square - known.T @ known
        before, after = (np.sqrt(np.maximum(np.diag(each), 0.0)) for each in (square, left))
        has = after > 0.02 * np.maximum(before, 1e-300)
        size = np.where(has, after, 1.0)
        along = white_columns.T @ white[:rows] - known.T @ (q.T @ white)
        return _Told(left / np.outer(size, size), along / size, has)

    def energy(self, at: NDArray[np.intp]) -> tuple[float, int]:
        """Square of the series that columns `at` explain together, and of how many dimensions."""
        at = at[self.has[at]]
        if not len(at):
            return 0.0, 0
        squares, directions = np.linalg.eigh(self.gram[np.ix_(at, at)])
        apart = squares > INDEPENDENT**2
        along = directions[:, apart].T @ self.along[at]
        return float(np.sum(along**2 / squares[apart])), int(np.count_nonzero(apart))
