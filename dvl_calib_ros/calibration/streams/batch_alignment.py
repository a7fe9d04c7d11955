"""Alignment of columns of all streams: validity, order, and the events at which their rows are decided.

Single messages in order of arrival give the same result. Stretches with clock steps are left to the per-sample
alignment of `Aligner`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.samples import Codes, Index, Mask, Stamps, Stream, Streams
from .clock_correction import Clocks
from .pairing import BODY, Pairer, Rows
from .screening import ALL_AXES, are_valid_velocities, screen_columns, unit_quaternions, valid_rates
from .stream_order import LONG_AGO_NS, Admitted, Sequencer, Track


class ScreenedStreams(NamedTuple):
    """Columns of all streams, masks of the valid rows, and the screened values."""

    streams: Streams
    dvl: Mask
    reference: Mask
    imu: Mask
    dvl_covariance: Array
    reference_values: Array
    reference_unmeasured: Codes
    imu_values: Array


class OrderedStreams(NamedTuple):
    """Admitted rows of each stream: indices in its block, and corrected stamps."""

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

    dvl_at, reference_at, imu_at: event index of each sample of a stream. reference_ns, imu_ns: newest stamps after each
    event (`LONG_AGO_NS`: none). horizon_ns: horizon after each event, see `Aligner.horizon_ns`.
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
        at = np.empty(len(order), dtype=np.intp)
        at[order] = np.arange(len(order))
        first, second = len(arrivals[0]), len(arrivals[0]) + len(arrivals[1])
        places = at[:first], at[first:second], at[second:]
        newest = []
        for place, stamps, before in zip(places, stamps_ns, before_ns, strict=True):
            column = np.full(len(order), LONG_AGO_NS if before is None else before, dtype=np.int64)
            column[place] = stamps
            newest.append(np.maximum.accumulate(column))
        dvl_ns = np.maximum(newest[0], 0)
        horizon_ns = dvl_ns
        for track_ns in newest[1:]:
            ahead = (track_ns > dvl_ns) & (track_ns <= dvl_ns + max_jump_ns)
            horizon_ns = np.maximum(horizon_ns, np.where(ahead, track_ns, dvl_ns))
        return Events(arrival[order], *places, newest[1], newest[2], horizon_ns)


def screened(streams: Streams, parameters: Parameters) -> ScreenedStreams:
    """Check all rows for validity, and screen their values."""
    dvl, reference, imu = streams
    max_speed, believed = parameters.max_speed, parameters.use_message_covariance
    of_dvl, of_reference = (screen_columns(each.covariances, believed) for each in (dvl, reference))
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


def ordered(
    screened: ScreenedStreams, orders: Mapping[Stream, Sequencer[Any]], clocks: Clocks, first_ns: int | None
) -> OrderedStreams | None:
    """Return the admitted rows, or None if a stream has a jump. first_ns: first DVL stamp, if known."""
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
    """Return when waiting and new rows are decided, or None if waiting may change a row's partner.

    A late reference may still arrive while its row waits for attitude.
    """
    n_events = len(events.horizon_ns)
    waiting = min(partners.n_oriented, partners.n_paired)
    stamps_ns = np.concatenate([rows.stamps_ns[waiting - rows.base : rows.size], chunk.dvl_ns])
    since = np.concatenate([np.zeros(len(stamps_ns) - len(chunk.dvl_ns), dtype=np.intp), events.dvl_at])
    to_orient, to_pair = partners.n_oriented - waiting, partners.n_paired - waiting
    oriented_at = imu.decided_in(stamps_ns, since, chunk.imu_ns, events.imu_at, events.imu_ns, events.horizon_ns)
    oriented_at[:to_orient] = 0
    oriented_at = np.maximum.accumulate(oriented_at)
    alone = reference.decided_in(
        stamps_ns, since, chunk.reference_ns, events.reference_at, events.reference_ns, events.horizon_ns
    )
    paired_at = np.maximum(alone, oriented_at) if partners.needs_turn_rate else alone
    # a reference in an earth frame needs the attitude
    in_earth_frame = _in_earth_frame(reference, chunk, stamps_ns, alone, events)
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
    track: Track, chunk: OrderedStreams, stamps_ns: Stamps, decided_at: Index, events: Events
) -> Mask | None:
    """Return a mask (N,) of rows whose decided reference is in an earth frame; None if there are none."""
    n_events = len(events.horizon_ns)
    frames = np.concatenate([track.frames[track.begin : track.size], chunk.frames])
    if not len(frames) or (frames == BODY).all():
        return None
    all_ns = np.concatenate([track.stamps_ns[track.begin : track.size], chunk.reference_ns])
    after = np.minimum(np.searchsorted(all_ns, stamps_ns), len(all_ns) - 1)
    near = (after > 0) & (all_ns[after] - all_ns[after - 1] <= track.max_gap_ns)
    newest_ns = events.reference_ns[np.minimum(decided_at, n_events - 1)]
    found = (decided_at < n_events) & (stamps_ns <= newest_ns) & (stamps_ns >= newest_ns - track.retention_ns)
    return found & (near | (all_ns[after] == stamps_ns)) & (frames[after] != BODY)
