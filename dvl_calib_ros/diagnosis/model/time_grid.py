"""Times at which the streams of a recording are compared.

Shapes: F samples, M bins of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...effects.base import ActsOn, Injection, true_times
from .recorded_streams import RecordedStreams
from .settings import SETTINGS
from .stream_curve import FAST_ENOUGH_S

# Interval, s, of the motion that a filter follows if the grid is slower than `FAST_ENOUGH_S`: from slopes at 1 Hz, a
# wave of 5 s is a quarter too small
MOTION_INTERVAL_S = 0.1


@dataclass(frozen=True)
class Grid:
    """Times of the comparison: the samples of the rougher stream, which avoids interpolating it.

    Interpolated noise depends on the phase, and motion between distant samples is lost.
    clock: of the rougher stream, DVL_CLOCK or REFERENCE_CLOCK.
    stamps: (M * per_bin,) s, of that clock.
    delay_s: its delay from the initial guess.
    """

    clock: ActsOn
    stamps: Array
    per_bin: int
    delay_s: float = 0.0

    @property
    def bin_time(self) -> Array:
        """Return (M,) s, centres of the bins, corrected by the initial guess."""
        return self.stamps.reshape(-1, self.per_bin).mean(axis=1) - self.delay_s

    def averaged(self, values: Array) -> Array:
        """Average (F, ...) per bin, (M, ...)."""
        total = values[:: self.per_bin].astype(float)
        for of_bin in range(1, self.per_bin):  # few passes are faster than a mean along a short axis
            total += values[of_bin :: self.per_bin]
        return total / self.per_bin

    def between(self, time: Array) -> tuple[Array, NDArray[np.intp]] | None:
        """Return closer times (C,) s that include the samples (F,), except in gaps, and the samples' indices.

        Return None if the samples are close enough, or too many.
        """
        if len(time) < 2:
            return None
        steps = np.diff(time)
        interval = float(np.median(steps))
        parts = min(int(np.ceil(interval / MOTION_INTERVAL_S)), SETTINGS.max_points // len(time))
        if interval <= FAST_ENOUGH_S or parts < 2:
            return None
        of_each = np.where(steps < SETTINGS.max_gap_intervals * interval, parts, 1)
        own = np.concatenate([[0], np.cumsum(of_each)])
        return np.interp(np.arange(own[-1] + 1), own, time), own

    def true_time(self, injections: Sequence[Injection]) -> Array:
        """Return the true times (F,) s, increasing, of the stamps.

        A tried clock jump where there is none reverses some samples. These follow at half the usual interval until they
        have the jump's delay. An actual jump leaves a gap in the stamps, not in time.
        """
        time = true_times(injections, self.clock, self.stamps)
        least = self._least
        return time if (np.diff(time - least) > 0.0).all() else np.maximum.accumulate(time - least) + least

    @cached_property
    def _least(self) -> Array:
        """Return the least time (F,) s since the first sample; cached, because no hypothesis changes it."""
        steps = np.diff(self.stamps, prepend=self.stamps[:1])
        return np.asarray(0.5 * np.cumsum(np.minimum(steps, np.median(steps))))


@dataclass(frozen=True)
class Offsets:
    """Delays, s, of the DVL's and the reference's stamps against the attitude's; initial guess."""

    dvl: float = 0.0
    reference: float = 0.0


# Largest difference of a hypothesis' offsets from the initial guess, s, with data on all bins
MARGIN_S = 0.5


def make_grid(recording: RecordedStreams, offsets: Offsets) -> Grid:
    """Choose the times at which all streams of a recording are available, from the rougher of DVL and reference."""
    settings = SETTINGS
    by_dvl = float(np.linalg.norm(recording.dvl.roughness)) > float(np.linalg.norm(recording.reference.roughness))
    base, clock = (recording.dvl, ActsOn.DVL_CLOCK) if by_dvl else (recording.reference, ActsOn.REFERENCE_CLOCK)
    base_delay_s = offsets.dvl if by_dvl else offsets.reference
    seconds = len(base.time) * base.interval  # a pause does not widen the bins
    width = max(settings.bins_per_interval * base.interval, settings.shortest_bin, seconds / settings.max_bins)
    per_bin = max(2, round(width / base.interval))
    streams = (recording.dvl, offsets.dvl), (recording.reference, offsets.reference)
    others = [(curve, delay_s) for curve, delay_s in streams if curve is not base]
    complete = np.ones(len(base.time), dtype=bool)
    for curve, delay_s in (*others, *((each, 0.0) for each in (recording.attitude, recording.rates) if each)):
        complete &= curve.is_complete_at(base.time - base_delay_s + delay_s)
    stamps = base.time[complete]
    true = stamps - base_delay_s
    valid = np.ones(len(true), dtype=bool)
    for curve, delay_s in others:
        for shift in (base_delay_s - delay_s, -MARGIN_S, MARGIN_S):
            valid &= curve.covers(true + delay_s + shift)
    if not by_dvl:  # the DVL has no samples while its clock repeats, whatever its delay
        for event in recording.backward_steps:
            dvl_stamps, margin = true + offsets.dvl, event.by + MARGIN_S
            valid &= (dvl_stamps < event.before - margin) | (dvl_stamps > event.after + margin)
    for oriented in (recording.attitude, recording.rates):
        for shift in (base_delay_s, -MARGIN_S, MARGIN_S):
            valid &= True if oriented is None else oriented.covers(true + shift)
    breaks = np.flatnonzero(np.diff(stamps) > settings.max_gap_intervals * base.interval) + 1
    kept = []
    for run in np.split(np.arange(len(true)), np.unique(np.concatenate([breaks, np.flatnonzero(np.diff(valid)) + 1]))):
        if len(run) and valid[run[0]]:
            kept.append(run[: len(run) // per_bin * per_bin])
    return Grid(clock, stamps[np.concatenate(kept)] if kept else np.zeros(0), per_bin, base_delay_s)
