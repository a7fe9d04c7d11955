"""G2's blocks of time, solved one after the other: rows, outliers, the bank of delays, and what comes of it.

A block is a copy of what the aligner held, and nobody else touches what is in here meanwhile: so a block can be solved
beside the thread that feeds the aligner (`filter.DelayFilter` says when its outcome takes effect).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..checks.dvl_self_consistency import DvlStream
from ..checks.imu_rate_consistency import AttitudeRates
from ..checks.reference_independence import SharedNoise
from ..filters.filter_bank import ModelCounts
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Stamps
from ..registration.registration import Registration
from ..results.thinned_recording import MEASURED_BELOW, ThinnedBlock
from ..streams.interpolation import DvlColumns, ImuColumns, InBody, Parts, TurnRates, attitude_at, in_body, joined
from .block_preprocessing import MARGIN_NS, Block, Cleaned, cleaned, is_slow, seconds, without_contradicted
from .delay_hypotheses import DelayBank
from .estimator import Rest
from .observation_rows import DelayedRows, Matched, matched
from .posterior_types import After, BlockRows, Known, Likely, Posterior
from .registration_schedule import KeptClocks, Looked, ToldSoFar

# After every so many blocks of a day, hypotheses of the delay that have lost are left out.
NARROWED = 16


class Outcome(NamedTuple):
    """What is known after a block.

    prior: of G2's states on the day that it is. posterior: None where nothing was ever found. counts: samples used,
    spikes and those that no hypothesis explains, and the mean νᵀS⁻¹ν of the used ones. claims: references whose
    messages say how noisy they are, less the others. has_rows: whether the block had any. looked: how the instruments
    stand, as of the newest look on the way. suggestion: live, what configuration fits, by that look.
    """

    prior: GaussianState
    posterior: Posterior | None
    counts: ModelCounts
    claims: int
    has_rows: bool
    looked: Looked = Looked()
    suggestion: Reason | None = None


class _Comparison(NamedTuple):
    """Of one block its references in the body, its turning, and what makes its rows; None where it has none, or where
    the DVL is slow."""

    seen: InBody
    turns: TurnRates
    rows: Callable[[], DelayedRows] | None = None


class BlockSolver:
    """Takes blocks in order. restarted: how often what was found was not finite, and that of before is kept.

    kept: what verification needs; None where nobody verifies, or live, where that is what clocks are looked at by.
    """

    def __init__(
        self,
        parameters: Parameters,
        prior: GaussianState,
        unknown: GaussianState,
        gate: float,
        verified: bool,
        *,
        live: bool = False,
        registration: Registration | None = None,
    ) -> None:
        """As `DelayFilter`, which sets `epoch_ns`, the stamp of time 0. live: look at the clocks on the way.

        registration: how the instruments stand, where that is known.
        """
        self._parameters = parameters
        rate = np.zeros(len(prior.x))
        rate[:3], rate[3:5] = parameters.process_std_misalignment**2, parameters.process_std_scale**2
        self.bank = DelayBank(prior, unknown, gate, np.diag(rate) if rate.any() else None, verified or live, parameters)
        self._attitude_rates = AttitudeRates()
        self._shared_noise = SharedNoise()
        self._seen_ahead = self._seen_upwards = False  # whether references measure along these axes of the body
        self._dvl_stream = DvlStream()
        self._turned = False
        self._clocks = KeptClocks(parameters, live, registration)
        self._is_live = live
        x, y, z = parameters.lever_arm
        self._lever_arm = (x, y, z)
        self._claims = 0  # references
        self._spikes = 0  # samples of DVL and reference
        self._n_of_day = 0  # blocks
        self._contradicted: Stamps = np.zeros(0, dtype=np.int64)  # DVL samples, by the references of an earlier block
        self._posterior: Posterior | None = None
        self.epoch_ns = 0
        self.kept: list[ThinnedBlock] | None = [] if verified else None
        self.restarted = 0

    def outcome(self, has_rows: bool = False) -> Outcome:
        """What is known as of now."""
        bank = self.bank
        counts = ModelCounts(bank.used, bank.gated + self._spikes, bank.mean_nis, 3.0, self.restarted)
        return Outcome(bank.prior, self._posterior, counts, self._claims, has_rows)

    def suggestion(self, *, fresh: bool = True) -> Reason | None:
        """What configuration the data fit, where the one given is grossly wrong.

        fresh: by all that is known, which takes a while; else as they were looked at on the way, live.
        """
        if own := self._dvl_stream.contradiction():
            return own
        looked = self._clocks.looked(self._so_far, fresh=fresh)
        contradiction, found = self._attitude_rates.contradiction(), looked.configuration
        if contradiction:  # of what follows from it only what mends it is worth a word
            is_mended = found is not None and found.code in ("IMU_LOOKS_NED", "REFERENCE_OR_IMU_NED")
            return finding("TWO_CONTRADICTIONS", one=contradiction, other=found) if is_mended else contradiction
        return found or self._shared_noise.contradiction() or self._clocks.contradiction(looked)

    def registration(self) -> Registration | None:
        """How the instruments stand; None where the data do not show it."""
        return self._clocks.looked(self._so_far).registration

    def rest(self) -> Rest | None:
        """What the calibration leaves, live; None where that is not looked at."""
        return self._clocks.looked(self._so_far).rest

    @property
    def _so_far(self) -> ToldSoFar | None:
        return None if self._posterior is None else ToldSoFar(self.bank, self._posterior, self.epoch_ns)

    @property
    def is_level(self) -> bool:
        """Whether references were turned into the body by a heading alone, without roll and pitch."""
        return self._turned and self._attitude_rates.is_level

    @property
    def is_horizontal(self) -> bool:
        """Whether no reference measures the vertical."""
        return self._seen_ahead and not self._seen_upwards

    def solve(self, blocks: Sequence[Block]) -> list[Outcome]:
        """Take blocks in order: many at once cost a third of one after the other, and come to the same."""
        outcomes: list[Outcome] = []
        at = 0
        while at < len(blocks):
            end = at + 1
            if not self._goes_alone(blocks[at]):
                while end < len(blocks) and not (
                    blocks[end].new_days
                    or self._goes_alone(blocks[end])
                    or self._of_day(blocks[at:end]) % NARROWED == 0
                ):
                    end += 1
            of_day = self._of_day(blocks[at:end])
            outcomes += self._solve_together(blocks[at:end])
            self._n_of_day = of_day
            if of_day % NARROWED == 0:
                self._narrow()
            at = end
        if self._is_live:
            self._clocks.look_again(self._so_far)
        looked = self._clocks.looked(fresh=False)
        suggestion = self.suggestion(fresh=False) if self._is_live else None
        return [outcome._replace(looked=looked, suggestion=suggestion) for outcome in outcomes]

    def _of_day(self, blocks: Sequence[Block]) -> int:
        """How many blocks the day of some has, with these."""
        return len(blocks) + (0 if blocks[0].new_days else self._n_of_day)

    def _narrow(self) -> None:
        with suppress(np.linalg.LinAlgError):  # numbers that ran away
            self.bank.narrow()

    def _goes_alone(self, block: Block) -> bool:
        """Whether what is left out of blocks before matters to this one, or of this one to those behind it."""
        still_seen = (self._contradicted >= block.from_ns - MARGIN_NS).any()
        return bool(still_seen) or is_slow(2e-9 * block.dvl.stamps_ns)

    def _solve_together(self, blocks: Sequence[Block]) -> list[Outcome]:
        """Take blocks of one day."""
        for _ in range(blocks[0].new_days):
            try:
                self.bank.end_day()
            except np.linalg.LinAlgError:  # numbers that ran away: as if it were the same day
                self.restarted += 1
            self._clocks.end_day()
        streams = [cleaned(block, self._parameters, self.epoch_ns, self._contradicted) for block in blocks]
        compared = self._compared([each for each in streams if each.are_compared])
        last = After(self.bank.used, self.bank.gated, self.bank.mean_nis)
        found: dict[int, Known | None] = {}
        if blocks[0].new_days:
            found[0] = self._known()
        own: list[tuple[BlockRows | None, int, int]] = []
        for each in streams:
            own.append((self._take(each, compared), self._spikes, self._claims))
        after = iter(self.bank.add([rows for rows, _, _ in own if rows is not None]))
        outcomes: list[Outcome] = []
        for number, (rows, spikes, claims) in enumerate(own):
            has_rows = rows is not None and len(rows.rows) > 0
            last = last if rows is None else next(after)
            if has_rows:
                found[number] = last.known
            counts = ModelCounts(last.used, last.gated + spikes, last.mean_nis, 3.0, self.restarted)
            outcomes.append(Outcome(self.bank.prior, self._posterior, counts, claims, has_rows))
        sound = {number: known for number, known in found.items() if known is not None}
        posteriors = dict(zip(sound, self.bank.found([*sound.values()]), strict=True))
        return self._with_posteriors(outcomes, [(number, posteriors.get(number)) for number in found])

    def _known(self) -> Known | None:
        try:
            return self.bank.known()
        except np.linalg.LinAlgError:
            return None

    def _with_posteriors(self, outcomes: list[Outcome], found: Sequence[tuple[int, Likely | None]]) -> list[Outcome]:
        """Outcomes with what was found after some of them."""
        sound = [each for _, each in found if each is not None]
        try:
            posteriors: Iterator[Posterior | None] = iter(self.bank.posteriors(sound))
        except np.linalg.LinAlgError:  # of one of them: each by itself
            posteriors = iter([self._posterior_of(each) for each in sound])
        after: dict[int, Posterior | None] = {}
        for number, each in found:
            posterior = None if each is None else next(posteriors)
            finite = posterior is not None and all(np.isfinite(value).all() for value in posterior.state)
            after[number] = posterior if finite else None
        told = []
        for number, outcome in enumerate(outcomes):
            if number in after:
                if after[number] is None:  # a configuration so wrong that the errors have no small angles
                    self.restarted += 1
                else:
                    self._posterior = after[number]
            counts = outcome.counts._replace(restarted=self.restarted)
            told.append(outcome._replace(posterior=self._posterior, counts=counts))
        return told

    def _posterior_of(self, found: Likely) -> Posterior | None:
        try:
            return self.bank.posteriors([found])[0]
        except np.linalg.LinAlgError:
            return None

    def _seconds(self, stamps_ns: Stamps) -> Array:
        return seconds(stamps_ns, self.epoch_ns)

    def _compared(self, streams: Sequence[Cleaned]) -> dict[int, _Comparison]:
        """Of several blocks, by their beginnings, what is compared of their streams before the bank is asked."""
        if not streams:
            return {}
        p, imu = self._parameters, joined([each.imu for each in streams])
        imu_parts, own_parts = Parts.of([each.imu.times for each in streams]), Parts.of([each.own for each in streams])
        times = np.concatenate([self._seconds(each.raw.stamps_ns) for each in streams])
        rotation, oriented = attitude_at(imu, times, p.imu_timeout, imu_parts, own_parts)
        own_imu = [ImuColumns(*(column[each.own_imu] for column in each.imu)) for each in streams]
        begins = Parts.of([each.times for each in own_imu]).bounds[:-1].tolist()
        self._attitude_rates.add(*joined(own_imu), begins)
        good = np.concatenate([each.good for each in streams])
        reference = joined([each.reference for each in streams])
        seen = in_body(reference, rotation[good], oriented[good])
        parts = own_parts.where(good)
        found = {}
        for each, at in zip(streams, parts, strict=True):
            own_seen = seen.part(at)
            self._compare_noise(each, own_seen)
            found[each.block.from_ns] = _Comparison(own_seen, TurnRates.of(each.imu))
        together = [number for number, each in enumerate(streams) if each.has_rows and not each.is_slow]
        if together:
            chosen = [streams[number] for number in together]
            own = np.concatenate([np.arange(*parts.bounds[number : number + 2]) for number in together])
            turns = TurnRates.joined([found[each.block.from_ns].turns for each in chosen])
            rows = self._compare(chosen, [each.binned_dvl for each in chosen], seen.part(own), turns)
            for place, each in enumerate(chosen):
                comparison = found[each.block.from_ns]
                found[each.block.from_ns] = comparison._replace(rows=partial(rows.rows, place))
        return found

    def _compare(
        self, streams: Sequence[Cleaned], dvl: Sequence[DvlColumns], seen: InBody, turns: TurnRates
    ) -> Matched:
        """References of some blocks beside their DVL samples."""
        p = self._parameters
        return matched(
            joined(dvl),
            Parts.of([each.times for each in dvl]),
            joined([each.reference for each in streams]),
            Parts.of([each.reference.times for each in streams]),
            seen,
            turns,
            noise_dvl=np.stack([each.noise_dvl for each in streams]),
            body_from_dvl=p.rotation_dvl_from_body.T,
            lever_arm=self._lever_arm,
            min_speed=p.min_speed,
            max_turn_rate=p.max_turn_rate,
            imu_gap_s=p.imu_timeout,
            steps=self.bank.compared,
        )

    def _take(self, streams: Cleaned, compared: Mapping[int, _Comparison]) -> BlockRows | None:
        """Take a block's samples; the rows that it has, for the bank."""
        block, reference, dvl = streams.block, streams.reference, streams.dvl
        self._spikes += streams.reference_spikes
        if not streams.are_compared:
            return None
        self._spikes += streams.dvl_spikes
        self._turned = self._turned or not reference.in_body.all()
        stamps_ns = block.dvl.stamps_ns
        self._dvl_stream.add(block.dvl.velocity[(stamps_ns >= block.from_ns) & (stamps_ns < block.end_ns)])
        claimed = int(np.count_nonzero(reference.claimed))
        self._claims += claimed - (len(reference.times) - claimed)
        seen, turns, rows_of = compared[block.from_ns]
        rows = None if rows_of is None else rows_of()
        if streams.has_rows and streams.is_slow:
            good, rows = without_contradicted(
                dvl, reference.times, lambda some: self._compare([streams], [some], seen, turns).rows(0),
                self.bank.misfits, self.bank.delays_s,
            )  # fmt: skip
            self._leave_out(streams.dvl_ns[~good], block.from_ns)
            dvl = DvlColumns(*(column[good] for column in dvl))
        from_s, to_s = self._seconds(np.array([block.from_ns, block.end_ns])).tolist()
        kept = ThinnedBlock.between(from_s, to_s, dvl, streams.noise_dvl, reference, streams.imu)
        self._clocks.add(kept, streams.raw.frames, block.from_ns)
        if self.kept is not None:
            self.kept.append(kept)
        if rows is None:
            return None
        return BlockRows(rows, streams.reference_ns[rows.index], (block.end_ns - block.from_ns) * 1e-9)

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

    def _compare_noise(self, streams: Cleaned, seen: InBody) -> None:
        """Give a block's streams to `_shared_noise`. seen: its references."""
        variance = np.diagonal(seen.noise, axis1=1, axis2=2)
        known = seen.known[:, None] & (variance < MEASURED_BELOW)
        self._seen_ahead = bool(known[:, 0].any()) or self._seen_ahead
        self._seen_upwards = bool(known[:, 2].any()) or self._seen_upwards
        at = streams.own_dvl
        in_the_body = streams.dvl.velocity[at] @ self._parameters.rotation_dvl_from_body
        reference = np.where(known, seen.velocity, np.nan)
        # by the stamps as they were: what a filter made comes after what it was made from
        p = self._parameters
        times, reference_times = streams.dvl.times[at] + p.dvl_time_offset, streams.reference.times
        self._shared_noise.add(times, in_the_body, reference_times + p.reference_time_offset, reference)
