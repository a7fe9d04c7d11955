"""Pairing of DVL samples with attitude and reference, and the gates that select the usable ones.

Works on columns; live, on the one or two rows that a message decides. The caller passes the number of decided rows, in
order, and the newest stamp of each track at the decision.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields

import numpy as np

from ..models import Needs
from ..models.parameters import Parameters
from ..numerics.frames import Array, Vector, slerps
from ..numerics.samples import FRAME_CODES, AlignedBlock, Codes, Mask, Pairing, SampleUse, Stamps, VelocityFrame
from ..numerics.tables import RowTable, column
from .stream_order import LONG_AGO_NS, Track

BODY = FRAME_CODES[VelocityFrame.BODY]


def add_count(tally: Counter[str], name: str, count: int) -> None:
    """Add to a counter unless the count is zero: a counter never incremented is absent."""
    if count:
        tally[name] += count


class Pairer:
    """Pairing state of the rows of an aligner.

    n_judged, n_oriented, n_paired: numbers of the first row without decided verdict, attitude or reference.
    given: by need, number of rows available to models with that need.
    decided_ns: stamp of the newest row with decided reference.
    needs_turn_rate: verdicts wait for the angular velocity.
    """

    def __init__(
        self,
        parameters: Parameters,
        rows: Rows,
        reference: Track,
        imu: Track,
        tally: Mapping[str, Counter[str]],
        prior_sway_heave: tuple[float, float] | None,
    ) -> None:
        """Start without rows.

        rows: table of the DVL samples.
        reference, imu: recent samples of these streams.
        tally: counters by stream and for pairing.
        prior_sway_heave: (2,) m/s, prior for `prior_source: reference`.
        """
        self._rows, self._reference, self._imu, self._tally = rows, reference, imu, tally
        self._has_lever_arm = any(parameters.lever_arm)
        self.needs_turn_rate = self._has_lever_arm or parameters.max_turn_rate > 0.0
        self.n_judged = self.n_oriented = self.n_paired = 0
        self.given = dict.fromkeys(Needs, 0)
        self.gates = Gates()
        self.prior = PriorWindow(parameters, prior_sway_heave)
        self.decided_ns = LONG_AGO_NS

    def judge(self, end: int, parameters: Parameters) -> None:
        """Decide the verdicts of the rows before `end`, and count them."""
        first, rows, tally = self.n_judged, self._rows, self._tally["dvl"]
        if end <= first:
            return
        part = slice(first - rows.base, end - rows.base)
        rates = rows.attitude[part, 4:]
        verdict = self.gates.judge(rows.velocity_dvl[part], rates, parameters)
        rows.verdict[part] = verdict
        self.n_judged = end
        used = verdict == SampleUse.USED
        n_used = int(np.count_nonzero(used))
        if n_used < end - first:
            for code, count in enumerate(np.bincount(verdict, minlength=len(SampleUse.NAMES)).tolist()):
                if code != SampleUse.USED:
                    add_count(tally, SampleUse.NAMES[code], count)
        self.given[Needs.NOTHING] += n_used
        if self._has_lever_arm:
            add_count(tally, "lever_arm_uncompensated", int(np.count_nonzero(used & np.isnan(rates[:, 0]))))
        if n_used:
            slots = np.flatnonzero(used) + part.start
            rows.prior_known[slots] = self.prior.known_at(rows.stamps_ns[slots], rows.velocity_dvl[slots])

    def orient(self, newest_ns: Stamps, parameters: Parameters) -> None:
        """Orient the next rows (N,). newest_ns: (N,) newest IMU stamp at each decision."""
        n, first, rows, track = len(newest_ns), self.n_oriented, self._rows, self._imu
        if not n:
            return
        part = slice(first - rows.base, first + n - rows.base)
        before, after, fraction, found = track.brackets(rows.stamps_ns[part], newest_ns)
        if found.any():
            values = np.where(found[:, None], track.values[after, :7], math.nan)
            between = np.flatnonzero(found & (fraction != 1.0))
            if len(between):
                earlier, later, share = track.values[before[between], :7], values[between], fraction[between]
                values[between, :4] = slerps(earlier[:, :4], later[:, :4], share)
                values[between, 4:] = earlier[:, 4:] + (later[:, 4:] - earlier[:, 4:]) * share[:, None]
            rows.attitude[part] = values
        self.n_oriented = first + n
        if self.needs_turn_rate:
            self.judge(first + n, parameters)
        usable = rows.verdict[part] == SampleUse.USED
        n_usable = int(np.count_nonzero(usable))
        oriented = int(np.count_nonzero(usable & ~np.isnan(rows.attitude[part, 0] + rows.attitude[part, 4])))
        add_count(self._tally["pairing"], "oriented", oriented)
        add_count(self._tally["pairing"], "not_oriented", n_usable - oriented)
        self.given[Needs.ATTITUDE] += oriented
        self.given[Needs.ATTITUDE_IF_KNOWN] += n_usable

    def in_earth_frame(self, end: int, newest_ns: Stamps) -> Mask:
        """Return a mask (N,) of the next rows before `end` with an earth-frame reference. newest_ns: as for `pair`."""
        rows, track = self._rows, self._reference
        stamps_ns = rows.stamps_ns[self.n_paired - rows.base : end - rows.base]
        _, after, _, found = track.brackets(stamps_ns, newest_ns)
        return found & (track.frames[after] != BODY)

    def pair(self, newest_ns: Stamps) -> None:
        """Pair the next rows (N,). newest_ns: (N,) newest reference stamp at each decision."""
        n, first, rows, track = len(newest_ns), self.n_paired, self._rows, self._reference
        if not n:
            return
        part = slice(first - rows.base, first + n - rows.base)
        stamps_ns = rows.stamps_ns[part]
        before, after, fraction, found = track.brackets(stamps_ns, newest_ns)
        pairing = np.full(n, Pairing.UNPAIRED, dtype=np.uint8)
        if found.any():
            has_before = found & (before >= 0)
            before = np.maximum(before, track.begin)
            between = has_before & (fraction != 1.0)
            frame = track.frames[after]
            has_attitude = (frame == BODY) | ~np.isnan(rows.attitude[part, 0])
            is_pair = found & (~between | (track.frames[before] == frame))
            pairing[is_pair] = np.where(has_attitude[is_pair], Pairing.PAIRED, Pairing.WITHOUT_ATTITUDE)
            is_paired = is_pair & has_attitude
            # The mean of two samples is less noisy than each, but neighbouring rows share the samples. The plain mean
            # of the covariances counts the information of each reference sample once.
            earlier, later = track.values[before], track.values[after]
            values = np.where(between[:, None], earlier + (later - earlier) * fraction[:, None], later)
            rows.reference[part] = np.where(is_paired[:, None], values, math.nan)
            rows.frames[part] = np.where(is_paired, frame, 0)
            earlier_bits, later_bits = track.unmeasured[before], track.unmeasured[after]
            rows.unmeasured[part] = np.where(is_paired, np.where(between, earlier_bits | later_bits, later_bits), 0)
            interval_ns = rows.interval_ns[part]
            shared = np.rint((track.stamps_ns[after] - track.stamps_ns[before]) / np.maximum(interval_ns, 1))
            is_shared = is_paired & has_before & (interval_ns > 0)
            rows.weight[part] = np.where(is_shared, 1.0 / np.maximum(1.0, shared), 1.0)
        rows.pairing[part] = pairing
        self.n_paired = first + n
        self.decided_ns = int(stamps_ns[-1])
        is_paired = pairing == Pairing.PAIRED
        paired, tally = int(np.count_nonzero(is_paired)), self._tally["pairing"]
        add_count(tally, "paired", paired)
        add_count(tally, "unpaired", n - paired)
        add_count(tally, "without_attitude", int(np.count_nonzero(pairing == Pairing.WITHOUT_ATTITUDE)))
        self.given[Needs.REFERENCE] += int(np.count_nonzero(is_paired & (rows.verdict[part] == SampleUse.USED)))


class Rows(RowTable):
    """Growing columns of `AlignedBlock`."""

    stamps_ns: Stamps = column(np.int64)
    row: Stamps = column(np.int64)
    velocity_dvl: Array = column(np.float64, 3)
    covariance: Array = column(np.float64, 3, 3)
    interval_ns: Stamps = column(np.int64)
    verdict: Codes = column(np.uint8)
    prior_known: Mask = column(np.bool_)
    attitude: Array = column(np.float64, 7)
    pairing: Codes = column(np.uint8)
    reference: Array = column(np.float64, 12)
    frames: Codes = column(np.uint8)
    unmeasured: Codes = column(np.uint8)
    weight: Array = column(np.float64)
    late: Mask = column(np.bool_)

    def await_partners(self, at: int | slice) -> None:
        """Mark rows as undecided."""
        self.verdict[at] = SampleUse.AWAITING
        self.prior_known[at] = False
        self.attitude[at] = math.nan
        self.pairing[at] = Pairing.AWAITING
        self.reference[at] = math.nan
        self.frames[at] = self.unmeasured[at] = 0
        self.weight[at] = 1.0

    def block(self, first: int, end: int) -> AlignedBlock:
        """Return the rows with these numbers, valid until rows are added."""
        at = slice(first - self.base, end - self.base)
        return AlignedBlock(*[getattr(self, name)[at] for name in _COLUMNS])


_COLUMNS = [column.name for column in fields(AlignedBlock)]


class Gates:
    """Gates for DVL samples, in order. repeated: number of samples equal to the previous velocity."""

    def __init__(self) -> None:
        self.repeated = 0
        self._velocity_before: Vector | None = None
        self._repeats = 0

    def judge(self, velocity: Array, angular_velocity: Array, p: Parameters) -> Codes:
        """Return verdicts (N,). velocity: (N, 3) m/s. angular_velocity: (N, 3) rad/s, nan where unknown."""
        verdict = np.zeros(len(velocity), dtype=np.uint8)
        slow = _squared(velocity) < p.min_speed * p.min_speed
        if slow.any():
            verdict[slow] = SampleUse.SLOW
            moving = np.flatnonzero(~slow)
            verdict[moving[self._frozen(velocity[moving], p)]] = SampleUse.FROZEN
        else:
            verdict[self._frozen(velocity, p)] = SampleUse.FROZEN
        if p.max_turn_rate > 0.0:
            square = _squared(angular_velocity)
            is_open = verdict == SampleUse.USED
            verdict[is_open & np.isnan(square)] = SampleUse.NO_TURN_RATE
            verdict[is_open & (square > p.max_turn_rate * p.max_turn_rate)] = SampleUse.TURNING
        return verdict

    def _frozen(self, velocity: Array, p: Parameters) -> Mask:
        """Return a mask (N,) of samples whose velocity repeats too often; slow samples are excluded before."""
        n = len(velocity)
        if not n:
            return np.zeros(0, dtype=bool)
        is_same = np.empty(n, dtype=bool)
        is_same[0] = self._velocity_before is not None and tuple(velocity[0].tolist()) == self._velocity_before
        if n > 1:
            is_same[1:] = (velocity[1:] == velocity[:-1]).all(axis=1)
        if not is_same.any():
            x, y, z = velocity[-1].tolist()
            self._velocity_before, self._repeats = (x, y, z), 0
            return is_same
        index = np.arange(n)
        last_change = np.maximum.accumulate(np.where(is_same, -1, index))  # -1: before these samples
        repeats = np.where(last_change < 0, self._repeats + index + 1, index - last_change)
        self.repeated += int(np.count_nonzero(is_same))
        x, y, z = velocity[-1].tolist()
        self._velocity_before, self._repeats = (x, y, z), int(repeats[-1])
        return (repeats > p.max_repeats) if p.max_repeats > 0 else np.zeros(n, dtype=bool)


def _squared(vectors: Array) -> Array:
    x, y, z = vectors.T
    square: Array = x * x + y * y + z * z
    return square


class PriorWindow:
    """Prior sway and heave (m/s, body frame) of M5 and M6."""

    def __init__(self, parameters: Parameters, given: tuple[float, float] | None) -> None:
        self._rotation_body_from_dvl = parameters.rotation_dvl_from_body.T
        self._window_ns = round(parameters.prior_window * 1e9)
        self._start_ns: int | None = None
        self._sum = np.zeros(2)
        self._count = 0
        self.sway_heave: Array = np.array(parameters.prior_sway_heave if given is None else given)
        self._collecting = parameters.prior_source == "initial_window"

    def known_at(self, stamps_ns: Stamps, velocity_dvl: Array) -> Mask:
        """Return a mask of usable samples (N,), in order, with known prior; average the earlier ones into it."""
        known = np.ones(len(stamps_ns), dtype=bool)
        if not self._collecting or not len(stamps_ns):
            return known
        if self._start_ns is None:
            self._start_ns = int(stamps_ns[0])
        known = stamps_ns - self._start_ns >= self._window_ns
        first = int(np.argmax(known)) if known.any() else len(known)
        for velocity in velocity_dvl[:first]:
            self._sum += (self._rotation_body_from_dvl @ velocity)[1:]
        self._count += first
        if first < len(known):
            self._collecting = False
            self.sway_heave = self._sum / self._count
        return known
