"""Alignment of single samples as they arrive, with the recent reference and IMU samples.

Validity and order are checked per sample: live, and in stretches with clock steps, which are handled here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..models.parameters import XY, XYZ, Parameters
from ..numerics.frames import Array, Vector
from ..numerics.samples import (
    FRAME_CODES,
    FRAMES,
    Codes,
    DvlSample,
    ImuSample,
    Index,
    Mask,
    ReferenceSample,
    Stamps,
    Stream,
    VelocityFrame,
)
from .clock_correction import SECOND_NS, Clocks
from .pairing import Pairer, Rows, add_count
from .screening import ALL_AXES, VERTICAL, CovarianceScreen, is_valid_rate, is_valid_velocity, unit_quaternion
from .stream_order import (
    DROPOUT_NS,
    LONG_AGO_NS,
    NEVER_NS,
    SHORTEST_PAUSE_NS,
    Dropouts,
    NewDays,
    Order,
    Sequencer,
    Track,
)

# Largest DVL lag behind GNSS and IMU with available partners, ns, beyond the latency of pairing.
RETENTION_NS = 10 * SECOND_NS
# Additional lag between streams due to a delay of seconds, which the full model estimates, ns.
WRONG_CLOCK_NS = 4 * SECOND_NS
# Live samples between two purges of old GNSS and IMU samples.
FORGET_EVERY = 256
_NAN_4, _NAN_3 = (math.nan,) * 4, (math.nan,) * 3


class LiveAlignment:
    """Alignment of three streams; `rows` is the result, `partners` counts the decided rows.

    reference, imu: their recent samples.
    dropouts: of the DVL.
    lag_ns: largest lag between streams (in stamps), including a wrong clock.
    day_rows, day_starts_ns: numbers and stamps of the first rows of new recordings.
    tally: by stream and for pairing, see `Calibrator.counts`.
    on_restart: called with the backward step (s; negative: forward) of DVL stamps after a reset.
    before_clearing: called before a track with a backward clock step is cleared, so that users of its samples can copy
      them first.
    """

    def __init__(
        self,
        parameters: Parameters,
        prior_sway_heave: tuple[float, float] | None = None,
        on_restart: Callable[[float], None] = lambda _: None,
        recordings_ns: Sequence[int] = (),
    ) -> None:
        """Start without samples.

        prior_sway_heave: (2,) m/s, prior for `prior_source: reference`.
        recordings_ns: stamps between recordings.
        """
        self.parameters = parameters
        self._prior_sway_heave = prior_sway_heave
        self._on_restart = on_restart
        self.before_clearing: Callable[[], None] = lambda: None
        self._clocks = Clocks.of(parameters)
        self._new_days = NewDays(round(parameters.new_day_after * 1e9), recordings_ns)
        believed = parameters.use_message_covariance
        self._dvl_covariance, self._reference_covariance = CovarianceScreen(believed), CovarianceScreen(believed)
        self._max_jump_ns = round(parameters.max_time_jump * 1e9)
        self.reset()

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Discard all samples, and begin again with empty streams."""
        p = self.parameters
        self._first_stamp_ns: int | None = None
        # after the correction of its delay, a late-stamped stream lags the others by it
        latency_ns = round(p.max_latency * 1e9) + self._clocks.spread_ns
        self.lag_ns = latency_ns + WRONG_CLOCK_NS
        gnss_ns, imu_ns = round(p.gnss_timeout * 1e9), round(p.imu_timeout * 1e9)
        retention_ns = RETENTION_NS + gnss_ns + imu_ns + latency_ns
        self.orders: dict[Stream, Sequencer[Any]] = {stream: Sequencer(self._max_jump_ns) for stream in Stream}
        self._dvl_order = self.orders[Stream.DVL]  # used for every sample
        self.reference = ReferenceTrack(p, gnss_ns, latency_ns, retention_ns)
        self.imu = Track(imu_ns, latency_ns, retention_ns)
        self._tracks = {Stream.REFERENCE: self.reference, Stream.IMU: self.imu}
        streams = [stream.value for stream in Stream]
        self.tally: dict[str, Counter[str]] = {name: Counter() for name in (*streams, "pairing")}
        # counter names of refused messages, by stream
        self.refusal_counters: dict[str, set[str]] = {name: set() for name in streams}
        # streams that still deliver samples from before a restart of the DVL stamps
        self._before_restart: set[Stream] = set()
        self._n_messages = 0
        self._forget_dvl()

    def _forget_dvl(self) -> None:
        """Discard the DVL samples, their rows and recordings."""
        self.rows = Rows()
        self.partners = Pairer(self.parameters, self.rows, self.reference, self.imu, self.tally, self._prior_sway_heave)
        self.reference.vertical_seen = False
        # the first waiting rows wait for samples of these streams, or for any stamp reaching the deadline
        self._waits_for: set[Track] = set()
        self._deadline_ns = NEVER_NS
        self._row_of_held = 0
        self.reached_ns = LONG_AGO_NS  # newest horizon so far
        self.first_ns: int | None = None
        self.day_rows: list[int] = []
        self.day_starts_ns: list[int] = []
        self.last_ns: int | None = None
        self.dropouts = Dropouts()

    @property
    def newest_ns(self) -> dict[str, int | None]:
        """Stamp of the newest sample of each stream; None before the first."""
        return {"dvl": self.last_ns, "reference": self.reference.newest_ns, "imu": self.imu.newest_ns}

    def latest_angular_velocity(self, stamp_ns: int) -> Vector | None:
        """Return the newest angular velocity (rad/s, body), or None if missing or older than imu_timeout."""
        newest_ns = self.imu.newest_ns
        if newest_ns is None or abs(stamp_ns - newest_ns) > self.parameters.imu_timeout * 1e9:
            return None
        x, y, z = self.imu.values[self.imu.size - 1, 4:7].tolist()
        return None if math.isnan(x) else (x, y, z)

    # ------------------------------------------------------------------ per sample

    def refuse(self, stream: Stream, reason: str) -> None:
        """Count a message of a stream that is no sample, by reason."""
        self.refusal_counters[stream.value].add(reason)
        self.tally[stream.value]["received"] += 1
        self.tally[stream.value][reason] += 1
        self._n_messages += stream is Stream.DVL

    def take_dvl(self, sample: DvlSample) -> DvlSample | None:
        """Add a DVL sample. Return it corrected and screened, or None if it is invalid or not in order."""
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
            self._append_samples([sample], [row])
        else:
            kind, admitted = order.admit(sample)
            self._count_order(tally, kind)
            if kind is Order.CONFIRMED_RESTART:
                self._restart(admitted[0].stamp_ns)
                row = 1  # after the held sample, which is row 0 of the new run
            elif kind is Order.HELD:
                self._row_of_held = row
            if not admitted:
                return None
            self._append_samples(admitted, [self._row_of_held, row][-len(admitted) :])
        self._advance()
        return sample

    def _append_samples(self, samples: Sequence[DvlSample], numbers: Sequence[int]) -> None:
        """Append rows for one sample, or for a held sample and the one that confirmed it."""
        for (stamp_ns, velocity, covariance), number in zip(samples, numbers, strict=True):
            self._append_rows(
                np.array([stamp_ns]),
                np.array([number]),
                np.array([velocity]),
                math.nan if covariance is None else covariance,
                np.array([self._is_late(stamp_ns)]),
            )

    def _append_rows(
        self, stamps_ns: Stamps, number: Index, velocity: Array, covariance: Array | float, late: Mask
    ) -> None:
        """Append rows (N,) of DVL samples, in order. number: of their messages."""
        rows = self.rows
        slots = rows.extend(len(stamps_ns))
        rows.stamps_ns[slots], rows.late[slots], rows.row[slots] = stamps_ns, late, number
        rows.velocity_dvl[slots], rows.covariance[slots] = velocity, covariance
        rows.await_partners(slots)
        interval_ns = np.empty_like(stamps_ns)
        interval_ns[0] = 0 if self.last_ns is None else int(stamps_ns[0]) - self.last_ns
        np.subtract(stamps_ns[1:], stamps_ns[:-1], out=interval_ns[1:])
        rows.interval_ns[slots] = interval_ns
        if interval_ns.max() > DROPOUT_NS:
            for index in np.flatnonzero(interval_ns > SHORTEST_PAUSE_NS).tolist():
                if self._new_days.begins(int(stamps_ns[index]), int(interval_ns[index])):
                    self.day_rows.append(rows.base + slots.start + index)
                    self.day_starts_ns.append(int(stamps_ns[index]))
        add_count(
            self.tally["dvl"], "dropouts", self.dropouts.add(interval_ns[1:] if self.first_ns is None else interval_ns)
        )
        self.first_ns = int(stamps_ns[0]) if self.first_ns is None else self.first_ns
        self.last_ns = int(stamps_ns[-1])
        if not self.partners.needs_turn_rate:
            self.partners.judge(rows.end, self.parameters)

    def take_reference(self, sample: ReferenceSample) -> None:
        """Add a reference velocity, unless it is invalid, and count it."""
        tally = self.tally["reference"]
        tally["received"] += 1
        valid, _, unmeasured = self._reference_covariance(sample.covariance)
        if not valid or unmeasured == ALL_AXES or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return
        stamp_ns = sample.stamp_ns - self._clocks.reference_ns
        if stamp_ns < self.partners.decided_ns:
            tally["late"] += 1  # a DVL row was decided without it: max_latency is too short
        if stamp_ns != sample.stamp_ns:
            sample = sample._replace(stamp_ns=stamp_ns)
        self._keep(Stream.REFERENCE, sample)

    def take_imu(self, sample: ImuSample) -> None:
        """Add the attitude and angular velocity of a sample, unless both are invalid, and count it."""
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
        """Append a sample to its track if its stamp is in order, and advance the rows that it decides."""
        track = self._tracks[stream]
        if not self._before_restart and self.orders[stream].goes_on(sample.stamp_ns):
            self._append(track, sample)
        elif not self._keep_unusual(stream, track, sample):
            return
        if sample.stamp_ns >= self._deadline_ns or track in self._waits_for:
            self._advance()

    def _keep_unusual(self, stream: Stream, track: Track, sample: ReferenceSample | ImuSample) -> bool:
        """Append a sample whose stamp is not simply the next one. Return whether the track has grown."""
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
        for each in admitted:
            self._append(track, each)
        return bool(admitted)

    def _append(self, track: Track, sample: ReferenceSample | ImuSample) -> None:
        """Append one sample to its track."""
        late = self._is_late(sample.stamp_ns)
        if isinstance(sample, ImuSample):
            values = (*(sample.orientation or _NAN_4), *(sample.angular_velocity or _NAN_3))
            slot = self._append_imu(1, sample.stamp_ns, values, late)
        else:
            covariance = self._reference_covariance(sample.covariance)
            velocity = np.full((1, 12), math.nan)
            velocity[0, :3] = sample.velocity
            if covariance.covariance is not None:
                velocity[0, 3:] = covariance.covariance.ravel()
            frames = np.array([FRAME_CODES[sample.frame]], dtype=np.uint8)
            axes = self.parameters.gnss_axes
            slot = self.reference.append(sample.stamp_ns, velocity, frames, covariance.unmeasured, late, axes)
        if slot % FORGET_EVERY == 0:
            track.forget_old()

    def _append_imu(self, n: int, stamps_ns: Stamps | int, values: Array | tuple[float, ...], late: Mask | bool) -> int:
        """Append samples (N,) to the IMU track. Return the slot of the first."""
        slots = self.imu.extend(n)
        self.imu.stamps_ns[slots], self.imu.late[slots], self.imu.values[slots, :7] = stamps_ns, late, values
        return slots.start

    @staticmethod
    def _count_order(tally: Counter[str], order: Order) -> None:
        if order in (Order.DUPLICATE, Order.OUT_OF_ORDER):
            tally[order.value] += 1

    def _restart(self, stamp_ns: int) -> None:
        """Restart with this sample: DVL stamps stepped backward (bag loop, clock set), or the first was stray."""
        back_s = ((self.last_ns or stamp_ns) - stamp_ns) * 1e-9
        self.tally["dvl"] = Counter(received=2)  # the two samples that confirmed the restart
        for name in ("reference", "imu", "pairing"):
            self.tally[name].clear()
        self.orders[Stream.DVL].stray = 0
        self._forget_dvl()
        self._row_of_held, self._n_messages = 0, 2
        # samples from before the step must not be paired with later ones
        for stream, track in self._tracks.items():
            if track.newest_ns is not None and track.newest_ns > stamp_ns + self._max_jump_ns:
                track.clear()
                self._before_restart.add(stream)
        self._on_restart(back_s)

    def _advance(self) -> None:
        """Pair the rows whose attitude and reference are decided, and note the stamps that the next rows wait for.

        Attitudes are decided first, because a reference in an earth frame needs one.
        """
        partners, end, horizon_ns = self.partners, self.rows.end, self.horizon_ns
        self._waits_for.clear()
        self._deadline_ns = NEVER_NS
        n = self._decided(self.imu, partners.n_oriented, end, horizon_ns)
        if n:
            partners.orient(_newest(self.imu, n), self.parameters)
        if partners.needs_turn_rate:
            end = partners.n_oriented
        n = self._decided(self.reference, partners.n_paired, end, horizon_ns)
        if not n:
            return
        newest_ns, oriented = _newest(self.reference, n), partners.n_oriented - partners.n_paired
        if n > oriented:  # a reference in an earth frame needs the attitude
            waits = partners.in_earth_frame(partners.n_paired + n, newest_ns)
            waits[: max(oriented, 0)] = False
            n = int(np.argmax(waits)) if waits.any() else n
        partners.pair(newest_ns[:n])

    def _decided(self, track: Track, first: int, end: int, horizon_ns: int) -> int:
        """Return the number of rows from `first` on that a track decides; note what the next one waits for."""
        rows, n = self.rows, 0
        while first + n < end:
            stamp_ns = int(rows.stamps_ns[first + n - rows.base])
            if not track.decided(stamp_ns, horizon_ns):
                self._waits_for.add(track)
                self._deadline_ns = min(self._deadline_ns, track.deadline_ns(stamp_ns))
                break
            n += 1
        return n

    @property
    def horizon_ns(self) -> int:
        """Newest stamp of any stream within max_time_jump of the DVL.

        A stream whose clock is far ahead would end the waiting of every DVL row.
        """
        horizon_ns = dvl_ns = self._dvl_order.last_ns or 0
        for track in (self.reference, self.imu):
            newest_ns = track.newest_ns
            if newest_ns is not None and horizon_ns < newest_ns <= dvl_ns + self._max_jump_ns:
                horizon_ns = newest_ns
        return horizon_ns

    def _is_late(self, stamp_ns: int) -> bool:
        """Return whether a new sample lags other streams by more than the limit, even for a wrong clock."""
        self.reached_ns = max(self.reached_ns, self.horizon_ns)
        return stamp_ns < self.reached_ns - self.lag_ns

    def forget_old(self) -> None:
        """Discard samples of reference and IMU that are no longer needed."""
        self.reference.forget_old()
        self.imu.forget_old()


def _newest(track: Track, n: int) -> Stamps:
    """Return the newest stamp of a track (N,), for rows that are decided now."""
    return np.full(n, LONG_AGO_NS if track.newest_ns is None else track.newest_ns, dtype=np.int64)


class ReferenceTrack(Track):
    """`Track` of reference samples. vertical_seen: one of them had a vertical velocity."""

    def __init__(self, parameters: Parameters, max_gap_ns: int, max_latency_ns: int, retention_ns: int) -> None:
        """Make an empty track."""
        super().__init__(max_gap_ns, max_latency_ns, retention_ns)
        self.vertical_seen = False
        east, north = parameters.reference_velocity_offset
        offsets = {VelocityFrame.ENU: (east, north, 0.0), VelocityFrame.NED: (north, east, 0.0)}
        self._velocity_offset = np.array([offsets.get(frame, (0.0, 0.0, 0.0)) for frame in FRAMES])

    def append(
        self,
        stamps_ns: Stamps | int,
        values: Array,
        frames: Codes,
        unmeasured: Codes | int,
        late: Mask | bool,
        gnss_axes: str,
    ) -> int:
        """Append samples (N,), values (N, 12). Return the slot of the first. gnss_axes: the parameter."""
        slots = self.extend(len(frames))
        self.stamps_ns[slots], self.late[slots], self.frames[slots] = stamps_ns, late, frames
        vertical = np.logical_or.accumulate(values[:, 2] != 0.0) | self.vertical_seen
        self.vertical_seen = bool(vertical[-1])
        self.values[slots] = values
        self.values[slots, :3] -= self._velocity_offset[frames]
        never = np.where(vertical, _never_measured(gnss_axes, True), _never_measured(gnss_axes, False))
        self.unmeasured[slots] = unmeasured | never.astype(np.uint8)
        return slots.start


def _never_measured(gnss_axes: str, vertical_seen: bool) -> int:
    """Return the axes, as bits, that are not measured whatever the covariances are."""
    return 0 if gnss_axes == XYZ or (vertical_seen and gnss_axes != XY) else VERTICAL
