"""Model-free properties of a DVL's messages: rate, jitter, latency, dropouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import SampleBlock, Stamps
from ..diagnosis.model.recorded_streams import zeros_while_moving
from ..messages.decode import MessageDecoder
from ..recordings.recording import Recording
from ..recordings.topics import Topics

# log times further from the stamps belong to another clock (simulated time), so the latency is unknown, s
OTHER_CLOCK_S = 60.0
# longer intervals, in typical ones, are dropouts
DROPOUT_INTERVALS = 1.6


@dataclass(frozen=True)
class StreamFacts:
    """Properties of one recording's DVL messages, N in order of stamps.

    steps: (N - 1,) s between stamps. latency: (N,) s from stamp to log time; empty if these are of different clocks.
    values: (N, 3) m/s of valid messages, without zeros while moving. received: number of messages. missing, refused,
    zero: number of events (runs) of missing messages, of messages marked invalid, of exact zeros while moving. lost:
    number of samples in all of these. repeats: valid messages that repeat the previous velocity exactly.
    """

    steps: Array
    latency: Array
    values: Array
    received: int
    missing: int
    refused: int
    zero: int
    lost: int
    repeats: int

    @property
    def interval(self) -> float:
        """Return the typical time between stamps, s."""
        return float(np.median(self.steps)) if len(self.steps) else np.nan


def stream_facts(recording: Recording, parameters: Parameters, topics: Topics) -> StreamFacts:
    """Return the properties of one recording's DVL stream."""
    chosen = topics.found_in(recording.types)
    streams = recording.streams(chosen, MessageDecoder(recording.of_types(chosen, parameters)))
    (columns,) = recording.columns[chosen.dvl]
    return facts_of(streams.dvl, streams.reference, columns.arrivals[1])


def facts_of(dvl: SampleBlock, reference: SampleBlock, log_ns: Stamps) -> StreamFacts:
    """Compute from all messages of a DVL and of its reference, in order of arrival; log_ns: (N,) of the DVL's."""
    refused = dvl.refused > 0
    order = np.argsort(reference.stamps_ns, kind="stable")
    zero = zeros_while_moving(dvl, reference.part(order)) & ~refused
    finite = np.isfinite(dvl.values).all(axis=1)
    sound = np.flatnonzero(~refused & ~zero & finite)
    stamps = np.sort(dvl.stamps_ns[~refused])
    steps = 1e-9 * np.diff(stamps)
    steps = steps[steps > 0.0]
    usual = float(np.median(steps)) if len(steps) else np.nan
    gaps = steps[steps > DROPOUT_INTERVALS * usual] if len(steps) else steps
    latency = 1e-9 * (log_ns - dvl.stamps_ns)[sound] if len(log_ns) == len(dvl) else np.zeros(0)
    if len(latency) and abs(float(np.median(latency))) > OTHER_CLOCK_S:
        latency = np.zeros(0)
    values = dvl.values[sound]
    between = int(np.rint(gaps / usual - 1.0).sum()) if len(gaps) else 0
    return StreamFacts(
        steps=steps,
        latency=latency,
        values=values,
        received=len(dvl),
        missing=len(gaps) if not refused.any() else 0,
        refused=_runs(refused),
        zero=_runs(zero),
        lost=max(between, int(refused.sum())) + int(zero.sum()),
        repeats=int((np.diff(values, axis=0) == 0.0).all(axis=1).sum()),
    )


def _runs(mask: NDArray[np.bool_]) -> int:
    """Return the number of runs of true values."""
    return int(np.count_nonzero(np.diff(mask.astype(int), prepend=0) > 0))
