"""Which DVL samples in order are used: not too slow, not frozen, not in too sharp a turn. And the prior's window."""

from __future__ import annotations

import numpy as np

from .models.parameters import Parameters
from .numerics.frames import Array, Vector
from .numerics.samples import Codes, Mask, SampleUse, Stamps


class Gates:
    """Judges the samples of a DVL, in order. repeated: how many had exactly the velocity of the one before."""

    def __init__(self) -> None:
        self.repeated = 0
        self._velocity_before: Vector | None = None
        self._repeats = 0

    def judge(self, velocity: Array, angular_velocity: Array, p: Parameters) -> Codes:
        """Verdicts (N,). velocity: (N, 3) m/s. angular_velocity: (N, 3) rad/s, nan where not known."""
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
            open_ = verdict == SampleUse.USED
            verdict[open_ & np.isnan(square)] = SampleUse.NO_TURN_RATE
            verdict[open_ & (square > p.max_turn_rate * p.max_turn_rate)] = SampleUse.TURNING
        return verdict

    def _frozen(self, velocity: Array, p: Parameters) -> Mask:
        """(N,) of samples that are not slow: which repeat themselves too often."""
        n = len(velocity)
        if not n:
            return np.zeros(0, dtype=bool)
        same = np.empty(n, dtype=bool)
        same[0] = self._velocity_before is not None and tuple(velocity[0].tolist()) == self._velocity_before
        if n > 1:
            same[1:] = (velocity[1:] == velocity[:-1]).all(axis=1)
        if not same.any():  # as nearly always
            x, y, z = velocity[-1].tolist()
            self._velocity_before, self._repeats = (x, y, z), 0
            return same
        at = np.arange(n)
        other = np.maximum.accumulate(np.where(same, -1, at))  # the last one that was not the same; -1: before these
        repeats = np.where(other < 0, self._repeats + at + 1, at - other)
        self.repeated += int(np.count_nonzero(same))
        x, y, z = velocity[-1].tolist()
        self._velocity_before, self._repeats = (x, y, z), int(repeats[-1])
        return (repeats > p.max_repeats) if p.max_repeats > 0 else np.zeros(n, dtype=bool)


def _squared(vectors: Array) -> Array:
    x, y, z = vectors.T
    square: Array = x * x + y * y + z * z
    return square


class PriorWindow:
    """Prior sway and heave (m/s, body frame) of the models that need them."""

    def __init__(self, parameters: Parameters, given: tuple[float, float] | None) -> None:
        self._rotation_body_from_dvl = parameters.rotation_dvl_from_body.T
        self._window_ns = round(parameters.prior_window * 1e9)
        self._start_ns: int | None = None
        self._sum = np.zeros(2)
        self._count = 0
        self.sway_heave: Array = np.array(parameters.prior_sway_heave if given is None else given)
        self._collecting = parameters.prior_source == "initial_window"

    def known_at(self, stamps_ns: Stamps, velocity_dvl: Array) -> Mask:
        """Whether the prior is known at usable samples (N,), in order; until then, take them into the mean."""
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
