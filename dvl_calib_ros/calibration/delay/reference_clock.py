"""Which clock is late: the DVL's, the reference's, or the IMU's. G2 takes it to be the DVL's.

Where the reference is stamped ρ late and the DVL τ late, velocities agree at stamps δ = τ - ρ apart, and that is what
G2 finds. Attitude and angular velocity belong to the reference's own time, ρ before its stamp: in a turn of ω at speed
u the wrong one turns its velocity by ω ρ, which a lever arm of ρ u explains almost as well. When turns begin and end
tells them apart. So at a row of ρ, and of δ about what G2 finds, samples are compared by least squares each; horizontal
only, so nothing is assumed of heave.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..frames import Array, cross, skew
from ..parameters import Parameters
from ..time_blocks import FEWEST, TimeBlocks
from .local_motion import local_fit, reach_at, spacing_at
from .parts import Parts, places
from .rows import (
    LEAST_SLOPE_REACH_S,
    MOST_REACH_S,
    DvlColumns,
    ImuColumns,
    ReferenceColumns,
    TurnRates,
    angular_velocity_at,
    attitude_at,
    joined,
)

# Evidence over ρ is a parabola as long as that is short beside a turn's beginning.
LATE_S: Array = 0.4 * np.arange(-3, 4)
ON_TIME = 3
# δ shifts by half as much as ρ, and each is linear in what it is more.
ABOUT_S: Array = np.array([-0.4, 0.0, 0.4])
CELL_STD_S = 0.3
# G2's delay may move so far about what this one began with.
MOVED_S = 0.5
# References closer together than this tell no more of a clock.
EVERY_S = 0.35
# Said from here on: a lever arm is then a tenth of a second times the speed off, and interpolated attitudes and filters
# of an inertial navigation are late by less (five real recordings: 0.03 to 0.07 s).
SAID_FROM_S = 0.1
# Gain in log evidence, tempered by what blocks of time show, from which it is said: three σ.
SAID_FROM_EVIDENCE = 4.5
# By how much noise that lasts may raise σ, where there are too few blocks to say.
UNKNOWN_INFLATION = 3.0
# A clock that is less off than this is right, as far as what is said goes.
RIGHT_S = 0.1
# dM (2, 3), lever arm (3), δ beyond the hypothesis' own, constant error of the reference (2).
_N = 12
_ARM, _DELAY, _OFFSET = slice(6, 9), 9, slice(10, 12)
_SHOWS = [6, 7, 9]


class LateClocks(NamedTuple):
    """By how much the stamps of reference and DVL are late beside the IMU's, s, beyond what the parameters say.

    dvl_std: of the DVL's. at_least: whether the reference's is more than was looked for.
    """

    reference: float
    dvl: float
    dvl_std: float
    at_least: bool

    def says(self, parameters: Parameters) -> str:
        """What configuration would fit, in words: of one clock that is wrong, if that can be."""
        late, p = self.reference, parameters
        of_reference = f"reference_time_offset: {round(p.reference_time_offset + late, 2):g}"
        of_imu = f"imu_time_offset: {round(p.imu_time_offset - late, 2):g}"
        if self.at_least:
            return (
                f"the data fit a reference whose stamps are {_late(late, 1)} or more (look again with {of_reference})"
            )
        doubt = max(RIGHT_S, 2.0 * self.dvl_std)
        is_reference, is_imu = abs(self.dvl) < doubt, abs(self.dvl - late) < doubt
        if is_reference and is_imu:
            return (
                f"the data fit stamps of the reference that are {_late(late)}, or of the IMU that are {_late(-late)} "
                f"({of_reference}, or {of_imu})"
            )
        if is_imu:
            return f"the data fit an IMU whose stamps are {_late(-late)} ({of_imu})"
        dvl = "that is in time" if is_reference else f"whose stamps are {_late(self.dvl)}"
        return f"the data fit a reference whose stamps are {_late(late)}, and a DVL {dvl} ({of_reference})"


def _late(seconds: float, digits: int = 2) -> str:
    return f"{abs(seconds):.{digits}f} s {'late' if seconds > 0.0 else 'early'}"


class ClockBlock(NamedTuple):
    """Of a block of time the references that are no outliers, and what the other streams hold about it.

    noise_dvl: (3, 3) (m/s)². delay: s, that G2 finds likeliest.
    """

    dvl: DvlColumns
    reference: ReferenceColumns
    imu: ImuColumns
    turns: TurnRates
    noise_dvl: Array
    delay: float


class ReferenceClock:
    """Sums of least squares at each ρ and δ, from the blocks since G2's delay last changed; constant memory."""

    def __init__(self, parameters: Parameters) -> None:
        self._p = parameters
        std = np.full(_N, parameters.initial_std_misalignment)
        std[[0, 4]] = parameters.initial_std_scale
        std[_ARM], std[_DELAY], std[_OFFSET] = (
            parameters.initial_std_lever_arm, CELL_STD_S, parameters.reference_offset_std,
        )  # fmt: skip
        self._prior = np.diag(std**-2.0)
        self.start()

    def start(self) -> None:
        """Start anew."""
        shape = len(LATE_S), len(ABOUT_S)
        self._around: float | None = None
        self._information = np.broadcast_to(self._prior, (*shape, _N, _N)).copy()
        self._vector = np.zeros((*shape, _N))
        self._square = np.zeros(shape)
        self._blocks = TimeBlocks()

    def add(self, blocks: Sequence[ClockBlock]) -> None:
        """Take the references of some blocks, in order, that are no outliers."""
        together: list[ClockBlock] = []
        for block in blocks:
            if self._around is None or abs(block.delay - self._around) > MOVED_S:
                self._add(together)
                together = []
                self.start()
                self._around = block.delay
            if len(block.reference.times) >= 2:
                together.append(block)
        self._add(together)

    def _add(self, blocks: Sequence[ClockBlock]) -> None:
        """Take blocks with G2's delay about the same."""
        if not blocks:
            return
        assert self._around is not None
        thinned = [_thinned(block.reference) for block in blocks]
        reference, parts = joined(thinned), Parts.of([each.times for each in thinned])
        times, block, n = reference.times, parts.number, len(reference.times)
        dvl, dvl_parts = joined([each.dvl for each in blocks]), Parts.of([each.dvl.times for each in blocks])
        imu, imu_parts = joined([each.imu for each in blocks]), Parts.of([each.imu.times for each in blocks])
        spacing = spacing_at(dvl.times, times, places(dvl.times, times, dvl_parts, parts))
        reach = np.clip(reach_at(spacing, LEAST_SLOPE_REACH_S, MOST_REACH_S), LEAST_SLOPE_REACH_S, None)
        at = (times[:, None] + (self._around + ABOUT_S)).ravel()
        place = places(dvl.times, at, dvl_parts, Parts(len(ABOUT_S) * parts.bounds))
        fit = local_fit(dvl.times, dvl.velocity, at, np.repeat(reach, len(ABOUT_S)), place)
        body_from_dvl = self._p.rotation_dvl_from_body.T
        measured, slope = (
            (each @ body_from_dvl.T).reshape(n, len(ABOUT_S), 3).swapaxes(0, 1) for each in (fit.value, fit.slope)
        )
        own, own_parts = (times[:, None] - LATE_S).ravel(), Parts(len(LATE_S) * parts.bounds)
        rotation, oriented = attitude_at(imu, own, self._p.imu_timeout, imu_parts, own_parts)
        turns = TurnRates.joined([each.turns for each in blocks])
        rates = angular_velocity_at(turns, own, self._p.imu_timeout, own_parts)[0].reshape(n, -1, 3).swapaxes(0, 1)
        to_body = rotation.reshape(n, -1, 3, 3).transpose(1, 0, 3, 2)
        to_body = np.where(reference.in_body[:, None, None], np.eye(3), to_body)
        body = np.matmul(to_body, reference.velocity[..., None])[..., 0] + cross(rates, np.array(self._p.lever_arm))
        known = fit.found.reshape(n, -1).all(axis=1)
        known &= oriented.reshape(n, -1).all(axis=1) | reference.in_body
        known &= ~np.isnan(rates).any(axis=(0, 2)) & ((measured[1] ** 2).sum(axis=1) >= self._p.min_speed**2)
        noise_dvl = np.array([np.trace(each.noise_dvl) for each in blocks])
        added = np.where(reference.claimed, noise_dvl[block] / 3.0, 0.0)
        # the vertical may not be measured
        horizontal = np.sort(np.diagonal(reference.noise, axis1=1, axis2=2), axis=1)[:, :2]
        interval = np.minimum(np.diff(times, prepend=times[:1] - EVERY_S), spacing)
        begins = parts.bounds[:-1]
        interval[begins] = np.minimum(EVERY_S, spacing[begins])
        weight = interval / spacing / (horizontal.mean(axis=1) + added)
        of_earth = to_body * ~reference.in_body[:, None, None]
        for own_at in parts:
            use = own_at.start + np.flatnonzero(known[own_at])
            if len(use):
                some = [each[:, use] for each in (measured, slope, body, rates, of_earth)]
                self._sum(some[0], some[1], some[2], some[3], some[4], weight[use])

    def _sum(self, measured: Array, slope: Array, body: Array, rates: Array, to_body: Array, weight: Array) -> None:
        """measured, slope: (D, J, 3). body, rates: (R, J, 3). to_body: (R, J, 3, 3). weight: (J,)."""
        n_late, n_about, n = len(LATE_S), len(ABOUT_S), len(weight)
        h = np.zeros((n_late, n_about, n, 2, _N))
        h[..., 0, 0:3] = h[..., 1, 3:6] = measured
        h[..., _ARM] = -skew(rates)[:, None, :, :2]
        h[..., _DELAY] = slope[..., :2]
        h[..., _OFFSET] = to_body[:, None, :, :2, :2]
        z = body[:, None, :, :2] - measured[..., :2]
        weighted = (h * weight[:, None, None]).reshape(n_late, n_about, 2 * n, _N).swapaxes(2, 3)
        information = weighted @ h.reshape(n_late, n_about, 2 * n, _N)
        vector = (weighted @ z.reshape(n_late, n_about, 2 * n, 1))[..., 0]
        square = np.einsum("rdji,rdji,j->rd", z, z, weight)
        if not (np.isfinite(information).all() and np.isfinite(vector).all() and np.isfinite(square).all()):
            return  # it goes on as before these
        self._blocks.add(information.reshape(-1, _N, _N), vector.reshape(-1, _N), 2.0 * n)
        self._information += information
        self._vector += vector
        self._square += square

    def found(self) -> LateClocks | None:
        """Both clocks, where the reference's is off beyond doubt; else None."""
        if self._around is None or self._blocks.weight < 4.0 * _N:
            return None
        try:
            return self._found(self._around)
        except np.linalg.LinAlgError:  # numbers that ran away
            return None

    def _found(self, around: float) -> LateClocks | None:
        x = np.linalg.solve(self._information, self._vector[..., None])[..., 0]
        misfit = self._square - np.einsum("rdi,rdi->rd", x, self._vector)
        level = max(1.0, float(misfit.min()) / (self._blocks.weight - _N))
        # noise that lasts makes more evidence of itself than white noise, by as much as σ of lever arm and delay say
        inflation = UNKNOWN_INFLATION
        if self._blocks.count >= FEWEST:
            likeliest = int(misfit.argmin())
            own = np.linalg.inv(self._information.reshape(-1, _N, _N)[likeliest])
            inflation = float(self._blocks.inflation(likeliest, x.reshape(-1, _N)[likeliest], own)[_SHOWS].max())
        level *= inflation**2
        evidence = -0.5 * (misfit / level + np.linalg.slogdet(self._information)[1])
        if not np.isfinite(evidence).all():
            return None
        each = evidence.max(axis=1)
        share = np.exp(evidence - each[:, None])
        share /= share.sum(axis=1, keepdims=True)
        delays = around + ABOUT_S + x[..., _DELAY]
        delay = (share * delays).sum(axis=1)
        variance = np.linalg.inv(self._information)[..., _DELAY, _DELAY] * level + (delays - delay[:, None]) ** 2
        std = np.sqrt((share * variance).sum(axis=1))
        best = int(np.argmax(each))
        other_side = ON_TIME + (1 if best < ON_TIME else -1)
        if each[other_side] > each[ON_TIME]:  # a clock that might as well be off the other way is not shown to be off
            return None
        if best in (0, len(each) - 1):
            if each[best] - each[ON_TIME] < SAID_FROM_EVIDENCE:
                return None
            return LateClocks(float(LATE_S[best]), float(delay[best] + LATE_S[best]), float(std[best]), at_least=True)
        before, top, after = each[best - 1 : best + 2].tolist()
        beyond = 0.5 * (before - after) / (before - 2.0 * top + after)
        late = float(LATE_S[best]) + float(LATE_S[1] - LATE_S[0]) * beyond
        gained = top - 0.25 * (before - after) * beyond - each[ON_TIME]
        if abs(late) < SAID_FROM_S or gained < SAID_FROM_EVIDENCE:
            return None
        apart = float(delay[best]) + beyond * float(delay[best + 1] - delay[best - 1]) / 2.0
        return LateClocks(late, apart + late, float(std[best]), at_least=False)


def _thinned(reference: ReferenceColumns) -> ReferenceColumns:
    return reference.part(np.flatnonzero(np.diff(np.floor(reference.times / EVERY_S), prepend=-np.inf)))
