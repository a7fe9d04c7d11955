"""Alignment of single samples as they come, with the recent past of the reference.

Live, and where a clock leaps, whether a message is valid and in order is asked of one by itself; what is done when a
clock leaps is here.
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
from .stream_order import DROPOUT_NS, LONG_AGO_NS, SHORTEST_PAUSE_NS, Dropouts, NewDays, Order, Sequencer, Track

# How far a DVL may lag GNSS and IMU and still find its partners, beyond what pairing waits for.
RETENTION_NS = 10 * SECOND_NS
# A DVL whose stamps are off by seconds, which the full model finds, lags others by as much, or they lag it.
WRONG_CLOCK_NS = 4 * SECOND_NS
NEVER_NS = 2**63 - 1
# The past of GNSS and IMU is looked through for what may go once in so many live samples.
FORGET_EVERY = 256
_NAN_4, _NAN_3 = (math.nan,) * 4, (math.nan,) * 3


class LiveAlignment:
    """Aligns three streams; `rows` are its outcome, `partners` says how many of them are decided.

    reference, imu: their samples of late. dropouts: of the DVL. lag_ns: by how much (in stamps) one stream may lag
    another, a wrong clock included. day_rows, day_starts_ns: numbers and stamps of rows that a new day begins with.
    tally: by stream and for pairing, see `Calibrator.counts`. on_restart: told by how much (s) the DVL's stamps went
    back (ahead: negative) when all is to start anew; everything here has then been forgotten. before_clearing: called
    before the past of a track is forgotten whose stamps went back, so that who needs it takes it then, whatever stretch
    it came in.
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
        believed = parameters.use_message_covariance
        self._dvl_covariance, self._reference_covariance = CovarianceScreen(believed), CovarianceScreen(believed)
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
        self.reference = ReferenceTrack(p, gnss_ns, latency_ns, retention_ns)
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
        self.partners = Pairer(self.parameters, self.rows, self.reference, self.imu, self.tally, self._prior_sway_heave)
        self.reference.vertical_seen = False
        # what the first waiting rows wait for: samples of these streams, or any stream's stamp reaching this
        self._waits_for: set[Track] = set()
        self._deadline_ns = NEVER_NS
        self._row_of_held = 0
        self.reached_ns = LONG_AGO_NS  # the newest horizon so far
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
            self._append_samples([sample], [row])
        else:
            kind, admitted = order.admit(sample)
            self._count_order(tally, kind)
            if kind is Order.CONFIRMED_RESTART:
                self._restart(admitted[0].stamp_ns)
                row = 1
            elif kind is Order.HELD:
                self._row_of_held = row
            if not admitted:
                return None
            self._append_samples(admitted, [self._row_of_held, row][-len(admitted) :])
        self._advance()
        return sample

    def _append_samples(self, samples: Sequence[DvlSample], numbers: Sequence[int]) -> None:
        """Make rows of one sample, or of one that was held and what confirmed it."""
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
        """Make rows (N,) of a DVL's samples, in order. number: of their messages."""
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
        """Take a reference (GNSS) velocity."""
        tally = self.tally["reference"]
        tally["received"] += 1
        valid, _, unmeasured = self._reference_covariance(sample.covariance)
        if not valid or unmeasured == ALL_AXES or not is_valid_velocity(sample.velocity, self.parameters.max_speed):
            tally["invalid"] += 1
            return
        stamp_ns = sample.stamp_ns - self._clocks.reference_ns
        if stamp_ns < self.partners.decided_ns:
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
        """Put one sample on its track."""
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
        """Put samples (N,) on the IMU's track; the slot of the first."""
        slots = self.imu.extend(n)
        self.imu.stamps_ns[slots], self.imu.late[slots], self.imu.values[slots, :7] = stamps_ns, late, values
        return slots.start

    @staticmethod
    def _count_order(tally: Counter[str], order: Order) -> None:
        if order in (Order.DUPLICATE, Order.OUT_OF_ORDER):
            tally[order.value] += 1

    def _restart(self, stamp_ns: int) -> None:
        """Start anew with this sample: DVL stamps went back (a bag loops, a clock was set), or the first was stray."""
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
        if n > oriented:  # a reference in an earth frame waits for the attitude to turn it by
            waits = partners.in_earth_frame(partners.n_paired + n, newest_ns)
            waits[: max(oriented, 0)] = False
            n = int(np.argmax(waits)) if waits.any() else n
        partners.pair(newest_ns[:n])

    def _decided(self, track: Track, first: int, end: int, horizon_ns: int) -> int:
        """How many rows from `first` on need not wait for a track any more; of the next one note for what, and until
        when it does."""
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

    def forget_old(self) -> None:
        """Forget of reference and IMU what nobody asks for any more."""
        self.reference.forget_old()
        self.imu.forget_old()


def _newest(track: Track, n: int) -> Stamps:
    """(N,) the newest stamp of a track, for rows that are decided now."""
    return np.full(n, LONG_AGO_NS if track.newest_ns is None else track.newest_ns, dtype=np.int64)


class ReferenceTrack(Track):
    """A `Track` of reference samples. vertical_seen: whether one of them had a vertical velocity."""

    def __init__(self, parameters: Parameters, max_gap_ns: int, max_latency_ns: int, retention_ns: int) -> None:
        """As `Track`."""
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
        """Put samples (N,) on the track, values (N, 12); the slot of the first. gnss_axes: as the parameter."""
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
    """The axes, as bits, that are not measured whatever the covariances say."""
    return 0 if gnss_axes == XYZ or (vertical_seen and gnss_axes != XY) else VERTICAL
