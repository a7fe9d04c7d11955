"""G2's blocks of time, solved one after the other: rows, outliers, the bank of delays, and what comes of it.

A block is a copy of what the aligner held, and nobody else touches what is in here meanwhile: so a block can be solved
beside the thread that feeds the aligner (`filter.DelayFilter` says when its outcome takes effect).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from ..attitude_rates import AttitudeRates
from ..bank import ModelCounts
from ..coarse_mounting import DELAYS_S, CoarseFits
from ..frames import ENU_FROM_NED, Array
from ..kalman import GaussianState
from ..observations import Observations
from ..parameters import Parameters
from ..robust import median
from ..samples import FRAME_CODES, FRAMES, Index, Mask, Stamps, VelocityFrame
from ..shared_noise import SharedNoise
from ..spikes import without_spikes
from .bank import DelayBank, Posterior
from .blocks import MARGIN_NS, Block, ImuSamples
from .contradicted import without_contradicted
from .hold_out import MEASURED_BELOW, NOT_MEASURED, Kept, thinned
from .reference_clock import ReferenceClock
from .rows import (
    DelayedRows,
    DvlColumns,
    ImuColumns,
    InBody,
    ReferenceColumns,
    TurnRates,
    attitude_at,
    binned,
    delayed_rows,
    in_body,
)

_BODY, _NED = FRAME_CODES[VelocityFrame.BODY], FRAME_CODES[VelocityFrame.NED]
# No vehicle with a DVL turns faster, rad/s.
FASTEST_TURN = 20.0
_BITS = np.array([1, 2, 4], dtype=np.uint8)
# A stream that scatters by less about what its neighbours tell is taken to do so by this, m/s; one whose samples are
# further apart than this, s, by more: a vehicle turns between them, though not by metres per second.
LEAST_SCATTER_MPS, SLOW_S, LEAST_SCATTER_SLOW_MPS = 0.01, 0.45, 0.1


class Outcome(NamedTuple):
    """What is known after a block.

    prior: of G2's states on the day that it is. posterior: None where nothing was ever found. counts: samples used,
    spikes and those that no hypothesis explains, and the mean νᵀS⁻¹ν of the used ones. claims: references whose
    messages say how noisy they are, less the others. has_rows: whether the block had any. suggestion: what
    configuration the data fit, '' for the one given; None where nobody wanted to know.
    """

    prior: GaussianState
    posterior: Posterior | None
    counts: ModelCounts
    claims: int
    has_rows: bool
    suggestion: str | None


class BlockSolver:
    """Takes blocks in order. restarted: how often what was found was not finite, and that of before is kept.

    kept: what verification needs, None where nobody verifies.
    """

    def __init__(
        self,
        parameters: Parameters,
        prior: GaussianState,
        unknown: GaussianState,
        gate: float,
        verified: bool,
        epoch_ns: int = 0,
    ) -> None:
        """As `DelayFilter`. epoch_ns: stamp of time 0."""
        self._parameters = parameters
        rate = np.zeros(len(prior.x))
        rate[:3], rate[3:5] = parameters.process_std_misalignment**2, parameters.process_std_scale**2
        self.bank = DelayBank(prior, unknown, gate, np.diag(rate) if rate.any() else None, verified, parameters)
        self._template = Observations(
            velocity_dvl=np.zeros((1, 3)),
            reference_body=None,
            lever_velocity=None,
            rotation_dvl_from_body=parameters.rotation_dvl_from_body,
            sway_heave=np.zeros(2),
        )
        self._coarse = CoarseFits(parameters.rotation_dvl_from_body)
        self._attitude_rates = AttitudeRates()
        self._shared_noise = SharedNoise()
        self._reference_clock = ReferenceClock(parameters)
        x, y, z = parameters.lever_arm
        self._lever_arm = (x, y, z)
        self._claims = 0  # references
        self._spikes = 0  # samples of DVL and reference
        self._contradicted: Stamps = np.zeros(0, dtype=np.int64)  # DVL samples, by the references of an earlier block
        self._posterior: Posterior | None = None
        self.epoch_ns = epoch_ns
        self.kept: list[Kept] | None = [] if verified else None
        self.restarted = 0

    def outcome(self, has_rows: bool = False, *, suggested: bool = False) -> Outcome:
        """What is known as of now. suggested: with what configuration the data fit."""
        bank = self.bank
        counts = ModelCounts(bank.used, bank.gated + self._spikes, bank.mean_nis, 3.0, self.restarted)
        suggestion = self.suggestion() if suggested else None
        return Outcome(bank.prior, self._posterior, counts, self._claims, has_rows, suggestion)

    def suggestion(self) -> str:
        """What configuration the data fit, in words, where the one given is grossly wrong; else ''."""
        contradiction, found = self._attitude_rates.says(), self._coarse.suggestion()
        if contradiction:  # of what follows from it only what mends it is worth a word
            return f"{contradiction}; {found.says}" if found and "imu_frame" in found.says else contradiction
        if found is not None:
            return found.says
        if shared := self._shared_noise.says():
            return shared
        late = self._reference_clock.found()
        return "" if late is None else late.says(self._parameters)

    def solve(self, block: Block, *, suggested: bool = False) -> Outcome:
        """Take a block. suggested: as in `outcome`."""
        for _ in range(block.new_days):
            try:
                self.bank.end_day()
            except np.linalg.LinAlgError:  # numbers that ran away: as if it were the same day
                self.restarted += 1
            self._reference_clock.start()
        has_rows = self._take(block)
        if has_rows or block.new_days:
            self._find()
        return self.outcome(has_rows, suggested=suggested)

    def _find(self) -> None:
        try:
            found = self.bank.posterior()
        except np.linalg.LinAlgError:  # a configuration so wrong that the errors have no small angles
            found = None
        if found is not None and np.isfinite(found.state.x).all() and np.isfinite(found.state.p).all():
            self._posterior = found
        else:
            self.restarted += 1

    def _seconds(self, stamps_ns: Stamps) -> Array:
        seconds: Array = (stamps_ns - self.epoch_ns) * 1e-9
        return seconds

    def _take(self, block: Block) -> bool:
        """Take a block's samples; whether it has rows."""
        reference, stamps_ns = self._reference(block)
        if not len(stamps_ns) or block.silent:
            return False
        claimed = int(np.count_nonzero(reference.claimed))
        self._claims += claimed - (len(stamps_ns) - claimed)
        dvl, noise_dvl, dvl_ns = self._dvl_columns(block)
        imu = self._imu(block.imu)
        self._compare_coarsely(block, dvl, imu)
        seen = in_body(reference, imu, self._parameters.imu_timeout)
        self._compare_noise(block, dvl, reference.times, seen)
        from_s, to_s = self._seconds(np.array([block.from_ns, block.end_ns])).tolist()
        first, end = np.searchsorted(imu.times, (from_s, to_s)).tolist()
        self._attitude_rates.add(*(column[first:end] for column in imu))
        binned_dvl, turns = DvlColumns(*binned(*dvl)), TurnRates.of(imu)
        rows = None
        if len(dvl.times) >= 6 and len(imu.times) >= 2:
            rows_of = partial(self._rows, reference=reference, seen=seen, turns=turns, noise_dvl=noise_dvl)
            if _is_slow(dvl.times):
                good, rows = without_contradicted(dvl, reference.times, rows_of, self.bank.misfits)
                self._leave_out(dvl_ns[~good], block.from_ns)
                dvl = binned_dvl = DvlColumns(*(column[good] for column in dvl))
            else:
                rows = rows_of(binned_dvl)
        if self.kept is not None:
            self.kept.append(Kept.between(from_s, to_s, dvl, noise_dvl, reference, imu))
        if rows is None:
            return False
        used = self.bank.add(rows, stamps_ns[rows.index], (block.end_ns - block.from_ns) * 1e-9)
        self._reference_clock.add(
            binned_dvl, reference.part(rows.index[used]), imu, turns, noise_dvl, self.bank.likeliest_delay
        )
        return len(rows) > 0

    def _rows(
        self, dvl: DvlColumns, *, reference: ReferenceColumns, seen: InBody, turns: TurnRates, noise_dvl: Array
    ) -> DelayedRows:
        p = self._parameters
        return delayed_rows(
            dvl,
            reference,
            seen,
            turns,
            noise_dvl=noise_dvl,
            template=self._template,
            lever_arm=self._lever_arm,
            min_speed=p.min_speed,
            max_turn_rate=p.max_turn_rate,
            imu_gap_s=p.imu_timeout,
        )

    def _leave_out(self, stamps_ns: Stamps, block_ns: int) -> None:
        """Leave some DVL samples out from now on, and where they are kept for verification already."""
        if not len(stamps_ns):
            return
        self._spikes += len(stamps_ns)
        before = self._contradicted
        self._contradicted = np.concatenate([before[before >= block_ns - MARGIN_NS], stamps_ns])
        if self.kept:
            last = self.kept[-1]
            good = ~np.isin(last.dvl.times, self._seconds(stamps_ns), assume_unique=True)
            self.kept[-1] = last._replace(dvl=DvlColumns(*(column[good] for column in last.dvl)))

    def _compare_coarsely(self, block: Block, dvl: DvlColumns, imu: ImuColumns) -> None:
        """Give the block's references, as their messages had them, to `_coarse`."""
        if len(dvl.times) < 2:
            return
        stamps_ns, values, frames, unmeasured_axes = block.reference.part(_own(block))
        times, raw = self._seconds(stamps_ns), values[:, :3]
        late = times[:, None] + DELAYS_S
        velocity = np.stack([np.interp(late, dvl.times, column) for column in dvl.velocity.T], axis=2)
        rotation, oriented = attitude_at(imu, times, self._parameters.imu_timeout)
        rates = None
        if len(imu.times) > 1:
            rates = np.column_stack([np.interp(times, imu.times, column) for column in imu.angular_velocity.T])
        inside = (late[:, 0] >= dvl.times[0]) & (late[:, -1] <= dvl.times[-1])
        moving = inside & ((raw**2).sum(axis=1) >= self._parameters.min_speed**2)
        unmeasured = unmeasured_axes != 0
        for code in set(frames.tolist()):
            for has_attitude in (True, False):
                use = moving & (frames == code) & (oriented == has_attitude) & ~unmeasured
                if use.any():
                    attitude = rotation[use] if has_attitude else None
                    self._coarse.add(
                        FRAMES[code], raw[use], attitude, velocity[use], None if rates is None else rates[use]
                    )

    def _compare_noise(self, block: Block, dvl: DvlColumns, times: Array, reference: InBody) -> None:
        """Give a block's streams to `_shared_noise`. times: (J,) s, of the references."""
        variance = np.diagonal(reference.noise, axis1=1, axis2=2)
        known = reference.known[:, None] & (variance < MEASURED_BELOW)
        first, end = np.searchsorted(dvl.times, self._seconds(np.array([block.from_ns, block.end_ns]))).tolist()
        in_the_body = dvl.velocity[first:end] @ self._parameters.rotation_dvl_from_body
        self._shared_noise.add(dvl.times[first:end], in_the_body, times, np.where(known, reference.velocity, np.nan))

    def _dvl_columns(self, block: Block) -> tuple[DvlColumns, Array, Stamps]:
        """A block's DVL samples that are no outliers (N), their mean covariance (3, 3), and their stamps (N,)."""
        stamps_ns, velocity, covariance = block.dvl
        if len(self._contradicted):
            known = ~np.isin(stamps_ns, self._contradicted, assume_unique=True)
            stamps_ns, velocity, covariance = stamps_ns[known], velocity[known], covariance[known]
        # one bends the curve that is read between samples for all references about it, and no gate would see that
        good = _good(stamps_ns, velocity)
        spikes = stamps_ns[~good]
        stamps_ns, velocity, covariance = stamps_ns[good], velocity[good], covariance[good]
        self._spikes += int(np.count_nonzero((spikes >= block.from_ns) & (spikes < block.end_ns)))
        given = ~np.isnan(covariance[:, 0, 0])
        noise: Array = np.eye(3) * self._parameters.gnss_free_std**2
        if given.any() and self._parameters.use_message_covariance:
            noise = covariance[given].mean(axis=0)
        return DvlColumns(self._seconds(stamps_ns), velocity), noise, stamps_ns

    def _imu(self, samples: ImuSamples) -> ImuColumns:
        values = samples.values
        rates = np.where(np.abs(values[:, 4:7]) < FASTEST_TURN, values[:, 4:7], np.nan)
        return ImuColumns(self._seconds(samples.stamps_ns), values[:, :4], rates)

    def _reference(self, block: Block) -> tuple[ReferenceColumns, Stamps]:
        """A block's references, thinned and without outliers, and their stamps."""
        around = block.reference
        measured = (around.unmeasured[:, None] & _BITS) == 0
        own = _own(block)
        good = _good(around.stamps_ns, np.where(measured, around.values[:, :3], 0.0))[own]
        self._spikes += int(np.count_nonzero(~good))
        stamps_ns, values, frames, unmeasured = around.part(own[good])
        noise = values[:, 3:12].reshape(-1, 3, 3)
        given = ~np.isnan(noise[:, 0, 0]) & self._parameters.use_message_covariance
        noise = np.where(given[:, None, None], noise, np.eye(3) * self._parameters.gnss_aided_std**2)
        velocity, ned = values[:, :3], frames == _NED
        if unmeasured.any():
            axes = (unmeasured[:, None] & _BITS) != 0
            velocity = np.where(axes, 0.0, velocity)
            noise = np.where(axes[:, :, None] | axes[:, None, :], 0.0, noise) + np.eye(3) * np.where(
                axes[:, :, None], NOT_MEASURED, 0.0
            )
        if ned.any():
            velocity = np.where(ned[:, None], velocity @ ENU_FROM_NED.T, velocity)
            noise = np.where(ned[:, None, None], ENU_FROM_NED @ noise @ ENU_FROM_NED.T, noise)
        return ReferenceColumns(self._seconds(stamps_ns), velocity, noise, frames == _BODY, given), stamps_ns


def _own(block: Block) -> Index:
    """Which of a block's references are its own and no margin's, thinned."""
    stamps_ns = block.reference.stamps_ns
    start, end = np.searchsorted(stamps_ns, (block.from_ns, block.end_ns)).tolist()
    return start + thinned(stamps_ns[start:end])


def _is_slow(times: Array) -> bool:
    """Whether samples at times (N,) s are so far apart that a vehicle turns between them."""
    return len(times) > 1 and float(median(np.diff(times))) > SLOW_S


def _good(stamps_ns: Stamps, velocity: Array) -> Mask:
    """Which samples of a stream are no spikes, (N,) of (N,) ns and (N, 3) m/s."""
    smallest = LEAST_SCATTER_SLOW_MPS if _is_slow(1e-9 * stamps_ns) else LEAST_SCATTER_MPS
    return without_spikes(velocity, smallest=smallest, also_at_ends=True)
