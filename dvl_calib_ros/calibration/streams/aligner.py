"""Alignment of DVL samples with the attitude and reference at their times, in order; counts of all messages.

    DVL ──────► valid? ─► in order? ─► a row ─► gates ─────────────► usable?
    IMU ──────► valid? ─► in order? ─► track ──► attitude, rates of the row
    reference ► valid? ─► in order? ─► track ──────────────► reference of the row

A row waits for attitude, and then for its reference, as long as they can still arrive (stream_order.py); models that
need neither do not wait. Rows are gated, oriented and paired in columns (pairing.py). Validity and order are checked
per column (here) or per sample (live_alignment.py); test_alignment.py holds both equal.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..models import Needs
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.samples import AlignedBlock, Codes, Index, Mask, Stamps, Stream, Streams
from .clock_correction import Clocks
from .live_alignment import LiveAlignment
from .pairing import BODY, Pairer, Rows, add_count
from .screening import ALL_AXES, are_valid_velocities, screen_columns, unit_quaternions, valid_rates
from .stream_order import LONG_AGO_NS, Admitted, Sequencer, Track


class ScreenedStreams(NamedTuple):
    """Columns of all streams, masks of the valid rows, and the screened values.

    reference_values: (J, 12) velocity and covariance. imu_values: (M, 7) quaternion and angular velocity.
    """

    streams: Streams
    dvl: Mask
    reference: Mask
    imu: Mask
    dvl_covariance: Array
    reference_values: Array
    reference_unmeasured: Codes
    imu_values: Array


class OrderedStreams(NamedTuple):
    """Admitted rows of each stream: indices in its block (`_at`), and corrected stamps (`_ns`)."""

    dvl: Admitted
    dvl_at: Index
    dvl_ns: Stamps
    reference: Admitted
    reference_at: Index
    reference_ns: Stamps
    imu: Admitted
    imu_at: Index
    imu_ns: Stamps
    frames: Codes


class Decisions(NamedTuple):
    """Event indices at which rows are oriented and paired (with the stamps of the latter), in order."""

    oriented_at: Index
    paired_at: Index
    stamps_ns: Stamps


NO_DECISIONS = Decisions(*(np.zeros(0, dtype=kind) for kind in (np.intp, np.intp, np.int64)))


class Events(NamedTuple):
    """The T admitted samples in order of arrival.

    dvl_at, reference_at, imu_at: event index of each sample of a stream.
    reference_ns, imu_ns: newest stamps after each event (`LONG_AGO_NS`: none).
    horizon_ns: horizon after each event, see `Aligner.horizon_ns`.
    """

    arrival: Stamps
    dvl_at: Index
    reference_at: Index
    imu_at: Index
    reference_ns: Stamps
    imu_ns: Stamps
    horizon_ns: Stamps

    @staticmethod
    def of(
        arrivals: tuple[Stamps, Stamps, Stamps],
        stamps_ns: tuple[Stamps, Stamps, Stamps],
        before_ns: tuple[int | None, int | None, int | None],
        max_jump_ns: int,
    ) -> Events:
        """Merge the samples of DVL, reference and IMU (tuples in this order) by arrival."""
        arrival = np.concatenate(arrivals)
        order = np.argsort(arrival, kind="stable")
        event_of_sample = np.empty(len(order), dtype=np.intp)
        event_of_sample[order] = np.arange(len(order))
        dvl_at, reference_at, imu_at = np.split(event_of_sample, np.cumsum([len(arrival) for arrival in arrivals[:2]]))
        newest_ns = []
        for events, stamps, newest_before in zip((dvl_at, reference_at, imu_at), stamps_ns, before_ns, strict=True):
            column = np.full(len(order), LONG_AGO_NS if newest_before is None else newest_before, dtype=np.int64)
            column[events] = stamps
            newest_ns.append(np.maximum.accumulate(column))
        dvl_ns = np.maximum(newest_ns[0], 0)
        horizon_ns = dvl_ns
        for track_ns in newest_ns[1:]:
            ahead = (track_ns > dvl_ns) & (track_ns <= dvl_ns + max_jump_ns)
            horizon_ns = np.maximum(horizon_ns, np.where(ahead, track_ns, dvl_ns))
        return Events(arrival[order], dvl_at, reference_at, imu_at, newest_ns[1], newest_ns[2], horizon_ns)


def screened(streams: Streams, parameters: Parameters) -> ScreenedStreams:
    """Check all rows for validity, and screen their values."""
    dvl, reference, imu = streams
    max_speed, believed = parameters.max_speed, parameters.use_message_covariance
    dvl_screen, reference_screen = (screen_columns(block.covariances, believed) for block in (dvl, reference))
    orientation, rates = unit_quaternions(imu.orientation), valid_rates(imu.angular_velocity)
    dvl_is_measured = dvl_screen.unmeasured == 0
    reference_is_measured = reference_screen.unmeasured != ALL_AXES
    imu_is_known = ~(np.isnan(orientation[:, 0]) & np.isnan(rates[:, 0]))
    dvl_is_valid = dvl_screen.valid & are_valid_velocities(dvl.values, max_speed)
    reference_is_valid = reference_screen.valid & are_valid_velocities(reference.values, max_speed)
    return ScreenedStreams(
        streams, dvl=(dvl.refused == 0) & dvl_is_valid & dvl_is_measured,
        reference=(reference.refused == 0) & reference_is_valid & reference_is_measured,
        imu=(imu.refused == 0) & imu_is_known, dvl_covariance=dvl_screen.covariance,
        reference_values=np.concatenate([reference.values, reference_screen.covariance.reshape(-1, 9)], axis=1),
        reference_unmeasured=reference_screen.unmeasured, imu_values=np.concatenate([orientation, rates], axis=1),
    )  # fmt: skip


def ordered(
    screened: ScreenedStreams, orders: Mapping[Stream, Sequencer[Any]], clocks: Clocks, first_ns: int | None
) -> OrderedStreams | None:
    """Return the admitted rows of valid samples with corrected stamps, or None if a stream has a jump.

    first_ns: first DVL stamp of the run, from which its clock drifts; None if it is in this block.
    """
    streams = screened.streams
    dvl_ns = streams.dvl.stamps_ns[screened.dvl]
    if len(dvl_ns):
        dvl_ns = clocks.dvl(dvl_ns, int(dvl_ns[0]) if first_ns is None else first_ns)
    reference_ns = streams.reference.stamps_ns[screened.reference] - clocks.reference_ns
    imu_ns = streams.imu.stamps_ns[screened.imu] - clocks.imu_ns
    dvl = orders[Stream.DVL].admit_columns(dvl_ns)
    reference = orders[Stream.REFERENCE].admit_columns(reference_ns)
    imu = orders[Stream.IMU].admit_columns(imu_ns)
    if dvl is None or reference is None or imu is None:
        return None
    return OrderedStreams(
        dvl, np.flatnonzero(screened.dvl)[dvl.rows], dvl_ns[dvl.rows],
        reference, np.flatnonzero(screened.reference)[reference.rows], reference_ns[reference.rows],
        imu, np.flatnonzero(screened.imu)[imu.rows], imu_ns[imu.rows],
        streams.reference.frames[screened.reference][reference.rows],
    )  # fmt: skip


def decisions(
    partners: Pairer, rows: Rows, reference: Track, imu: Track, chunk: OrderedStreams, events: Events
) -> Decisions | None:
    """Return the events that decide waiting and new rows; None if a row's reference may change while it waits.

    A late reference may still arrive while its row waits for attitude.
    """
    n_events = len(events.horizon_ns)
    waiting = min(partners.n_oriented, partners.n_paired)  # number of the first waiting row
    stamps_ns = np.concatenate([rows.stamps_ns[waiting - rows.base : rows.size], chunk.dvl_ns])
    # a new row can be decided from its own arrival on
    since = np.concatenate([np.zeros(len(stamps_ns) - len(chunk.dvl_ns), dtype=np.intp), events.dvl_at])
    to_orient, to_pair = partners.n_oriented - waiting, partners.n_paired - waiting
    oriented_at = imu.decided_in(stamps_ns, since, chunk.imu_ns, events.imu_at, events.imu_ns, events.horizon_ns)
    oriented_at[:to_orient] = 0
    oriented_at = np.maximum.accumulate(oriented_at)
    reached_at = reference.decided_in(
        stamps_ns, since, chunk.reference_ns, events.reference_at, events.reference_ns, events.horizon_ns
    )
    paired_at = np.maximum(reached_at, oriented_at) if partners.needs_turn_rate else reached_at
    # a reference in an earth frame needs the attitude
    in_earth_frame = _in_earth_frame(reference, chunk, stamps_ns, reached_at, events)
    if in_earth_frame is not None:
        paired_at = np.where(in_earth_frame, np.maximum(paired_at, oriented_at), paired_at)
    paired_at = np.maximum.accumulate(paired_at[to_pair:])
    reached_at, stamps_to_pair = reached_at[to_pair:], stamps_ns[to_pair:]
    delayed = (paired_at > reached_at) & (paired_at < n_events)
    if delayed.any():
        first, last = reached_at[delayed], paired_at[delayed]
        given_up = events.reference_ns[first] < stamps_to_pair[delayed]
        if (given_up & (events.reference_ns[last] != events.reference_ns[first])).any():
            return None
    return Decisions(oriented_at[to_orient:], paired_at, stamps_to_pair)


def _in_earth_frame(
    track: Track, chunk: OrderedStreams, stamps_ns: Stamps, decided_at: Index, events: Events
) -> Mask | None:
    """Return a mask (N,) of rows whose decided reference is in an earth frame; None if there are none."""
    n_events = len(events.horizon_ns)
    frames = np.concatenate([track.frames[track.begin : track.size], chunk.frames])
    if not len(frames) or (frames == BODY).all():
        return None
    all_ns = np.concatenate([track.stamps_ns[track.begin : track.size], chunk.reference_ns])
    after = np.minimum(np.searchsorted(all_ns, stamps_ns), len(all_ns) - 1)
    is_near = (after > 0) & (all_ns[after] - all_ns[after - 1] <= track.max_gap_ns)
    newest_ns = events.reference_ns[np.minimum(decided_at, n_events - 1)]
    is_found = (decided_at < n_events) & (stamps_ns <= newest_ns) & (stamps_ns >= newest_ns - track.retention_ns)
    return is_found & (is_near | (all_ns[after] == stamps_ns)) & (frames[after] != BODY)


# Number of messages from which columns are faster.
COLUMNS_FROM = 64


class Aligner(LiveAlignment):
    """Alignment of three streams, by columns where no clock steps occur."""

    def take(self, streams: Streams) -> None:
        """Add a stretch of all streams, with the same result as per sample in order of arrival."""
        count = sum(map(len, streams))
        if count < COLUMNS_FROM or self._before_restart:
            self._take_rows(streams)
        elif not self._take_columns(screened(streams, self.parameters)):
            for half in streams.halves():  # halve the columns until the clock step is isolated
                self.take(half)

    def _take_rows(self, streams: Streams) -> None:
        """Take the rows one by one in order of arrival."""
        take = {Stream.DVL: self.take_dvl, Stream.REFERENCE: self.take_reference, Stream.IMU: self.take_imu}
        for stream, row in streams.in_order():
            if isinstance(row, str):
                self.refuse(stream, row)
            else:
                take[stream](row)  # type: ignore[operator]

    def _take_columns(self, valid: ScreenedStreams) -> bool:
        """Add columns without jumps. Return False, with nothing changed, if they need per-sample alignment.

        This is the case if the horizon goes back, because its stream runs away from the DVL, or if `decisions` is None.
        """
        chunk = ordered(valid, self.orders, self._clocks, self._first_stamp_ns)
        if chunk is None:
            return False
        dvl, reference, imu = valid.streams
        events = Events.of(
            (dvl.arrival[chunk.dvl_at], reference.arrival[chunk.reference_at], imu.arrival[chunk.imu_at]),
            (chunk.dvl_ns, chunk.reference_ns, chunk.imu_ns),
            (self.orders[Stream.DVL].last_ns, self.reference.newest_ns, self.imu.newest_ns),
            self._max_jump_ns,
        )
        partners, n_events = self.partners, len(events.horizon_ns)
        decided: Decisions | None = NO_DECISIONS
        if n_events:
            goes_back = (np.diff(events.horizon_ns) < 0).any()
            decided = None if goes_back else decisions(partners, self.rows, self.reference, self.imu, chunk, events)
        if decided is None:
            return False
        self._count_columns(valid, chunk, decided, events)
        if n_events:  # without events no row can be decided
            self._append_columns(valid, chunk, events)
            n_known = int(np.searchsorted(decided.oriented_at, n_events))
            partners.orient(events.imu_ns[decided.oriented_at[:n_known]], self.parameters)
            n_known = int(np.searchsorted(decided.paired_at, n_events))
            partners.pair(events.reference_ns[decided.paired_at[:n_known]])
            self._deadline_ns = LONG_AGO_NS  # check the waiting rows again with the next sample
        self._n_messages += len(dvl)
        return True

    def _count_columns(
        self, valid: ScreenedStreams, chunk: OrderedStreams, decisions: Decisions, events: Events
    ) -> None:
        """Count messages that are invalid, refused or not in order."""
        for block, is_valid, order in zip(
            valid.streams, valid[1:4], (chunk.dvl, chunk.reference, chunk.imu), strict=True
        ):
            tally = self.tally[block.stream.value]
            tally["received"] += len(block)
            refused = np.bincount(block.refused, minlength=1 + len(block.reasons))[1:]
            for reason, count in zip(block.reasons, refused.tolist(), strict=True):
                if count:
                    self.refusal_counters[block.stream.value].add(reason)
                    tally[reason] += count
            add_count(tally, "invalid", len(block) - int(np.count_nonzero(is_valid)) - int(refused.sum()))
            add_count(tally, "duplicate", order.duplicate)
            add_count(tally, "out_of_order", order.out_of_order)
        reference = valid.streams.reference
        stamps_ns = reference.stamps_ns[valid.reference] - self._clocks.reference_ns
        if len(stamps_ns):
            at = np.searchsorted(events.arrival, reference.arrival[valid.reference])
            decided = np.concatenate([[self.partners.decided_ns], decisions.stamps_ns])
            before = decided[np.searchsorted(decisions.paired_at, at)]
            add_count(self.tally["reference"], "late", int(np.count_nonzero(stamps_ns < before)))

    def _append_columns(self, valid: ScreenedStreams, chunk: OrderedStreams, events: Events) -> None:
        """Append admitted samples to the tracks and rows, and mark the late ones."""
        dvl, reference, _ = valid.streams
        reached_ns = np.maximum(np.maximum.accumulate(events.horizon_ns), self.reached_ns)
        self.reached_ns = int(reached_ns[-1])
        late_before_ns = reached_ns - self.lag_ns
        if len(chunk.reference_ns):
            at, late = chunk.reference_at, chunk.reference_ns < late_before_ns[events.reference_at]
            unmeasured = valid.reference_unmeasured[at]
            values, axes = valid.reference_values[at], self.parameters.gnss_axes
            self.reference.append(chunk.reference_ns, values, reference.frames[at], unmeasured, late, axes)
            self.orders[Stream.REFERENCE].follow(chunk.reference_ns)
        if len(chunk.imu_ns):
            late = chunk.imu_ns < late_before_ns[events.imu_at]
            self._append_imu(len(chunk.imu_ns), chunk.imu_ns, valid.imu_values[chunk.imu_at], late)
            self.orders[Stream.IMU].follow(chunk.imu_ns)
        if len(chunk.dvl_ns):
            if self._first_stamp_ns is None:
                self._first_stamp_ns = int(dvl.stamps_ns[valid.dvl][0])
            at, late = chunk.dvl_at, chunk.dvl_ns < late_before_ns[events.dvl_at]
            self._append_rows(chunk.dvl_ns, self._n_messages + at, dvl.values[at], valid.dvl_covariance[at], late)
            self.orders[Stream.DVL].follow(chunk.dvl_ns)


def align(
    streams: Streams, parameters: Parameters, prior_sway_heave: tuple[float, float] | None = None
) -> tuple[AlignedBlock, Array]:
    """Return a whole aligned recording, and the prior sway and heave (2,) m/s at its end."""
    aligner = Aligner(parameters, prior_sway_heave)
    aligner.take(streams)
    return aligner.rows.block(0, aligner.rows.end), aligner.partners.prior.sway_heave


def counted(
    aligner: Aligner, gnss_losses: int, restarts: int, restarted: Mapping[str, int]
) -> dict[str, dict[str, int]]:
    """Return message counts by stream and reason since the start or the last restart.

    dvl: received = invalid + duplicate + out_of_order + stray + held + refused ones (`Calibrator.refuse`) + accepted;
    accepted = slow + frozen + turning + no_turn_rate + usable + awaiting_imu; repeated and dropouts are counted in
    addition. pairing: accepted and decided = paired + unpaired; awaiting_reference is the rest. usable = oriented +
    not_oriented (no attitude or no angular velocity) + awaiting_attitude. A model's used + gated (+ samples in its
    prior window) are its input: usable samples; with GNSS the paired ones, with attitude the oriented ones.

    gnss_losses: number of reference outages.
    restarts: of the calibration.
    restarted: of single models.
    """
    counts = {name: dict(tally) for name, tally in aligner.tally.items()}
    for stream, order in aligner.orders.items():
        tally = counts[stream.value]
        tally["stray"], tally["held"] = order.stray, int(order.held is not None)
        for key in ("received", "invalid", "duplicate", "out_of_order"):
            tally.setdefault(key, 0)
    dvl, pairing = counts["dvl"], counts["pairing"]
    unused = ("slow", "frozen", "turning", "no_turn_rate")
    for key in (*unused, "dropouts", "wrong_frame"):
        dvl.setdefault(key, 0)
    dvl["repeated"] = aligner.partners.gates.repeated
    for key in ("wrong_frame", "late"):
        counts["reference"].setdefault(key, 0)
    for key in ("paired", "unpaired", "without_attitude", "oriented", "not_oriented"):
        pairing.setdefault(key, 0)
    not_accepted = {"invalid", "duplicate", "out_of_order", "stray", "held", *aligner.refusal_counters["dvl"]}
    dvl["accepted"] = dvl["received"] - sum(dvl.get(key, 0) for key in not_accepted)
    dvl["awaiting_imu"] = aligner.rows.end - aligner.partners.n_judged
    dvl["usable"] = dvl["accepted"] - sum(dvl[key] for key in (*unused, "awaiting_imu"))
    pairing["gnss_losses"] = gnss_losses
    pairing["awaiting_reference"] = aligner.partners.n_judged - aligner.partners.n_paired
    pairing["awaiting_attitude"] = dvl["usable"] - pairing["oriented"] - pairing["not_oriented"]
    counts["calibration"] = {"restarts": restarts}
    counts["calibration"] |= {f"{name} restarted": number for name, number in restarted.items() if number}
    return counts


def counts_by_use(
    counts: Mapping[str, Mapping[str, int]], needs: Needs, passed: int, used: int, gated: int
) -> dict[str, int]:
    """Return the number of received DVL samples in each state, for one model; the sum is ``received``.

    refused: no sample, or not in order. unusable: slow, frozen or turning. unpaired: without the reference or attitude
    that the model needs. waiting: for the sample that confirms its stamp, or for its partners. gathered: passed to the
    model but not used yet, or for its prior only. used, gated: by the model.

    Parameters
    ----------
    counts
        Result of `counted`.
    needs
        Input that the model requires of a sample.
    passed
        Number of samples passed to the model.
    used, gated
        Number of samples that the model used and gated.
    """
    dvl, pairing = counts["dvl"], counts["pairing"]
    unusable, unpaired, waiting = dvl["accepted"] - dvl["usable"] - dvl["awaiting_imu"], 0, 0
    if needs is Needs.REFERENCE:  # unusable rows are paired, too
        unusable, unpaired, waiting = pairing["paired"] - passed, pairing["unpaired"], pairing["awaiting_reference"]
    elif needs is Needs.ATTITUDE:
        unpaired, waiting = pairing["not_oriented"], pairing["awaiting_attitude"]
    elif needs is Needs.ATTITUDE_IF_KNOWN:
        waiting = pairing["awaiting_attitude"]
    return {
        "refused": dvl["received"] - dvl["accepted"] - dvl["held"],
        "unusable": unusable,
        "unpaired": unpaired,
        "waiting": dvl["held"] + dvl["awaiting_imu"] + waiting,
        "gathered": passed - used - gated,
        "used": used,
        "gated": gated,
    }
