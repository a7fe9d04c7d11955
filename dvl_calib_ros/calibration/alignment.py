"""From three streams of messages to DVL samples in order, with what the others say at their times.

    DVL ──────► valid? ─► in order? ─► a row ─► gates ─────────────► usable?
    IMU ──────► valid? ─► in order? ─► track ──► attitude, rates of the row
    reference ► valid? ─► in order? ─► track ──────────────► reference of the row

A row waits for attitude, and then for its reference, no longer than they can still come (streams.py), in order; models
that need neither do not wait. `Aligner` takes samples one by one (live) or as columns (recordings). Columns with
a jump of time among them, rare as they are, go row by row. So every rule has one meaning, and test_alignment.py holds
both ways equal. (Long, because each rule stands beside its twin.)
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .clocks import SECOND_NS, Clocks
from .frames import Array, Quaternion, Vector, slerp, slerps
from .gates import Gates, PriorWindow
from .models import Needs
from .new_days import SHORTEST_PAUSE_NS, NewDays
from .parameters import XY, XYZ, Parameters
from .rows import NO_DECISIONS, Decisions, Events, OrderedStreams, Rows, ScreenedStreams
from .samples import (
    FRAME_CODES,
    FRAMES,
    AlignedBlock,
    DvlSample,
    ImuSample,
    Index,
    Mask,
    Pairing,
    ReferenceSample,
    Stamps,
    Stream,
    Streams,
    VelocityFrame,
    Verdict,
)
from .screening import (
    ALL_AXES,
    VERTICAL,
    CovarianceScreen,
    are_valid_velocities,
    is_valid_rate,
    is_valid_velocity,
    screen_columns,
    unit_quaternion,
    unit_quaternions,
    valid_rates,
)
from .streams import LONG_AGO_NS, Bracket, Order, Sequencer, Track

# A DVL that sends nothing for so long, and for so many times its shortest interval, has dropped out.
DROPOUT_NS = SECOND_NS
DROPOUT_INTERVALS = 3
# How far a DVL may lag GNSS and IMU and still find its partners, beyond what pairing waits for.
RETENTION_NS = 10 * SECOND_NS
# A DVL whose stamps are off by seconds, which G2 finds, lags others by as much, or they lag it.
WRONG_CLOCK_NS = 4 * SECOND_NS
NEVER_NS = 2**63 - 1
# From so many messages on columns are faster.
COLUMNS_FROM = 64
# The past of GNSS and IMU is looked through for what may go once in so many live samples.
FORGET_EVERY = 256
_BODY = FRAME_CODES[VelocityFrame.BODY]
_NO_ATTITUDE = (math.nan,) * 7


class Aligner:
    """Aligns three streams; `rows` are its outcome.

    n_judged, n_oriented, n_paired: numbers of the first row whose verdict, attitude or reference is not decided yet;
    the verdict may wait for the angular velocity. reference, imu: their samples of late. lag_ns: by how much (in
    stamps) one stream may lag another, a wrong clock included. given: by need, how many rows there are so far for
    models that have it. day_rows, day_starts_ns: numbers and stamps of rows that a new day begins with. tally: by
    stream and for pairing, see `Calibrator.counts`. on_restart: told by how much (s) the DVL's stamps went back when
    all is to start anew; everything here has then been forgotten. before_clearing: called before the past of a track is
    forgotten whose stamps went back, so that who needs it takes it then, whatever stretch it came in.
    """

    def __init__(
        self,
        parameters: Parameters,
        prior_sway_heave: tuple[float, float] | None = None,
        on_restart: Callable[[float], None] = lambda _: None,
        recordings_ns: Sequence[int] = (),
    ) -> None:
        self.parameters = parameters
        self._prior_sway_heave = prior_sway_heave
        self._on_restart = on_restart
        self.before_clearing: Callable[[], None] = lambda: None
        self._clocks = Clocks.of(parameters)
        self._new_days = NewDays(round(parameters.new_day_after * 1e9), recordings_ns)
        east, north = parameters.reference_velocity_offset
        offsets = {VelocityFrame.ENU: (east, north, 0.0), VelocityFrame.NED: (north, east, 0.0)}
        self._velocity_offset = np.array([offsets.get(frame, (0.0, 0.0, 0.0)) for frame in FRAMES])
        self._has_lever_arm = any(parameters.lever_arm)
        self._needs_turn_rate = self._has_lever_arm or parameters.max_turn_rate > 0.0
        self._dvl_covariance, self._reference_covariance = CovarianceScreen(), CovarianceScreen()
        self._max_jump_ns = round(parameters.max_time_jump * 1e9)
        self.reset()

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Forget all samples."""
        p = self.parameters
        self._first_stamp_ns: int | None = None
        # one stream that is stamped late lags the others by as much once that is put right
        latency_ns = round(p.max_latency * 1e9) + self._clocks.spread_ns
        self.lag_ns = latency_ns + WRONG_CLOCK_NS
        gnss_ns, imu_ns = round(p.gnss_timeout * 1e9), round(p.imu_timeout * 1e9)
        retention_ns = RETENTION_NS + gnss_ns + imu_ns + latency_ns
        self.orders: dict[Stream, Sequencer[Any]] = {stream: Sequencer(self._max_jump_ns) for stream in Stream}
        self._dvl_order = self.orders[Stream.DVL]  # asked with every sample
        self.reference = Track(gnss_ns, latency_ns, retention_ns)
        self.imu = Track(imu_ns, latency_ns, retention_ns)
        self._tracks = {Stream.REFERENCE: self.reference, Stream.IMU: self.imu}
        self.tally: dict[str, Counter[str]] = {
            name: Counter() for name in (*(each.value for each in Stream), "pairing")
        }
        # those of a stream's counters that refused messages are under
        self.refused_as: dict[str, set[str]] = {stream.value: set() for stream in Stream}
        # streams that still bring samples from before a restart of the DVL's stamps
        self._before_restart: set[Stream] = set()
        self._n_messages = 0
        self._forget_dvl()

    def _forget_dvl(self) -> None:
        self.rows = Rows()
        self.n_judged = self.n_oriented = self.n_paired = 0
        self.given = dict.fromkeys(Needs, 0)
        self.gates = Gates()
        self.prior = PriorWindow(self.parameters, self._prior_sway_heave)
        self._vertical_seen = False
        # what the first waiting rows wait for: samples of these streams, or any stream's stamp reaching this
        self._waits_for: set[Track] = set()
        self._deadline_ns = NEVER_NS
        self._row_of_held = 0
        self.reached_ns = LONG_AGO_NS  # the newest horizon so far
        self.first_ns: int | None = None
        self.day_rows: list[int] = []
        self.day_starts_ns: list[int] = []
        self.last_ns: int | None = None
        self._shortest_interval_ns = NEVER_NS
        self.longest_dropout_ns = 0
        self.decided_ns = LONG_AGO_NS  # stamp of the newest row whose reference is decided

    @property
    def newest_ns(self) -> dict[str, int | None]:
        """Stamp of the newest sample of each stream; None before the first."""
        return {"dvl": self.last_ns, "reference": self.reference.newest_ns, "imu": self.imu.newest_ns}

    def latest_angular_velocity(self, stamp_ns: int) -> Vector | None:
        """Newest angular velocity (rad/s, body), if not older than imu_timeout; None where the IMU gives none."""
        newest_ns = self.imu.newest_ns
        if newest_ns is None or abs(stamp_ns - newest_ns) > self.parameters.imu_timeout * 1e9:
            return None
        x, y, z = self.imu.values[self.imu.size - 1, 4:7].tolist()
        return None if math.isnan(x) else (x, y, z)

    # ------------------------------------------------------------------ one by one

    def refuse(self, stream: Stream, reason: str) -> None:
        """Count a message of a stream that is no sample, and why."""
        self.refused_as[stream.value].add(reason)
        self.tally[stream.value]["received"] += 1
        self.tally[stream.value][reason] += 1
        self._n_messages += stream is Stream.DVL

    def take_dvl(self, sample: DvlSample) -> DvlSample | None:
        """Take a DVL sample; None unless it is valid and in order, else as it goes on: in time, covariance screened."""
        tally = self.tally["dvl"]
        tally["received"] += 1
        row = self._n_messages
        self._n_messages += 1
        valid, covariance, unmeasured = self._dvl_covariance(sample.covariance)
        if not valid or unmeasured or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return None
        if self._first_stamp_ns is None:
            self._first_stamp_ns = sample.stamp_ns
        true_ns = self._clocks.dvl(sample.stamp_ns, self._first_stamp_ns)
        sample = DvlSample(true_ns, sample.velocity, covariance)
        order = self._dvl_order
        if order.goes_on(sample.stamp_ns):
            self._append_row(sample, row)
        else:
            kind, admitted = order.admit(sample)
            self._count_order(tally, kind)
            if kind is Order.CONFIRMED_RESTART:
                self._restart(admitted[0].stamp_ns)
                row = 1
            elif kind is Order.HELD:
                self._row_of_held = row
            for one, number in zip(admitted, (self._row_of_held, row)[-len(admitted) :], strict=False):
                self._append_row(one, number)
            if not admitted:
                return None
        self._advance()
        return sample

    def _append_row(self, sample: DvlSample, row: int) -> None:
        stamp_ns, velocity, covariance = sample
        interval_ns = 0 if self.last_ns is None else stamp_ns - self.last_ns
        self.last_ns = stamp_ns
        late = self._is_late(stamp_ns)
        if self.first_ns is None:
            self.first_ns = stamp_ns
        else:
            self._shortest_interval_ns = shortest_ns = min(self._shortest_interval_ns, interval_ns)
            if interval_ns > SHORTEST_PAUSE_NS and self._new_days.begins(stamp_ns, interval_ns):
                self.day_rows.append(self.rows.end)
                self.day_starts_ns.append(stamp_ns)
            if interval_ns > DROPOUT_NS and interval_ns > DROPOUT_INTERVALS * shortest_ns:
                self.tally["dvl"]["dropouts"] += 1
                self.longest_dropout_ns = max(self.longest_dropout_ns, interval_ns)
        rows = self.rows
        slot = rows.extend(1).start
        rows.stamps_ns[slot] = stamp_ns
        rows.late[slot] = late
        rows.row[slot] = row
        rows.velocity_dvl[slot] = velocity
        rows.covariance[slot] = math.nan if covariance is None else covariance
        rows.interval_ns[slot] = interval_ns
        rows.await_partners(slot)
        if not self._needs_turn_rate:
            self._judge(slot, velocity, None)

    def _judge(self, slot: int, velocity: Vector, angular_velocity: Vector | None) -> None:
        """Decide on a row's verdict, and count it."""
        rows = self.rows
        verdict = self.gates.judge(velocity, angular_velocity, self.parameters)
        rows.verdict[slot] = verdict
        self.n_judged += 1
        if verdict:
            self.tally["dvl"][Verdict.NAMES[verdict]] += 1
            return
        if self._has_lever_arm and angular_velocity is None:
            self.tally["dvl"]["lever_arm_uncompensated"] += 1
        rows.prior_known[slot] = self.prior.known_at(int(rows.stamps_ns[slot]), velocity)
        self.given[Needs.NOTHING] += 1

    def take_reference(self, sample: ReferenceSample) -> None:
        """Take a reference (GNSS) velocity."""
        tally = self.tally["reference"]
        tally["received"] += 1
        valid, _, unmeasured = self._reference_covariance(sample.covariance)
        if not valid or unmeasured == ALL_AXES or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return
        stamp_ns = sample.stamp_ns - self._clocks.reference_ns
        if stamp_ns < self.decided_ns:
            tally["late"] += 1  # a DVL sample has gone on without it: max_latency is too short
        if stamp_ns != sample.stamp_ns:
            sample = sample._replace(stamp_ns=stamp_ns)
        self._keep(Stream.REFERENCE, sample)

    def take_imu(self, sample: ImuSample) -> None:
        """Take attitude and angular velocity."""
        tally = self.tally["imu"]
        tally["received"] += 1
        stamp_ns, given, angular_velocity = sample
        orientation = unit_quaternion(given)
        if angular_velocity is not None and not is_valid_rate(angular_velocity):
            angular_velocity = None
        if orientation is None and angular_velocity is None:
            tally["invalid"] += 1
            return
        stamp_ns -= self._clocks.imu_ns
        if (stamp_ns, orientation, angular_velocity) != sample:
            sample = ImuSample(stamp_ns, orientation, angular_velocity)
        self._keep(Stream.IMU, sample)

    def _keep(self, stream: Stream, sample: ReferenceSample | ImuSample) -> None:
        """Put a sample on its track if its stamp allows, and let waiting rows go on if it decides them."""
        track = self._tracks[stream]
        if not self._before_restart and self.orders[stream].goes_on(sample.stamp_ns):
            self._append(track, sample)
        elif not self._keep_unusual(stream, track, sample):
            return
        if sample.stamp_ns >= self._deadline_ns or track in self._waits_for:
            self._advance()

    def _keep_unusual(self, stream: Stream, track: Track, sample: ReferenceSample | ImuSample) -> bool:
        """`_keep` for what is not simply the next sample; whether the track has grown."""
        order, admitted = self.orders[stream].admit(sample)
        self._count_order(self.tally[stream.value], order)
        if order is Order.CONFIRMED_RESTART:
            self.before_clearing()
            track.clear()
            self._before_restart.discard(stream)
        if stream in self._before_restart and admitted:
            dvl_ns = self.orders[Stream.DVL].last_ns or 0
            if admitted[-1].stamp_ns > dvl_ns + self._max_jump_ns:
                self.tally[stream.value]["before_restart"] += len(admitted)
                return False
            self._before_restart.discard(stream)
        for one in admitted:
            self._append(track, one)
        return bool(admitted)

    def _append(self, track: Track, sample: ReferenceSample | ImuSample) -> None:
        slot = track.append(sample.stamp_ns)
        track.late[slot] = self._is_late(sample.stamp_ns)
        values = track.values[slot]
        if isinstance(sample, ImuSample):
            values[:4] = math.nan if sample.orientation is None else sample.orientation
            values[4:7] = math.nan if sample.angular_velocity is None else sample.angular_velocity
        else:
            covariance = self._reference_covariance(sample.covariance)
            values[:3] = sample.velocity
            values[3:] = math.nan if covariance.covariance is None else covariance.covariance.ravel()
            track.frames[slot] = FRAME_CODES[sample.frame]
            values[:3] -= self._velocity_offset[track.frames[slot]]
            self._vertical_seen = self._vertical_seen or sample.velocity[2] != 0.0
            track.unmeasured[slot] = covariance.unmeasured | self._never_measured(self._vertical_seen)
        if slot % FORGET_EVERY == 0:
            track.forget_old()

    def _never_measured(self, vertical_seen: bool) -> int:
        """The axes, as bits, that are not measured whatever the covariances say."""
        axes = self.parameters.gnss_axes
        return 0 if axes == XYZ or (vertical_seen and axes != XY) else VERTICAL

    @staticmethod
    def _count_order(tally: Counter[str], order: Order) -> None:
        if order in (Order.DUPLICATE, Order.OUT_OF_ORDER):
            tally[order.value] += 1

    def _restart(self, stamp_ns: int) -> None:
        """DVL stamps went back: a bag loops, or the clock was set. Start anew with this sample."""
        back_s = ((self.last_ns or stamp_ns) - stamp_ns) * 1e-9
        self.tally["dvl"] = Counter(received=2)  # the two samples that showed it
        for name in ("reference", "imu", "pairing"):
            self.tally[name].clear()
        self.orders[Stream.DVL].stray = 0
        self._forget_dvl()
        self._row_of_held, self._n_messages = 0, 2
        # a stream that has not gone back yet brings what must not be paired with what comes now
        for stream, track in self._tracks.items():
            if track.newest_ns is not None and track.newest_ns > stamp_ns + self._max_jump_ns:
                track.clear()
                self._before_restart.add(stream)
        self._on_restart(back_s)

    def _advance(self) -> None:
        """Let rows go on as far as their partners are decided; note what the next ones wait for."""
        rows, end = self.rows, self.rows.end
        horizon_ns = self.horizon_ns
        self._waits_for.clear()
        self._deadline_ns = NEVER_NS
        while self.n_oriented < end:
            slot = self.n_oriented - rows.base
            if not self._is_decided(self.imu, int(rows.stamps_ns[slot]), horizon_ns):
                break
            self.n_oriented += 1
            self._orient(slot)
        while self.n_paired < (self.n_oriented if self._needs_turn_rate else end):
            slot = self.n_paired - rows.base
            stamp_ns = int(rows.stamps_ns[slot])
            if not self._is_decided(self.reference, stamp_ns, horizon_ns):
                break
            bracket = self.reference.bracket(stamp_ns)
            in_earth_frame = bracket is not None and self.reference.frames[bracket.after] != _BODY
            if in_earth_frame and self.n_paired >= self.n_oriented:
                break
            self.n_paired += 1
            self.decided_ns = stamp_ns
            self._pair(slot, bracket)

    @property
    def horizon_ns(self) -> int:
        """Newest stamp of any stream that keeps the DVL's time.

        One whose clock is far ahead would say of every DVL sample that nothing can come for it any more.
        """
        horizon_ns = dvl_ns = self._dvl_order.last_ns or 0
        for track in (self.reference, self.imu):
            newest_ns = track.newest_ns
            if newest_ns is not None and horizon_ns < newest_ns <= dvl_ns + self._max_jump_ns:
                horizon_ns = newest_ns
        return horizon_ns

    def _is_late(self, stamp_ns: int) -> bool:
        """Whether a sample that has just come lags other streams by more than one may even if its clock is wrong."""
        self.reached_ns = max(self.reached_ns, self.horizon_ns)
        return stamp_ns < self.reached_ns - self.lag_ns

    def _is_decided(self, track: Track, stamp_ns: int, horizon_ns: int) -> bool:
        """Whether a row need not wait for a track any more; if it must, note for what and until when."""
        if track.decided(stamp_ns, horizon_ns):
            return True
        self._waits_for.add(track)
        self._deadline_ns = min(self._deadline_ns, track.deadline_ns(stamp_ns))
        return False

    def _orient(self, slot: int) -> None:
        rows = self.rows
        bracket = self.imu.bracket(int(rows.stamps_ns[slot]))
        attitude = _NO_ATTITUDE if bracket is None else _interpolated_attitude(self.imu, bracket)
        rows.attitude[slot] = attitude
        has_rate = attitude[4] == attitude[4]  # else nan
        if self._needs_turn_rate:
            x, y, z = rows.velocity_dvl[slot].tolist()
            self._judge(slot, (x, y, z), (attitude[4], attitude[5], attitude[6]) if has_rate else None)
        if rows.verdict[slot] == Verdict.USED:
            oriented = has_rate and attitude[0] == attitude[0]
            self.tally["pairing"]["oriented" if oriented else "not_oriented"] += 1
            self.given[Needs.ATTITUDE] += oriented

    def _pair(self, slot: int, bracket: Bracket | None) -> None:
        rows, tally = self.rows, self.tally["pairing"]
        pairing = Pairing.UNPAIRED if bracket is None else self._pair_with(slot, bracket)
        rows.pairing[slot] = pairing
        tally["paired" if pairing == Pairing.PAIRED else "unpaired"] += 1
        if pairing == Pairing.WITHOUT_ATTITUDE:
            tally["without_attitude"] += 1
        if pairing == Pairing.PAIRED and rows.verdict[slot] == Verdict.USED:
            self.given[Needs.REFERENCE] += 1

    def _pair_with(self, slot: int, bracket: Bracket) -> int:
        rows, track = self.rows, self.reference
        before, after, fraction = bracket
        values, unmeasured, frame = track.values[after], track.unmeasured[after], track.frames[after]
        weight = 1.0
        if before >= 0:
            before_ns, after_ns = int(track.stamps_ns[before]), int(track.stamps_ns[after])
            interval_ns = int(rows.interval_ns[slot])
            if interval_ns > 0:
                weight = 1.0 / max(1, round((after_ns - before_ns) / interval_ns))
            if fraction != 1.0:
                if track.frames[before] != frame:
                    return Pairing.UNPAIRED
                # The mean of two samples is less noisy than each, but its neighbours share them: over a run a
                # reference sample carries its own information once, which is what the plain mean of the covariances
                # gives.
                values = track.values[before] + (values - track.values[before]) * fraction
                unmeasured = unmeasured | track.unmeasured[before]
        if frame != _BODY and np.isnan(rows.attitude[slot, 0]):
            return Pairing.WITHOUT_ATTITUDE
        rows.reference[slot] = values
        rows.frames[slot] = frame
        rows.unmeasured[slot] = unmeasured
        rows.weight[slot] = weight
        return Pairing.PAIRED

    def forget_old(self) -> None:
        """Forget of reference and IMU what nobody asks for any more."""
        self.reference.forget_old()
        self.imu.forget_old()

    # ------------------------------------------------------------------ columns

    def take(self, streams: Streams) -> None:
        """Take a stretch of all streams, as if its rows came one by one in their order of arrival."""
        few = sum(map(len, streams)) < COLUMNS_FROM
        screened = None if few or self._before_restart else self._screened(streams)
        chunk = None if screened is None else self._ordered(screened)
        if screened is None or chunk is None or not self._take_ordered(screened, chunk):
            self._take_rows(streams)

    def _take_rows(self, streams: Streams) -> None:
        take = {Stream.DVL: self.take_dvl, Stream.REFERENCE: self.take_reference, Stream.IMU: self.take_imu}
        for stream, row in streams.in_order():
            if isinstance(row, str):
                self.refuse(stream, row)
            else:
                take[stream](row)  # type: ignore[operator]

    def _screened(self, streams: Streams) -> ScreenedStreams:
        max_speed = self.parameters.max_speed
        dvl, reference, imu = streams
        of_dvl, of_reference = screen_columns(dvl.covariances), screen_columns(reference.covariances)
        orientation, rates = unit_quaternions(imu.orientation), valid_rates(imu.angular_velocity)
        return ScreenedStreams(
            streams,
            (dvl.refused == 0) & of_dvl.valid & (of_dvl.unmeasured == 0) & are_valid_velocities(dvl.values, max_speed),
            (reference.refused == 0)
            & of_reference.valid
            & (of_reference.unmeasured != ALL_AXES)
            & are_valid_velocities(reference.values, max_speed),
            (imu.refused == 0) & ~(np.isnan(orientation[:, 0]) & np.isnan(rates[:, 0])),
            of_dvl.covariance,
            np.concatenate([reference.values, of_reference.covariance.reshape(-1, 9)], axis=1),
            of_reference.unmeasured,
            np.concatenate([orientation, rates], axis=1),
        )

    def _ordered(self, screened: ScreenedStreams) -> OrderedStreams | None:
        """The rows that are let through; None if a stream has a jump."""
        streams = screened.streams
        dvl_ns = streams.dvl.stamps_ns[screened.dvl]
        if len(dvl_ns):
            first_ns = int(dvl_ns[0]) if self._first_stamp_ns is None else self._first_stamp_ns
            dvl_ns = self._clocks.dvl(dvl_ns, first_ns)
        reference_ns = streams.reference.stamps_ns[screened.reference] - self._clocks.reference_ns
        imu_ns = streams.imu.stamps_ns[screened.imu] - self._clocks.imu_ns
        dvl = self.orders[Stream.DVL].admit_columns(dvl_ns)
        reference = self.orders[Stream.REFERENCE].admit_columns(reference_ns)
        imu = self.orders[Stream.IMU].admit_columns(imu_ns)
        if dvl is None or reference is None or imu is None:
            return None
        return OrderedStreams(
            dvl, np.flatnonzero(screened.dvl)[dvl.rows], dvl_ns[dvl.rows],
            reference, np.flatnonzero(screened.reference)[reference.rows], reference_ns[reference.rows],
            imu, np.flatnonzero(screened.imu)[imu.rows], imu_ns[imu.rows],
            streams.reference.frames[screened.reference][reference.rows],
        )  # fmt: skip

    def _take_ordered(self, screened: ScreenedStreams, chunk: OrderedStreams) -> bool:
        """Take columns without jumps; False, and nothing is changed, where rows go on in no simple order.

        That is if the horizon falls back, because a stream that it went by runs away from the DVL, or if rows may get
        their partner by waiting: one whose reference is overdue may, while attitude is waited for, see it come after
        all.
        """
        dvl, reference, imu = screened.streams
        events = Events.of(
            (dvl.arrival[chunk.dvl_at], reference.arrival[chunk.reference_at], imu.arrival[chunk.imu_at]),
            (chunk.dvl_ns, chunk.reference_ns, chunk.imu_ns),
            (self.orders[Stream.DVL].last_ns, self.reference.newest_ns, self.imu.newest_ns),
            self._max_jump_ns,
        )
        if not len(events.arrival):  # nothing that would let rows go on
            self._count_columns(screened, chunk, NO_DECISIONS, events)
            self._n_messages += len(dvl)
            return True
        decisions = None if (np.diff(events.horizon_ns) < 0).any() else self._decisions(chunk, events)
        if decisions is None:
            return False
        self._count_columns(screened, chunk, decisions, events)
        reached_ns = np.maximum(np.maximum.accumulate(events.horizon_ns), self.reached_ns)
        self.reached_ns = int(reached_ns[-1])
        late_before_ns = reached_ns - self.lag_ns
        late = (
            chunk.dvl_ns < late_before_ns[events.dvl_at],
            chunk.reference_ns < late_before_ns[events.reference_at],
            chunk.imu_ns < late_before_ns[events.imu_at],
        )
        self._append_columns(screened, chunk, late)
        n_events = len(events.horizon_ns)
        n_judged, n_oriented, n_paired = self.n_judged, self.n_oriented, self.n_paired
        if not self._needs_turn_rate:
            self._judge_columns(n_judged, self.rows.end)
        known = int(np.searchsorted(decisions.oriented_at, n_events))
        self._orient_columns(n_oriented, events.imu_ns[decisions.oriented_at[:known]])
        known = int(np.searchsorted(decisions.paired_at, n_events))
        self._pair_columns(n_paired, events.reference_ns[decisions.paired_at[:known]])
        self._deadline_ns = LONG_AGO_NS  # what waits now is looked at with the next sample, whatever it is
        return True

    def _decisions(self, chunk: OrderedStreams, events: Events) -> Decisions | None:
        """When the rows that wait, and those that come, are decided."""
        rows, n_events = self.rows, len(events.horizon_ns)
        waiting = min(self.n_oriented, self.n_paired)
        stamps_ns = np.concatenate([rows.stamps_ns[waiting - rows.base : rows.size], chunk.dvl_ns])
        since = np.concatenate([np.zeros(len(stamps_ns) - len(chunk.dvl_ns), dtype=np.intp), events.dvl_at])
        to_orient, to_pair = self.n_oriented - waiting, self.n_paired - waiting
        oriented_at = self.imu.decided_in(
            stamps_ns, since, chunk.imu_ns, events.imu_at, events.imu_ns, events.horizon_ns
        )
        oriented_at[:to_orient] = 0
        oriented_at = np.maximum.accumulate(oriented_at)
        alone = self.reference.decided_in(
            stamps_ns, since, chunk.reference_ns, events.reference_at, events.reference_ns, events.horizon_ns
        )
        paired_at = np.maximum(alone, oriented_at) if self._needs_turn_rate else alone
        # a reference in an earth frame waits for the attitude to turn it by
        in_earth_frame = self._in_earth_frame(chunk, stamps_ns, alone, events)
        if in_earth_frame is not None:
            paired_at = np.where(in_earth_frame, np.maximum(paired_at, oriented_at), paired_at)
        paired_at = np.maximum.accumulate(paired_at[to_pair:])
        alone, stamps_to_pair = alone[to_pair:], stamps_ns[to_pair:]
        delayed = (paired_at > alone) & (paired_at < n_events)
        if delayed.any():
            at, later = alone[delayed], paired_at[delayed]
            given_up = events.reference_ns[at] < stamps_to_pair[delayed]
            if (given_up & (events.reference_ns[later] != events.reference_ns[at])).any():
                return None
        return Decisions(oriented_at[to_orient:], paired_at, stamps_to_pair)

    def _in_earth_frame(
        self, chunk: OrderedStreams, stamps_ns: Stamps, decided_at: Index, events: Events
    ) -> Mask | None:
        """(N,) rows whose reference, once decided, is in an earth frame; None if none can be."""
        track, n_events = self.reference, len(events.horizon_ns)
        frames = np.concatenate([track.frames[track.begin : track.size], chunk.frames])
        if not len(frames) or (frames == _BODY).all():
            return None
        all_ns = np.concatenate([track.stamps_ns[track.begin : track.size], chunk.reference_ns])
        after = np.minimum(np.searchsorted(all_ns, stamps_ns), len(all_ns) - 1)
        near = (after > 0) & (all_ns[after] - all_ns[after - 1] <= track.max_gap_ns)
        newest_ns = events.reference_ns[np.minimum(decided_at, n_events - 1)]
        found = (decided_at < n_events) & (stamps_ns <= newest_ns) & (stamps_ns >= newest_ns - track.retention_ns)
        return found & (near | (all_ns[after] == stamps_ns)) & (frames[after] != _BODY)

    def _count_columns(
        self, screened: ScreenedStreams, chunk: OrderedStreams, decisions: Decisions, events: Events
    ) -> None:
        """Count what is not let through."""
        for block, valid, order in zip(
            screened.streams, screened[1:4], (chunk.dvl, chunk.reference, chunk.imu), strict=True
        ):
            tally = self.tally[block.stream.value]
            tally["received"] += len(block)
            refused = np.bincount(block.refused, minlength=1 + len(block.reasons))[1:]
            for reason, count in zip(block.reasons, refused.tolist(), strict=True):
                if count:
                    self.refused_as[block.stream.value].add(reason)
                    tally[reason] += count
            _add(tally, "invalid", len(block) - int(np.count_nonzero(valid)) - int(refused.sum()))
            _add(tally, "duplicate", order.duplicate)
            _add(tally, "out_of_order", order.out_of_order)
        reference = screened.streams.reference
        stamps_ns = reference.stamps_ns[screened.reference] - self._clocks.reference_ns
        if len(stamps_ns):
            at = np.searchsorted(events.arrival, reference.arrival[screened.reference])
            decided = np.concatenate([[self.decided_ns], decisions.stamps_ns])
            before = decided[np.searchsorted(decisions.paired_at, at)]
            _add(self.tally["reference"], "late", int(np.count_nonzero(stamps_ns < before)))

    def _append_columns(self, screened: ScreenedStreams, chunk: OrderedStreams, late: tuple[Mask, Mask, Mask]) -> None:
        dvl, reference, _ = screened.streams
        if len(chunk.reference_ns):
            track, at = self.reference, chunk.reference_at
            slots = track.extend(len(at))
            track.stamps_ns[slots] = chunk.reference_ns
            track.late[slots] = late[1]
            track.values[slots] = screened.reference_values[at]
            track.frames[slots] = reference.frames[at]
            track.values[slots, :3] -= self._velocity_offset[reference.frames[at]]
            vertical = np.logical_or.accumulate(reference.values[at, 2] != 0.0) | self._vertical_seen
            self._vertical_seen = bool(vertical[-1])
            never = np.where(vertical, self._never_measured(True), self._never_measured(False)).astype(np.uint8)
            track.unmeasured[slots] = screened.reference_unmeasured[at] | never
            self.orders[Stream.REFERENCE].last_ns = int(chunk.reference_ns[-1])
        if len(chunk.imu_ns):
            slots = self.imu.extend(len(chunk.imu_ns))
            self.imu.stamps_ns[slots] = chunk.imu_ns
            self.imu.late[slots] = late[2]
            self.imu.values[slots, :7] = screened.imu_values[chunk.imu_at]
            self.orders[Stream.IMU].last_ns = int(chunk.imu_ns[-1])
        n_messages = self._n_messages
        self._n_messages += len(dvl)
        if not len(chunk.dvl_ns):
            return
        if self._first_stamp_ns is None:
            self._first_stamp_ns = int(dvl.stamps_ns[screened.dvl][0])
        rows, at, stamps_ns = self.rows, chunk.dvl_at, chunk.dvl_ns
        slots = rows.extend(len(at))
        rows.stamps_ns[slots] = stamps_ns
        rows.late[slots] = late[0]
        rows.row[slots] = n_messages + at
        rows.velocity_dvl[slots] = dvl.values[at]
        rows.covariance[slots] = screened.dvl_covariance[at]
        rows.await_partners(slots)
        before_ns = int(stamps_ns[0]) if self.last_ns is None else self.last_ns
        interval_ns = np.diff(stamps_ns, prepend=before_ns)
        for index in np.flatnonzero(interval_ns > SHORTEST_PAUSE_NS).tolist():
            if self._new_days.begins(int(stamps_ns[index]), int(interval_ns[index])):
                self.day_rows.append(rows.base + slots.start + index)
                self.day_starts_ns.append(int(stamps_ns[index]))
        rows.interval_ns[slots] = interval_ns
        self._note_intervals(interval_ns[1:] if self.first_ns is None else interval_ns)
        self.first_ns = int(stamps_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = self.orders[Stream.DVL].last_ns = int(stamps_ns[-1])

    def _note_intervals(self, interval_ns: Stamps) -> None:
        """Count those that are dropouts. `longest_dropout_ns` is the longest since the start or the last restart."""
        if len(interval_ns):
            shortest_ns = np.minimum(np.minimum.accumulate(interval_ns), self._shortest_interval_ns)
            self._shortest_interval_ns = int(shortest_ns[-1])
            dropouts = interval_ns[(interval_ns > DROPOUT_NS) & (interval_ns > DROPOUT_INTERVALS * shortest_ns)]
            if len(dropouts):
                self.tally["dvl"]["dropouts"] += len(dropouts)
                self.longest_dropout_ns = max(self.longest_dropout_ns, int(dropouts.max()))

    def _judge_columns(self, first: int, end: int) -> None:
        if end <= first:
            return
        rows = self.rows
        at = slice(first - rows.base, end - rows.base)
        rates = rows.attitude[at, 4:]
        verdict = self.gates.judge_columns(rows.velocity_dvl[at], rates, self.parameters)
        rows.verdict[at] = verdict
        self.n_judged = end
        for code, count in enumerate(np.bincount(verdict, minlength=len(Verdict.NAMES)).tolist()):
            if code != Verdict.USED:
                _add(self.tally["dvl"], Verdict.NAMES[code], count)
        used = verdict == Verdict.USED
        self.given[Needs.NOTHING] += int(np.count_nonzero(used))
        if self._has_lever_arm:
            _add(self.tally["dvl"], "lever_arm_uncompensated", int(np.count_nonzero(used & np.isnan(rates[:, 0]))))
        known = np.zeros(len(verdict), dtype=bool)
        known[used] = self.prior.known_at_columns(rows.stamps_ns[at][used], rows.velocity_dvl[at][used])
        rows.prior_known[at] = known

    def _orient_columns(self, first: int, newest_ns: Stamps) -> None:
        """Orient rows from one on; newest_ns: stamp of the newest IMU sample when each was decided."""
        n, rows, track = len(newest_ns), self.rows, self.imu
        if not n:
            return
        at = slice(first - rows.base, first + n - rows.base)
        before, after, fraction, found = track.brackets(rows.stamps_ns[at], newest_ns)
        if found.any():
            later = track.values[after, :7]
            earlier = track.values[np.maximum(before, track.begin), :7]
            between = found & (fraction != 1.0)
            values = np.where(found[:, None], later, math.nan)
            values[between, :4] = slerps(earlier[between, :4], later[between, :4], fraction[between])
            step = later[between, 4:] - earlier[between, 4:]
            values[between, 4:] = earlier[between, 4:] + step * fraction[between, None]
            rows.attitude[at] = values
        self.n_oriented = first + n
        if self._needs_turn_rate:
            self._judge_columns(first, first + n)
        usable = rows.verdict[at] == Verdict.USED
        oriented = int(np.count_nonzero(usable & ~np.isnan(rows.attitude[at, 0] + rows.attitude[at, 4])))
        _add(self.tally["pairing"], "oriented", oriented)
        _add(self.tally["pairing"], "not_oriented", int(np.count_nonzero(usable)) - oriented)
        self.given[Needs.ATTITUDE] += oriented

    def _pair_columns(self, first: int, newest_ns: Stamps) -> None:
        """Pair rows from one on; newest_ns: stamp of the newest reference when each was decided."""
        n, rows, track = len(newest_ns), self.rows, self.reference
        if not n:
            return
        at = slice(first - rows.base, first + n - rows.base)
        stamps_ns = rows.stamps_ns[at]
        before, after, fraction, found = track.brackets(stamps_ns, newest_ns)
        pairing = np.full(n, Pairing.UNPAIRED, dtype=np.uint8)
        if found.any():
            has_before = found & (before >= 0)
            before = np.maximum(before, track.begin)
            between = has_before & (fraction != 1.0)
            frame = track.frames[after]
            same_frame = ~between | (track.frames[before] == frame)
            has_attitude = (frame == _BODY) | ~np.isnan(rows.attitude[at, 0])
            pairing[found & same_frame] = Pairing.WITHOUT_ATTITUDE
            pairing[found & same_frame & has_attitude] = Pairing.PAIRED
            earlier, later = track.values[before], track.values[after]
            is_paired = pairing == Pairing.PAIRED
            values = np.where(between[:, None], earlier + (later - earlier) * fraction[:, None], later)
            rows.reference[at] = np.where(is_paired[:, None], values, math.nan)
            rows.frames[at] = np.where(is_paired, frame, 0)
            early, late = track.unmeasured[before], track.unmeasured[after]
            rows.unmeasured[at] = np.where(is_paired, np.where(between, early | late, late), 0)
            before_ns, after_ns = track.stamps_ns[before], track.stamps_ns[after]
            interval_ns = rows.interval_ns[at]
            shared = np.rint((after_ns - before_ns) / np.where(interval_ns > 0, interval_ns, 1))
            is_shared = is_paired & has_before & (interval_ns > 0)
            rows.weight[at] = np.where(is_shared, 1.0 / np.maximum(1.0, shared), 1.0)
        rows.pairing[at] = pairing
        self.n_paired = first + n
        self.decided_ns = int(stamps_ns[-1])
        is_paired = pairing == Pairing.PAIRED
        paired = int(np.count_nonzero(is_paired))
        tally = self.tally["pairing"]
        _add(tally, "paired", paired)
        _add(tally, "unpaired", n - paired)
        _add(tally, "without_attitude", int(np.count_nonzero(pairing == Pairing.WITHOUT_ATTITUDE)))
        self.given[Needs.REFERENCE] += int(np.count_nonzero(is_paired & (rows.verdict[at] == Verdict.USED)))


def align(
    streams: Streams, parameters: Parameters, prior_sway_heave: tuple[float, float] | None = None
) -> tuple[AlignedBlock, Array]:
    """A whole recording, aligned, and the prior sway and heave (2,) m/s that its models have at its end."""
    aligner = Aligner(parameters, prior_sway_heave)
    aligner.take(streams)
    return aligner.rows.block(0, aligner.rows.end), aligner.prior.sway_heave


def _add(tally: Counter[str], name: str, count: int) -> None:
    if count:
        tally[name] += count


def _interpolated_attitude(track: Track, bracket: Bracket) -> tuple[float, ...]:
    """Quaternion and angular velocity at a time, nan where the IMU has nothing to interpolate between."""
    after = track.values[bracket.after, :7].tolist()
    if bracket.fraction == 1.0:
        return tuple(after)
    before, f = track.values[bracket.before, :7].tolist(), bracket.fraction
    earlier: Quaternion = tuple(before[:4])
    later: Quaternion = tuple(after[:4])
    orientation = (math.nan,) * 4 if math.isnan(earlier[0] + later[0]) else slerp(earlier, later, f)
    return (*orientation, *(a + (b - a) * f for a, b in zip(before[4:], after[4:], strict=True)))
