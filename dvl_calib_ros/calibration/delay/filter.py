"""G2 beside the other models: fed from the aligner, in blocks of time that stamps decide.

A hypothesis of 3 s of delay needs what comes 3 s later, so G2's samples are used when the others' have long been. It
reads what the aligner holds of the streams as soon as all that may belong to a block has come or is overdue; nobody
waits for it. (Long, because what is taken from the aligner and what is told of the outcome go by the same blocks.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import ClassVar

import numpy as np

from ..alignment import Aligner
from ..bank import ModelCounts
from ..coarse_mounting import DELAYS_S, CoarseFits
from ..frames import ENU_FROM_NED, Array
from ..kalman import GaussianState
from ..observations import Observations
from ..parameters import Parameters
from ..robust import median
from ..samples import FRAME_CODES, FRAMES, Index, Mask, Stamps, VelocityFrame, Verdict
from ..selection import EXTENDED_FROM, NO_EVIDENCE, Evidence
from ..spikes import without_spikes
from ..streams import LONG_AGO_NS, LONGEST_NS
from ..tables import Table
from ..verification import HeldOutError
from .bank import DayState, DelayBank, Posterior
from .contradicted import without_contradicted
from .hold_out import NOT_MEASURED, Kept, Recording, held_out_error, thinned
from .reference_clock import ReferenceClock
from .rows import (
    BEYOND,
    DELAY,
    LEVER_ARM,
    LONGEST_DELAY_S,
    MARGIN_S,
    N_STATE,
    DelayedRows,
    DvlColumns,
    ImuColumns,
    ReferenceColumns,
    TurnRates,
    attitude_at,
    binned,
    delayed_rows,
)

BLOCK_NS = 10_000_000_000
MARGIN_NS = round(MARGIN_S * 1e9)
LONGEST_DELAY_NS = round(LONGEST_DELAY_S * 1e9)
_BODY, _NED = FRAME_CODES[VelocityFrame.BODY], FRAME_CODES[VelocityFrame.NED]
_BEYOND = np.isin(np.arange(N_STATE), np.arange(N_STATE)[BEYOND])
# No vehicle with a DVL turns faster, rad/s.
FASTEST_TURN = 20.0
AXES = ("x", "y", "z")
# What is less than so many σ from nothing is not worth a word.
NAMED_FROM = 4.0
_BITS = np.array([1, 2, 4], dtype=np.uint8)
# A stream that scatters by less about what its neighbours tell is taken to do so by this, m/s; one whose samples are
# further apart than this, s, by more: a vehicle turns between them, though not by metres per second.
LEAST_SCATTER_MPS, SLOW_S, LEAST_SCATTER_SLOW_MPS = 0.01, 0.45, 0.1


class _Dvl(Table):
    """Usable DVL samples that blocks to come need; contradicted: by the references of an earlier one."""

    LAYOUT: ClassVar = {
        "stamps_ns": (np.int64, ()),
        "velocity": (np.float64, (3,)),
        "covariance": (np.float64, (3, 3)),
        "contradicted": (np.bool_, ()),
    }
    stamps_ns: Stamps
    velocity: Array
    covariance: Array
    contradicted: Mask


class DelayFilter:
    """Feeds a `DelayBank` from an aligner; tells the aligner which past of its tracks is still wanted.

    restarted: how often what was found was not finite, and that of before is kept. n_taken: number of the first row of
    the aligner that it has not copied yet.
    """

    def __init__(
        self,
        parameters: Parameters,
        aligner: Aligner,
        prior: GaussianState,
        unknown: GaussianState,
        gate: float,
        on_block: Callable[[int], None],
        verified: bool,
    ) -> None:
        """Start from the prior of G2's states.

        unknown: a prior without any calibration before it. gate: largest νᵀS⁻¹ν of a good sample. on_block:
        told after each block of the stamp from which on DVL samples may go by it. verified: keep what hold-out needs.
        """
        self._parameters = parameters
        self._aligner = aligner
        self._on_block = on_block
        rate = np.zeros(len(prior.x))
        rate[:3], rate[3:5] = parameters.process_std_misalignment**2, parameters.process_std_scale**2
        self._bank = DelayBank(prior, unknown, gate, np.diag(rate) if rate.any() else None, verified, parameters)
        # until a block is complete: what it needs of the others, later than it can still come, and judged by the IMU
        self._wait_ns = MARGIN_NS + aligner.lag_ns + round(parameters.imu_timeout * 1e9)
        self._template = Observations(
            velocity_dvl=np.zeros((1, 3)),
            reference_body=None,
            lever_velocity=None,
            rotation_dvl_from_body=parameters.rotation_dvl_from_body,
            sway_heave=np.zeros(2),
        )
        self._coarse = CoarseFits(parameters.rotation_dvl_from_body)
        self._reference_clock = ReferenceClock(parameters)
        self._suggestion: str | None = None  # until another block
        x, y, z = parameters.lever_arm
        self._lever_arm = (x, y, z)
        self._dvl = _Dvl()
        self.n_taken = 0  # rows of the aligner that have been looked at
        self._claiming = self._not_claiming = 0  # references
        self._spikes = 0  # samples of DVL and reference
        self._block_ns: int | None = None  # start of the next block
        self._epoch_ns = 0
        self._day_starts_ns: list[int] = []  # of the blocks that days after the first began with
        self._kept: list[Kept] | None = [] if verified else None
        self._posterior: Posterior | None = None
        self._changed = False
        self.restarted = 0
        self._remembered: list[tuple[int, GaussianState | None, int, float]] = []
        for track in (aligner.reference, aligner.imu):
            track.needed_from_ns = LONG_AGO_NS  # until the first block is known
        aligner.before_clearing = self.advance

    @property
    def counts(self) -> ModelCounts:
        """Samples used, spikes and those that no hypothesis explains, and the mean νᵀS⁻¹ν of the used ones."""
        return ModelCounts(self._bank.used, self._bank.gated + self._spikes, self._bank.mean_nis, 3.0, self.restarted)

    @property
    def posterior(self) -> Posterior | None:
        """What is known after the blocks so far; None before the first."""
        if self._changed:
            self._changed = False
            try:
                found = self._bank.posterior()
            except np.linalg.LinAlgError:  # a configuration so wrong that the errors have no small angles
                found = None
            if found is not None and np.isfinite(found.state.x).all() and np.isfinite(found.state.p).all():
                self._posterior = found
            else:
                self.restarted += 1
        return self._posterior

    @property
    def claims(self) -> bool:
        """Whether the data show anything of lever arm or delay."""
        return self.posterior is not None and bool(self.posterior.shown[BEYOND].any())

    @property
    def inflation(self) -> Array:
        """By how much blocks of time have raised σ of each state (n,); 1 of what is not claimed."""
        posterior = self.posterior
        if posterior is None:
            return np.ones(N_STATE)
        return np.where(_BEYOND & ~posterior.shown, 1.0, posterior.inflation)

    def state(self, base: GaussianState) -> GaussianState:
        """The state, given that of the model that this extends."""
        posterior = self.posterior
        return posterior.state if posterior is not None and self.claims else self.extended(base)

    def extended(self, base: GaussianState) -> GaussianState:
        """The state of the model that this one extends, with the prior of what it does not have."""
        n, prior = len(base.x), self._bank.prior
        p = prior.p.copy()
        p[:n, :n] = base.p
        return GaussianState(np.concatenate([base.x, prior.x[n:]]), p)

    @property
    def suggestion(self) -> str:
        """What configuration the data fit, in words, where the one given is grossly wrong; else ''."""
        if self._suggestion is None:
            self._suggestion = self._suggested()
        return self._suggestion

    def _suggested(self) -> str:
        found = self._coarse.suggestion()
        if found is not None:
            return found.says
        late = self._reference_clock.found()
        return "" if late is None else late.says(self._parameters)

    @property
    def evidence(self) -> Evidence:
        """How much speaks for lever arm and delay."""
        posterior = self.posterior
        if posterior is None or not self.claims:
            return NO_EVIDENCE
        x, p = posterior.state
        at = np.flatnonzero(posterior.shown & _BEYOND)
        chi_square = float(x[at] @ np.linalg.solve(p[np.ix_(at, at)], x[at]))
        std = np.sqrt(np.diag(p))
        found = []
        arm = [index for index in at.tolist() if index != DELAY]
        if any(abs(x[index]) > NAMED_FROM * std[index] for index in arm):
            axes = " ".join(f"{AXES[index - LEVER_ARM.start]} {x[index]:+.2f} ± {std[index]:.2f}" for index in arm)
            found.append(f"a lever arm of {axes} m")
        if DELAY in at and abs(x[DELAY]) > NAMED_FROM * std[DELAY]:
            late = "late" if x[DELAY] > 0.0 else "early"
            found.append(f"DVL stamps {abs(x[DELAY]):.2f} ± {std[DELAY]:.2f} s {late}")
        turns = float(posterior.by_lever_arm.max())
        if turns > chi_square:
            return Evidence(turns, f"takes the lever arm as known, and {_turns_in_words(posterior)}")
        shown = " and ".join(found) or "a lever arm or a delay"
        return Evidence(chi_square, f"does not explain the data, which show {shown}")

    @property
    def lever_arm_turns(self) -> str:
        """How much of an angle is the lever arm's, in words; '' if the motion tells them apart.

        On a circle at one speed a DVL that sits elsewhere looks like a turned one, and σ of a model that takes the
        lever arm as known is worth nothing.
        """
        posterior = self.posterior
        if posterior is None or posterior.by_lever_arm.max() < EXTENDED_FROM:
            return ""
        return _turns_in_words(posterior)

    def remember(self, from_ns: int) -> None:
        """Keep the state as of now, for `remembered`."""
        used, _, mean_nis, _, _ = self.counts
        state = posterior.state if (posterior := self.posterior) is not None and self.claims else None
        self._remembered.append((from_ns, state, used, used * mean_nis if used else 0.0))

    def remembered(
        self, stamps_ns: Stamps, base: GaussianState, used: Stamps, nis_sum: Array
    ) -> tuple[GaussianState, Stamps, Array]:
        """The state at some stamps (E,); where nothing was claimed that of the model that this extends, extended.

        base: x (E, n), P (E, n, n) of that, used and nis_sum (E,) its counts.
        """
        extended = [self.extended(GaussianState(*each)) for each in zip(*base, strict=True)]
        used, nis_sum = used.copy(), nis_sum.copy()
        at = np.searchsorted([row[0] for row in self._remembered], stamps_ns, side="right") - 1
        for index, row in enumerate(at.tolist()):
            if row >= 0 and (state := self._remembered[row][1]) is not None:
                extended[index] = state
                used[index], nis_sum[index] = self._remembered[row][2:]
        return GaussianState(np.array([s.x for s in extended]), np.array([s.p for s in extended])), used, nis_sum

    def advance(self) -> None:
        """Take the blocks that are complete."""
        aligner = self._aligner
        if self._block_ns is None:
            if aligner.first_ns is None:
                return
            self._block_ns = self._epoch_ns = aligner.first_ns // BLOCK_NS * BLOCK_NS
            self._tell_needed()
        last_ns = aligner.reached_ns - self._wait_ns - BLOCK_NS
        if self._block_ns > last_ns:
            return
        self.take_rows()
        while self._block_ns <= last_ns:
            self._look_for_a_new_day(self._block_ns)
            if self._take_block(self._block_ns):
                self._changed = True
                self._on_block(self._block_ns + BLOCK_NS + self._wait_ns)
            self._block_ns = self._next_block(self._block_ns, last_ns)
        self._tell_needed()
        self._dvl.forget_before(
            self._dvl.begin
            + int(np.searchsorted(self._dvl.stamps_ns[self._dvl.begin : self._dvl.size], self._block_ns - MARGIN_NS))
        )

    def _look_for_a_new_day(self, block_ns: int) -> None:
        """Start a new day with the block that may have references of its first DVL sample, however late that is."""
        starts_ns = self._aligner.day_starts_ns
        while len(self._day_starts_ns) < len(starts_ns):
            if starts_ns[len(self._day_starts_ns)] - LONGEST_DELAY_NS >= block_ns + BLOCK_NS:
                return
            try:
                self._bank.end_day()
            except np.linalg.LinAlgError:  # numbers that ran away: as if it were the same day
                self.restarted += 1
            self._reference_clock.start()
            self._suggestion = None
            self._day_starts_ns.append(block_ns)
            self._changed = True

    def _next_block(self, block_ns: int, last_ns: int) -> int:
        """The next block that has a reference; else the first one that is not complete."""
        track = self._aligner.reference
        stamps_ns = track.stamps_ns[track.begin : track.size]
        at = int(np.searchsorted(stamps_ns, block_ns + BLOCK_NS))
        incomplete_ns = last_ns // BLOCK_NS * BLOCK_NS + BLOCK_NS
        if at == len(stamps_ns):
            return incomplete_ns
        return min(int(stamps_ns[at]) // BLOCK_NS * BLOCK_NS, incomplete_ns)

    def _tell_needed(self) -> None:
        assert self._block_ns is not None
        for track in (self._aligner.reference, self._aligner.imu):
            track.needed_from_ns = self._block_ns - MARGIN_NS

    def take_rows(self) -> None:
        """Copy the DVL samples that are judged, before the aligner forgets them."""
        aligner, rows = self._aligner, self._aligner.rows
        first, end = self.n_taken - rows.base, aligner.n_judged - rows.base
        if end <= first:
            return
        at = np.flatnonzero((rows.verdict[first:end] != Verdict.FROZEN) & ~rows.late[first:end]) + first
        slots = self._dvl.extend(len(at))
        self._dvl.stamps_ns[slots] = rows.stamps_ns[at]
        self._dvl.velocity[slots] = rows.velocity_dvl[at]
        self._dvl.covariance[slots] = rows.covariance[at]
        self._dvl.contradicted[slots] = False
        self.n_taken = aligner.n_judged

    def _seconds(self, stamps_ns: Stamps) -> Array:
        seconds: Array = (stamps_ns - self._epoch_ns) * 1e-9
        return seconds

    def _take_block(self, block_ns: int) -> bool:
        """Take a block; whether it has samples."""
        end_ns = block_ns + BLOCK_NS
        reference, stamps_ns = self._reference(block_ns, end_ns)
        if not len(stamps_ns) or self._dvl_is_silent(end_ns):
            return False
        self._suggestion = None
        self._claiming += int(np.count_nonzero(reference.claimed))
        self._not_claiming += int(np.count_nonzero(~reference.claimed))
        dvl, noise_dvl, slots = self._dvl_columns(block_ns - MARGIN_NS, end_ns + MARGIN_NS)
        imu = self._imu(block_ns - MARGIN_NS, end_ns + MARGIN_NS)
        self._compare_coarsely(block_ns, end_ns, dvl, imu)
        from_s, to_s = self._seconds(np.array([block_ns, end_ns])).tolist()
        binned_dvl, turns = DvlColumns(*binned(*dvl)), TurnRates.of(imu)
        rows = None
        if len(dvl.times) >= 6 and len(imu.times) >= 2:
            rows_of = partial(self._rows, reference=reference, imu=imu, turns=turns, noise_dvl=noise_dvl)
            if _is_slow(dvl.times):
                good, rows = without_contradicted(dvl, reference.times, rows_of, self._bank.misfits)
                self._leave_out(slots[~good])
                dvl = binned_dvl = DvlColumns(*(column[good] for column in dvl))
            else:
                rows = rows_of(binned_dvl)
        if self._kept is not None:
            self._kept.append(Kept.between(from_s, to_s, dvl, noise_dvl, reference, imu))
        if rows is None:
            return False
        used = self._bank.add(rows, stamps_ns[rows.index], BLOCK_NS * 1e-9)
        self._reference_clock.add(
            binned_dvl, reference.part(rows.index[used]), imu, turns, noise_dvl, self._bank.likeliest_delay
        )
        return len(rows) > 0

    def _rows(
        self, dvl: DvlColumns, *, reference: ReferenceColumns, imu: ImuColumns, turns: TurnRates, noise_dvl: Array
    ) -> DelayedRows:
        p = self._parameters
        return delayed_rows(
            dvl,
            reference,
            imu,
            turns,
            noise_dvl=noise_dvl,
            template=self._template,
            lever_arm=self._lever_arm,
            min_speed=p.min_speed,
            max_turn_rate=p.max_turn_rate,
            imu_gap_s=p.imu_timeout,
        )

    def _leave_out(self, slots: Index) -> None:
        """Leave some DVL samples out from now on, and where they are kept for verification already."""
        self._dvl.contradicted[slots] = True
        self._spikes += len(slots)
        if self._kept and len(slots):
            last = self._kept[-1]
            good = ~np.isin(last.dvl.times, self._seconds(self._dvl.stamps_ns[slots]))
            self._kept[-1] = last._replace(dvl=DvlColumns(*(column[good] for column in last.dvl)))

    def _dvl_is_silent(self, stamp_ns: int) -> bool:
        """Whether the DVL stops here for so long that tracks forget what was before."""
        stamps_ns = self._dvl.stamps_ns[self._dvl.begin : self._dvl.size]
        at = int(np.searchsorted(stamps_ns, stamp_ns))
        return at == len(stamps_ns) or int(stamps_ns[at]) - stamp_ns > LONGEST_NS // 2

    def _compare_coarsely(self, block_ns: int, end_ns: int, dvl: DvlColumns, imu: ImuColumns) -> None:
        """Give the block's references, as their messages had them, to `_coarse`."""
        track = self._aligner.reference
        at = track.in_time(block_ns, end_ns)
        at = at[thinned(track.stamps_ns[at])]
        times, raw = self._seconds(track.stamps_ns[at]), track.values[at, :3]
        if len(dvl.times) < 2:
            return
        late = times[:, None] + DELAYS_S
        velocity = np.stack([np.interp(late, dvl.times, column) for column in dvl.velocity.T], axis=2)
        rotation, oriented = attitude_at(imu, times, self._parameters.imu_timeout)
        rates = None
        if len(imu.times) > 1:
            rates = np.column_stack([np.interp(times, imu.times, column) for column in imu.angular_velocity.T])
        inside = (late[:, 0] >= dvl.times[0]) & (late[:, -1] <= dvl.times[-1])
        moving = inside & ((raw**2).sum(axis=1) >= self._parameters.min_speed**2)
        unmeasured = track.unmeasured[at] != 0
        for code in set(track.frames[at].tolist()):
            for has_attitude in (True, False):
                use = moving & (track.frames[at] == code) & (oriented == has_attitude) & ~unmeasured
                if use.any():
                    attitude = rotation[use] if has_attitude else None
                    self._coarse.add(
                        FRAMES[code], raw[use], attitude, velocity[use], None if rates is None else rates[use]
                    )

    def _dvl_columns(self, from_ns: int, to_ns: int) -> tuple[DvlColumns, Array, Index]:
        """DVL samples between two stamps, MARGIN_NS about a block, their mean covariance (3, 3), and their slots."""
        table = self._dvl
        rows = table.between(table.stamps_ns, from_ns, to_ns)
        at = np.flatnonzero(~table.contradicted[rows]) + rows.start
        # one bends the curve that is read between samples for all references about it, and no gate would see that
        good = _good(table.stamps_ns[at], table.velocity[at])
        spikes = table.stamps_ns[at[~good]]
        at = at[good]
        self._spikes += int(np.count_nonzero((spikes >= from_ns + MARGIN_NS) & (spikes < to_ns - MARGIN_NS)))
        covariance = table.covariance[at]
        given = ~np.isnan(covariance[:, 0, 0])
        noise: Array = np.eye(3) * self._parameters.gnss_free_std**2
        if given.any() and self._parameters.use_message_covariance:
            noise = covariance[given].mean(axis=0)
        return DvlColumns(self._seconds(table.stamps_ns[at]), table.velocity[at]), noise, at

    def _imu(self, from_ns: int, to_ns: int) -> ImuColumns:
        track = self._aligner.imu
        at = track.in_time(from_ns, to_ns)
        values = track.values[at]
        rates = np.where(np.abs(values[:, 4:7]) < FASTEST_TURN, values[:, 4:7], np.nan)
        return ImuColumns(self._seconds(track.stamps_ns[at]), values[:, :4], rates)

    def _reference(self, from_ns: int, to_ns: int) -> tuple[ReferenceColumns, Stamps]:
        """References between two stamps, thinned, and their stamps."""
        track = self._aligner.reference
        at = track.in_time(from_ns, to_ns)
        at = at[thinned(track.stamps_ns[at])]
        around = track.in_time(from_ns - MARGIN_NS, to_ns + MARGIN_NS)
        measured = (track.unmeasured[around, None] & _BITS) == 0
        good = np.isin(at, around[_good(track.stamps_ns[around], np.where(measured, track.values[around, :3], 0.0))])
        self._spikes += int(np.count_nonzero(~good))
        at = at[good]
        values, frames = track.values[at], track.frames[at]
        noise = values[:, 3:12].reshape(-1, 3, 3)
        given = ~np.isnan(noise[:, 0, 0]) & self._parameters.use_message_covariance
        noise = np.where(given[:, None, None], noise, np.eye(3) * self._parameters.gnss_aided_std**2)
        velocity, ned = values[:, :3], frames == _NED
        if track.unmeasured[at].any():
            axes = (track.unmeasured[at, None] & _BITS) != 0
            velocity = np.where(axes, 0.0, velocity)
            noise = np.where(axes[:, :, None] | axes[:, None, :], 0.0, noise) + np.eye(3) * np.where(
                axes[:, :, None], NOT_MEASURED, 0.0
            )
        if ned.any():
            velocity = np.where(ned[:, None], velocity @ ENU_FROM_NED.T, velocity)
            noise = np.where(ned[:, None, None], ENU_FROM_NED @ noise @ ENU_FROM_NED.T, noise)
        stamps_ns = track.stamps_ns[at].copy()
        return ReferenceColumns(self._seconds(stamps_ns), velocity, noise, frames == _BODY, given), stamps_ns

    @property
    def reference_claims(self) -> bool:
        """Whether it is the reference's messages that say how noisy it is, and no parameter."""
        return self._claiming > self._not_claiming

    @property
    def recording(self) -> tuple[Recording, int] | None:
        """All that was kept for verification, and the stamp (ns) of its time 0; None for nothing."""
        return (Recording.of(self._kept), self._epoch_ns) if self._kept else None

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return 1 + len(self._day_starts_ns)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Which day (N,) stamps are of, from 0."""
        return np.searchsorted(np.array(self._day_starts_ns, dtype=np.int64), stamps_ns, side="right")

    @property
    def days(self) -> list[DayState]:
        """What was found on each day, where there are more than one and lever arm or delay are claimed; else none."""
        if not self._day_starts_ns or not self.claims or self.posterior is None:
            return []
        return [*self._bank.days(), DayState(self.posterior.state, self.posterior.shown)]

    def without_folds(self) -> list[list[GaussianState]]:
        """For every fold the states of every day had it not seen that fold."""
        return self._bank.without_folds()

    def held_out_error(self) -> HeldOutError | None:
        """Velocity error on every fold by the state that has not seen it; None if there is too little to judge by."""
        if self.recording is None:
            return None
        recording, epoch_ns = self.recording
        stamps_ns = np.round(recording.dvl.times * 1e9).astype(np.int64) + epoch_ns
        return held_out_error(recording, stamps_ns, self.day_of(stamps_ns), self._bank, self._parameters)


def _turns_in_words(posterior: Posterior) -> str:
    index = int(np.argmax(posterior.by_lever_arm))
    angle, turn = ("roll", "pitch", "yaw")[index], math.degrees(posterior.turned[index])
    return f"in this motion 0.1 m of it is {0.1 * turn:.1f}° of {angle}"


def _is_slow(times: Array) -> bool:
    """Whether samples at times (N,) s are so far apart that a vehicle turns between them."""
    return len(times) > 1 and float(median(np.diff(times))) > SLOW_S


def _good(stamps_ns: Stamps, velocity: Array) -> Mask:
    """Which samples of a stream are no spikes, (N,) of (N,) ns and (N, 3) m/s."""
    smallest = LEAST_SCATTER_SLOW_MPS if _is_slow(1e-9 * stamps_ns) else LEAST_SCATTER_MPS
    return without_spikes(velocity, smallest=smallest, also_at_ends=True)
