"""Comparison by effect: its size on both sides, the significance of the difference, and its location.

All effects found on either side are fitted to both, jointly. So the other side also gets an interval, which is wide if
its motions do not make the effect observable. Each side keeps its own form of an effect: one or two clock steps, or a
lever arm without its unobservable part. Sizes are compared by Wald's test with the covariance from the scatter between
blocks of time on each side.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution
from scipy.stats import norm, t

from ..calibration.numerics.frames import Array
from ..diagnosis.answer.gap_location import BANDS_HZ, regimes
from ..diagnosis.fit.gauss_newton import Fit
from ..diagnosis.fit.selection_criteria import blocks_of
from ..diagnosis.model.hypothesis import Values, amplitudes, whose_parameters
from ..diagnosis.search.arm_clock_ambiguity import ATTITUDE_CLOCK, CLOCKS
from ..diagnosis.search.effect_selection import EffectSelection
from ..diagnosis.search.observable_parameters import default_values
from ..effects.base import Effect
from ..effects.registry import EFFECTS
from .both_sides import Log
from .results import Lies, Triple

# an effect not found on a side is still present there if it is significant at this level ...
THERE = 1e-3
# ... and at least this share of the other side's; less may be due to interpolation and noise in the regressors
WORTH_IT = 0.1
# a regime is named if it has at least this share of an effect, and this multiple of its share of the time
MOST, DENSER = 0.4, 1.2
# number of calibration parameters fitted jointly; smallest degrees of freedom of an interval
CALIBRATION, FEWEST_DOF = 6, 4


@dataclass(frozen=True)
class Size:
    """An effect's size on one side. values: (p,) its linear parameters, averaged over recordings if they differ.

    stacked: (r, p) of each recording that has its own, else (1, p), with covariance (r p, r p).
    dof: of that covariance.
    found: the side's own diagnosis named it.
    recordings: names of those with their own size, none if they share it.
    """

    effect: Effect
    stacked: Array
    covariance: Array
    dof: int
    found: bool
    recordings: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Return the names of the parameters."""
        return [spec.name for spec in amplitudes(self.effect)]

    def taking(self, names: Sequence[str]) -> Array:
        """Return the matrix (q, p) that maps its parameters to other names; missing ones become 0."""
        return np.array([[float(name == name_kept) for name_kept in self.names] for name in names])

    @property
    def mean(self) -> tuple[Array, Array]:
        """Return the weighted mean (p,) over recordings and its covariance (p, p)."""
        r, p = self.stacked.shape
        design = np.tile(np.eye(p), (r, 1))
        weight = np.linalg.inv(self.covariance)
        covariance = np.linalg.inv(design.T @ weight @ design)
        return covariance @ design.T @ weight @ self.stacked.ravel(), np.asarray(covariance)

    def intervals(self) -> dict[str, Triple]:
        """Return 95 per cent intervals by name, and by recording if they differ."""
        # the covariance is estimated from this number of blocks, which also determine the calibration
        dof = max(self.dof - CALIBRATION - len(self.covariance), FEWEST_DOF)
        half_width = t.ppf(0.975, dof) * np.sqrt(np.diag(self.covariance))
        suffixes = [f" of {name}" for name in self.recordings] or [""]
        names = [f"{name}{suffix}" for suffix in suffixes for name in self.names]
        return {
            name: (float(value), float(value - half), float(value + half))
            for name, value, half in zip(names, self.stacked.ravel(), half_width, strict=True)
        }

    def p_absent(self) -> float:
        """Return the p-value of its absence."""
        defaults = np.array([spec.default for spec in amplitudes(self.effect)])
        return _wald(self.stacked.ravel() - np.tile(defaults, len(self.stacked)), self.covariance, self.dof)


def compared_names(vehicle: Size, simulator: Size) -> list[str]:
    """Return the names of parameters on both sides and, for an effect found on both, of a second occurrence.

    A side without the second occurrence has 0 for it.
    """
    own = [*dict.fromkeys([*vehicle.names, *simulator.names])]
    second_occurrence = vehicle.effect.again if vehicle.found and simulator.found else ()
    return [name for name in own if name in second_occurrence or (name in vehicle.names and name in simulator.names)]


def p_alike(vehicle: Size, simulator: Size) -> float:
    """Return the p-value of equal sizes on both sides; with sizes per recording, of each equalling the simulator's."""
    names = compared_names(vehicle, simulator)
    mean, covariance = simulator.mean
    n = len(vehicle.stacked)
    to_names, design = np.kron(np.eye(n), vehicle.taking(names)), np.tile(simulator.taking(names), (n, 1))
    difference = to_names @ vehicle.stacked.ravel() - design @ mean
    covariance = to_names @ vehicle.covariance @ to_names.T + design @ covariance @ design.T
    return _wald(difference, covariance, min(vehicle.dof, simulator.dof))


def _wald(values: Array, covariance: Array, dof: int) -> float:
    p = len(values)
    statistic = float(values @ np.linalg.solve(covariance, values)) / p
    return float(f_distribution.sf(statistic, p, max(dof - p, 2)))


def is_there(size: Size, against_size: Size) -> bool:
    """Return whether a side has an effect: found there, or significant and not small against the other side's."""
    if size.found:
        return True
    value, against = size.mean[0], against_size.mean[0]
    worth_it = float(np.linalg.norm(value)) > WORTH_IT * float(np.linalg.norm(against))
    return worth_it and size.p_absent() < THERE


def smallest_difference(vehicle: Size, simulator: Size, n_claims: int) -> dict[str, float]:
    """Return the difference of each parameter detected in four of five recordings, for this number of claims."""
    names = compared_names(vehicle, simulator)
    std = np.sqrt(sum(side.taking(names) @ np.diag(side.mean[1]) for side in (vehicle, simulator)))
    factor = float(norm.isf(0.005 / max(n_claims, 1)) + norm.ppf(0.8))
    return {name: factor * float(s) for name, s in zip(names, std, strict=True)}


def common_names(vehicle: Log, simulator: Log) -> tuple[dict[str, str], dict[str, str]]:
    """Return per side the names found -> the name under which they are compared.

    An effect that one side cannot distinguish from one found on the other side gets that name.
    """
    equals = [{effect.name: effect.equivalent_to for effect in log.diagnosis.effects} for log in (vehicle, simulator)]
    names: list[dict[str, str]] = [{name: name for name in side} for side in equals]
    for own, other_side in ((0, 1), (1, 0)):
        for name, equivalent in equals[own].items():
            if name in equals[other_side] or names[own][name] != name:
                continue
            shared = [other for other in equivalent if other in equals[other_side] and other not in equals[own]]
            if shared:
                names[own][name] = shared[0]
    return names[0], names[1]


def union(vehicle: Mapping[str, str], simulator: Mapping[str, str]) -> list[str]:
    """Return the names to compare. Of three clocks only two differences are observable, so the third is omitted."""
    names = {*vehicle.values(), *simulator.values()}
    if set(CLOCKS) <= names:
        names.discard(ATTITUDE_CLOCK)
    return [name for name in EFFECTS if name in names] + sorted(names - set(EFFECTS))


def fitted(selection: EffectSelection, names: Sequence[str]) -> Fit:
    """Fit all testable effects of these names jointly: in the form found, else in the form of the search."""
    fitter, fit = selection.fitter, selection.fit
    found = {effect.name: effect for effect in fit.effects}
    known = {**selection.testable, **found}
    chosen = [known[name] for name in names if name in known]
    start: dict[str, tuple[Values, ...]] = {
        effect.name: tuple(default_values(effect, fitter.problem)) for effect in chosen if effect.name not in found
    }
    return fitter.fit(fit.hypothesis.with_effects(chosen, fit.n_recordings, start), fit.noise)


def sizes(selection: EffectSelection, fit: Fit, found_names: Sequence[str]) -> dict[str, Size]:
    """Return every effect of a fit by name. found_names: effects named by the diagnosis of this side."""
    block = blocks_of(selection.fitter.problem)
    covariance = fit.covariance(block)
    dof = int(block.max()) + 1
    vector = fit.hypothesis.vector()
    n_all = fit.n_recordings
    result, first = {}, 6
    for effect in fit.effects:
        owners = whose_parameters(effect, n_all)
        n_parameters, n_recordings = len(amplitudes(effect)), len(owners)
        part = slice(first, first + n_parameters * n_recordings)
        first += n_parameters * n_recordings
        if not n_parameters:  # no part is observable
            continue
        stacked = vector[part].reshape(n_recordings, n_parameters)
        recordings = tuple(selection.fitter.problem.recordings[i].name for i in owners if i is not None)
        result[effect.name] = Size(effect, stacked, covariance[part, part], dof, effect.name in found_names, recordings)
    return result


def trace_of(selection: EffectSelection, fit: Fit, effect: Effect) -> Array:
    """Return the residual (M, A) m/s that an effect adds, without the part that other parameters can absorb.

    M: bins of time. A: compared axes.
    """
    others = [other for other in fit.effects if other is not effect]
    without = selection.fitter.fit(fit.hypothesis.with_effects(others, fit.n_recordings, {}), fit.noise, 4)
    return without.residual - fit.residual


def location_of(selection: EffectSelection, fit: Fit, trace: Array) -> Lies:
    """Return the axis, regime of motion and frequency band with most energy of a trace (M, A) m/s.

    A regime is named by its energy per time, compared with the whole run.
    """
    problem = selection.fitter.problem
    energy = trace**2
    total = max(float(energy.sum()), 1e-300)
    names = [name for name, measured in zip("xyz", problem.measured, strict=True) if measured]
    axis = int(np.argmax(energy.sum(axis=0)))
    regime, share, densest = "all", 1.0, DENSER
    for name, mask in regimes(problem, fit.seen).items():
        regime_share = float(energy[mask].sum()) / total
        density = regime_share / float(mask.mean())
        if regime_share > MOST and density > densest:
            regime, share, densest = name, regime_share, density
    nyquist = 0.5 / problem.interval
    power = (np.abs(np.fft.rfft(trace, axis=0)) ** 2).sum(axis=1)
    frequency = np.linspace(0.0, nyquist, len(power))
    bands = [(low, high) for low, high in itertools.pairwise(BANDS_HZ) if low < nyquist]
    powers = [power[(frequency >= low) & (frequency < high)].sum() for low, high in bands]
    strongest = int(np.argmax(powers))
    low, high = bands[strongest]
    return Lies(
        names[axis], float(energy[:, axis].sum()) / total, regime, share, (float(low), float(min(high, nyquist))),
        float(powers[strongest] / max(power.sum(), 1e-300)),
    )  # fmt: skip
