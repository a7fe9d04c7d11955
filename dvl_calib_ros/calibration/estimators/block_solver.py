"""Solver of time blocks in order: outliers, the joint fit of `full`, and results.

Blocks are copies that no other code changes, so they can be solved in a thread. `block_estimator.FullEstimator` decides
when a result takes effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..checks.dvl_self_consistency import DvlStream
from ..checks.imu_rate_consistency import AttitudeRates
from ..checks.reference_independence import SharedNoise
from ..filters.cross_validation import folds_of
from ..filters.filter_bank import ModelCounts
from ..models.parameters import Parameters
from ..numerics.kalman import GaussianState
from ..numerics.tables import return_memory
from ..registration.registration import Registration
from ..results.thinned_recording import MEASURED_BELOW, ThinnedBlock, mean_around
from ..streams.interpolation import (
    BIN_S,
    FASTER_THAN_S,
    LONGEST_DELAY_S,
    DvlColumns,
    ImuColumns,
    InBody,
    attitude_at,
    in_body,
)
from .block_preprocessing import Block, Cleaned, cleaned, seconds
from .estimator import Residuals
from .full_fit import JointFit
from .full_forward_model import FitBlock, spline_slopes
from .registration_schedule import FitSoFar, RegistrationResult, RegistrationSchedule

# DVL and IMU are kept this far beyond a block, s: the longest delay, and the end of a spline.
MARGIN_S = LONGEST_DELAY_S + 0.8
# DVL samples needed for a spline.
FEWEST_DVL = 6


class Outcome(NamedTuple):
    """Results after a block.

    days: states (20,) of `full` on each day; empty without an estimate.
    counts: samples used, outliers (spikes and rejected residuals), and mean squared residual.
    claims: references with their own noise, minus those without.
    has_rows: whether any reference has been used.
    clocks: latest registration.
    suggestion: live, the configuration that fits by it.
    """

    days: tuple[GaussianState, ...]
    counts: ModelCounts
    claims: int
    has_rows: bool
    clocks: RegistrationResult = RegistrationResult()
    suggestion: Reason | None = None


class BlockSolver:
    """Solver of blocks in order. restarted: number of fits that diverged. kept: streams for verification, or None.

    has_imu: whether any IMU sample came. speeds: number of DVL samples in the fit, and sum of their squares, (m/s)².
    """

    def __init__(
        self, parameters: Parameters, prior: GaussianState, unknown: GaussianState, verified: bool, *, live: bool
    ) -> None:
        """Start from priors; `FullEstimator` sets `epoch_ns`, the stamp of time 0.

        prior: x, P of the states.
        unknown: prior of the per-day states on further days.
        live: repeat the registration during the run.
        """
        self._parameters = parameters
        self.fit = JointFit(parameters, prior, unknown)
        self._attitude_rates = AttitudeRates()
        self._shared_noise = SharedNoise()
        self.has_imu = False
        self.speeds = np.zeros(2)
        self._seen_ahead = self._seen_upwards = False  # whether references measure these body axes
        self._dvl_stream = DvlStream()
        self._in_earth = False  # whether any reference is in an earth frame
        self._clocks = RegistrationSchedule(parameters, live)
        self._is_live = live
        self._claims = 0  # references with their own noise, minus those without
        self._spikes = 0  # samples of DVL and reference
        self.epoch_ns = 0
        self.kept: list[ThinnedBlock] | None = [] if verified else None
        self.restarted = 0

    def outcome(self, has_rows: bool = False) -> Outcome:
        """Return the results of all blocks so far. has_rows: whether any reference has been used."""
        used, gated, misfit = self.fit.counts
        mean_misfit = misfit / used if used else math.nan
        counts = ModelCounts(used, gated + self._spikes, mean_misfit, mean_rows=3.0, restarted=self.restarted)
        return Outcome(tuple(self.fit.states), counts, self._claims, has_rows)

    def suggestion(self, *, fresh: bool = True) -> Reason | None:
        """Return the configuration that fits the data, if the given one is grossly wrong.

        fresh: register clocks and frames again from all blocks, which is slow; else use the latest registration.
        """
        if own := self._dvl_stream.contradiction():
            return own
        registered = self._clocks.latest(self._so_far, fresh=fresh)
        contradiction, found = self._attitude_rates.contradiction(), registered.configuration
        if contradiction:  # a second contradiction is only reported if its correction also removes the first
            is_mended = found is not None and found.code in ("IMU_LOOKS_NED", "REFERENCE_OR_IMU_NED")
            return finding("TWO_CONTRADICTIONS", one=contradiction, other=found) if is_mended else contradiction
        return found or self._shared_noise.contradiction() or self._clocks.contradiction(registered)

    def registration(self) -> Registration | None:
        """Return the registration of clocks and frames; None if the data do not determine it."""
        return self._clocks.latest(self._so_far).registration

    def residuals(self) -> Residuals | None:
        """Return the calibration's residuals, live only; else None."""
        return self._clocks.latest(self._so_far).residuals

    @property
    def _so_far(self) -> FitSoFar | None:
        return None if not self.fit.has_data else FitSoFar(self.fit, self.epoch_ns)

    @property
    def is_level(self) -> bool:
        """Return whether references are rotated into the body by a heading only, without roll and pitch."""
        return self._in_earth and self._attitude_rates.is_level

    @property
    def is_horizontal(self) -> bool:
        """Return whether no reference measures the vertical."""
        return self._seen_ahead and not self._seen_upwards

    def solve(self, blocks: Sequence[Block]) -> list[Outcome]:
        """Solve blocks in order. Return the results after each."""
        outcomes = [self._solve(block) for block in blocks]
        if self._is_live:
            self._clocks.register_again(self._so_far)
            return_memory()
        registered = self._clocks.latest(fresh=False)
        suggestion = self.suggestion(fresh=False) if self._is_live else None
        return [outcome._replace(clocks=registered, suggestion=suggestion) for outcome in outcomes]

    def _solve(self, block: Block) -> Outcome:
        """Check a block's samples and add them to the fit."""
        for _ in range(block.new_days):
            self.fit.end_day()
            self._clocks.end_day()
            self._attitude_rates.end_day()
        p = self._parameters
        streams = cleaned(block, p, self.epoch_ns)
        self._spikes += streams.reference_spikes
        if not streams.are_compared:
            return self.outcome()
        self._spikes += streams.dvl_spikes
        self._attitude_rates.add(*ImuColumns(*(column[streams.own_imu] for column in streams.imu)))
        unbiased = streams.imu.angular_velocity - self._attitude_rates.bias
        streams = streams._replace(imu=streams.imu._replace(angular_velocity=unbiased))
        self._check_instruments(streams)
        self.has_imu = self.has_imu or len(streams.imu.times) > 0
        if not self.has_imu and streams.reference.in_body.all():
            streams = streams._replace(imu=_as_if_still(streams.block, self.epoch_ns))
        if len(streams.dvl.times) < FEWEST_DVL or len(streams.imu.times) < 2:
            return self.outcome()
        try:
            kept = self._fit_block(streams)
            if len(kept.dvl.times) > 1:  # else the DVL has a gap there
                self.fit.add(kept)
                self.speeds += len(kept.dvl.times), float((kept.dvl.velocity**2).sum())
        except np.linalg.LinAlgError:  # the fit diverged
            self.restarted += 1
        return self.outcome(self.fit.has_data)

    def _check_instruments(self, streams: Cleaned) -> None:
        """Add a block's samples to the checks of instruments and clocks, and to the streams for verification."""
        block, reference, dvl, p = streams.block, streams.reference, streams.dvl, self._parameters
        rotation, oriented = attitude_at(streams.imu, reference.times, p.imu_timeout)
        self._compare_noise(streams, in_body(reference, rotation, oriented))
        self._in_earth = self._in_earth or not reference.in_body.all()
        stamps_ns = block.dvl.stamps_ns
        self._dvl_stream.add(block.dvl.velocity[(stamps_ns >= block.from_ns) & (stamps_ns < block.end_ns)])
        self._claims += 2 * int(np.count_nonzero(reference.claimed)) - len(reference.times)
        from_s, to_s = seconds(np.array([block.from_ns, block.end_ns]), self.epoch_ns).tolist()
        thinned = ThinnedBlock.between(from_s, to_s, dvl, streams.noise_dvl, reference, streams.imu)
        self._clocks.add(thinned, streams.raw.frames, block.from_ns)
        if self.kept is not None:
            self.kept.append(thinned)

    def _fit_block(self, streams: Cleaned) -> FitBlock:
        """Return the part of a block that the fit keeps."""
        block = streams.block
        from_s, end_s = seconds(np.array([block.from_ns, block.end_ns]), self.epoch_ns).tolist()
        times, velocity = streams.binned_dvl
        near = slice(*np.searchsorted(times, (from_s - MARGIN_S, end_s + MARGIN_S)).tolist())
        dvl = DvlColumns(times[near].copy(), velocity[near].copy())
        imu = _thinned_imu(streams.imu, from_s - MARGIN_S, end_s + MARGIN_S)
        measured = np.diagonal(streams.reference.noise, axis1=1, axis2=2) < MEASURED_BELOW
        imu_slope = spline_slopes(imu.times, np.hstack([imu.orientation, imu.angular_velocity]))
        return FitBlock(
            from_s, end_s, dvl, slope=spline_slopes(*dvl), imu=imu, imu_slope=imu_slope, reference=streams.reference,
            measured=measured, fold=folds_of(streams.reference_ns, self._parameters),
        )  # fmt: skip

    def _compare_noise(self, streams: Cleaned, references: InBody) -> None:
        """Add a block's streams to the test of shared noise. references: of the block, in body axes."""
        variance = np.diagonal(references.noise, axis1=1, axis2=2)
        known = references.known[:, None] & (variance < MEASURED_BELOW)
        self._seen_ahead = bool(known[:, 0].any()) or self._seen_ahead
        self._seen_upwards = bool(known[:, 2].any()) or self._seen_upwards
        at = streams.own_dvl
        in_the_body = streams.dvl.velocity[at] @ self._parameters.rotation_dvl_from_body
        reference = np.where(known, references.velocity, np.nan)
        # at the original stamps, where filter output follows its input
        p = self._parameters
        times, reference_times = streams.dvl.times[at] + p.dvl_time_offset, streams.reference.times
        self._shared_noise.add(times, in_the_body, reference_times + p.reference_time_offset, reference)


def _as_if_still(block: Block, epoch_ns: int) -> ImuColumns:
    """Return an IMU without rotation, in place of a missing one, for references in body axes."""
    from_s, end_s = seconds(np.array([block.from_ns, block.end_ns]), epoch_ns).tolist()
    times = np.arange(from_s - MARGIN_S, end_s + MARGIN_S, BIN_S)
    return ImuColumns(times, np.full((len(times), 4), np.nan), np.zeros((len(times), 3)))


def _thinned_imu(imu: ImuColumns, from_s: float, end_s: float) -> ImuColumns:
    """Return attitude and mean angular velocity every BIN_S where known; attitude nan if there is none.

    Quaternion signs are continuous.
    """
    first, last = np.searchsorted(imu.times, (from_s, end_s)).tolist()
    times, orientation, rates = (column[first:last] for column in imu)
    known, oriented = np.isfinite(rates).all(axis=1), np.isfinite(orientation).all(axis=1)
    known &= oriented if oriented.any() else True
    times, orientation, rates = times[known], orientation[known], rates[known]
    at = np.arange(len(times))
    if len(times) > 1 and times[-1] - times[0] < FASTER_THAN_S * len(times):
        at = np.flatnonzero(np.diff(np.floor(times / BIN_S), prepend=-np.inf))
        rates = mean_around(times, rates, times[at], 0.5 * BIN_S)
    orientation = orientation[at]
    flips = np.cumprod(np.where((orientation[1:] * orientation[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    orientation = orientation * np.append(1.0, flips)[: len(at), None]
    return ImuColumns(times[at], orientation, rates)
