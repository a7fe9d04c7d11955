"""What the stamps of a DVL's messages and their contents show without any model: rate, jitter, latency, dropouts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..bags.columns import windows
from ..bags.reader import BagReader
from ..calibration.frames import Array
from ..calibration.parameters import Parameters
from ..calibration.samples import SampleBlock, Stream
from ..diagnosis.recordings import zeros_while_moving
from ..messages.columns import sample_streams
from ..messages.decode import MessageDecoder
from ..messages.opening import open_recordings
from ..replay.replay import Topics, _of_types

# Log times further from the stamps belong to another clock (simulated time beside the host's) and say no latency, s
OTHER_CLOCK_S = 60.0
# Intervals longer than so many usual ones are dropouts
DROPOUT_INTERVALS = 1.6


@dataclass(frozen=True)
class StreamFacts:
    """Of one recording's DVL messages, N in order of stamps.

    steps: (N - 1,) s between stamps. latency: (N,) s from stamp to log time; empty where these are of two clocks.
    values: (N, 3) m/s of valid messages, zeros while moving left out. received: messages. missing, refused, zero:
    events (runs) of missing messages, of those that say they are not valid, of exact zeros while moving; lost: samples
    in all of these. repeats: valid messages with the very velocity of the one before.
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
        """Usual time between stamps, s."""
        return float(np.median(self.steps)) if len(self.steps) else np.nan


def stream_facts(path: Path, parameters: Parameters, topics: Topics) -> StreamFacts:
    """Read the DVL's stream of a bag once more, with log times. Raises InputError."""
    with open_recordings([path]) as bag:
        chosen = topics.found_in(bag.topics)
        decoder = MessageDecoder(_of_types(bag, chosen, parameters))
        log_ns = _log_times(bag, chosen.dvl)
        named = {chosen.dvl: Stream.DVL, chosen.gnss: Stream.REFERENCE}
        streams = [stretch.streams for stretch in sample_streams(bag, named, decoder)]
    dvl = reduce(SampleBlock.joined, [each.dvl for each in streams])
    reference = reduce(SampleBlock.joined, [each.reference for each in streams])
    return facts_of(dvl, reference, log_ns)


def _log_times(bag: BagReader, topic: str) -> Array:
    parts = [part for window in windows(bag, [topic], [topic]) for part in window.parts]
    arrival, log_ns = (np.concatenate([getattr(p, name) for p in parts]) for name in ("arrival", "log_ns"))
    return np.asarray(log_ns[np.argsort(arrival, kind="stable")])


def facts_of(dvl: SampleBlock, reference: SampleBlock, log_ns: Array) -> StreamFacts:
    """From all messages of a DVL and of its reference, each in order of arrival; log_ns: (N,) of the DVL's."""
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
    """Number of stretches that are true."""
    return int(np.count_nonzero(np.diff(mask.astype(int), prepend=0) > 0))
