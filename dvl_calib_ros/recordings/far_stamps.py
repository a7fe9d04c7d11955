"""Removal of messages whose times are absurdly far from the rest of a recording.

A computer without a clock battery begins in 1970, and a broken stamp may have any year. After the removal no recording
spans decades. Pauses of hours and clock steps remain: there stamps and log times change together. A log time that
changes alone is wrong, even if it is close.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import datetime, timezone

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.robust import median
from ..calibration.numerics.samples import Mask, Stamps
from ..calibration.streams.clock_correction import SECOND_NS
from ..calibration.streams.stream_order import SEGMENT_GAP_NS
from ..verdict.reasons import Reason, finding
from .columns import TopicColumns

# no recording is this long, and 1970, where a clock without a battery begins, is further away
FURTHEST_NS = 365 * 86_400 * SECOND_NS
# a segment with a smaller share of a topic's messages is not a second dive in the same recording
SMALL_SHARE = 0.1
# fewer messages of a topic, all of them far away, are strays rather than another clock
FEWEST_OF_A_CLOCK = 10
# a recorder writes its buffer within seconds, so a log time this far outside the others is not a delay
LEAST_PAUSE_NS = 10 * SECOND_NS
# a delay this many times the typical one (median deviation from the median) differs from its neighbours'
OTHER_DELAY = 10.0
Span = tuple[int, int]


def far(streams: Sequence[Stamps]) -> list[Mask]:
    """Return, per stream, which stamps lie in a segment that must be removed.

    Segments are formed from all streams together. A stream keeps the segment shared by most streams, among those with
    more than a small share of its own stamps; it loses other segments that are small or more than a year away.

    Parameters
    ----------
    streams: Stamps (N,) ns of each stream, in any order.
    """
    nothing_far = [np.zeros(len(stamps_ns), dtype=bool) for stamps_ns in streams]
    spans = [(int(stamps_ns.min()), int(stamps_ns.max())) for stamps_ns in streams if len(stamps_ns)]
    if not spans or max(last for _, last in spans) - min(first for first, _ in spans) <= SEGMENT_GAP_NS:
        return nothing_far
    ascending = np.sort(np.concatenate(streams))
    breaks = np.flatnonzero(np.diff(ascending) > SEGMENT_GAP_NS) + 1
    if not len(breaks):
        return nothing_far
    starts, ends = ascending[np.append(0, breaks)], ascending[np.append(breaks, len(ascending)) - 1]
    segment_of = [np.searchsorted(starts, part, side="right") - 1 for part in streams]
    shares = np.array([np.bincount(segments, minlength=len(starts)) / max(len(segments), 1) for segments in segment_of])
    weights = shares.sum(axis=0)
    masks = []
    for segments, share in zip(segment_of, shares, strict=True):
        is_large = share >= min(SMALL_SHARE, share.max())
        main = int(np.argmax(np.where(is_large, weights, -1.0)))
        distances_ns = np.maximum(starts - ends[main], starts[main] - ends)
        is_removed = ~is_large | (distances_ns > FURTHEST_NS)
        is_removed[main] = False
        masks.append(is_removed[segments])
    return masks


def logged_elsewhere(stamps_ns: Sequence[Stamps], log_ns: Sequence[Stamps]) -> list[Mask]:
    """Return, per stream, which log times contradict stamps and neighbours and would extend the recording.

    Most messages of a stream have a similar delay from stamp to log time. A message with another delay has a wrong log
    time if that lies outside all others, and its stamp inside.

    Parameters
    ----------
    stamps_ns: Stamps (N,) ns of each stream.
    log_ns: Log times (N,) ns of the same messages.
    """
    masks, expected_ns = [], []
    for stamps, logged in zip(stamps_ns, log_ns, strict=True):
        is_other = np.zeros(len(logged), dtype=bool)
        expected: Array = logged.astype(float)
        if len(logged) > 2 and float(np.diff(expected).max()) > LEAST_PAUSE_NS:
            delay = expected - stamps
            typical = float(median(delay))
            deviation = np.abs(delay - typical)
            is_other = deviation > max(LEAST_PAUSE_NS, OTHER_DELAY * float(median(deviation)))
            is_other &= np.count_nonzero(is_other) <= max(SMALL_SHARE * len(is_other), 1)
            expected -= delay - typical
        masks.append(is_other)
        expected_ns.append(expected)
    trusted = [logged[~is_other] for logged, is_other in zip(log_ns, masks, strict=True) if not is_other.all()]
    if not any(is_other.any() for is_other in masks) or not trusted:
        return masks
    first = min(int(part.min()) for part in trusted) - LEAST_PAUSE_NS
    last = max(int(part.max()) for part in trusted) + LEAST_PAUSE_NS
    return [
        is_other & ((logged < first) | (logged > last)) & (expected >= first) & (expected <= last)
        for is_other, logged, expected in zip(masks, log_ns, expected_ns, strict=True)
    ]


def without_far(
    columns: Mapping[str, TopicColumns], spans_ns: Sequence[Span]
) -> tuple[dict[str, TopicColumns], tuple[Span, ...], list[Reason]]:
    """Remove messages recorded or stamped absurdly far from the rest of a recording.

    Parameters
    ----------
    columns: By topic, all messages of one recording.
    spans_ns: First and last log time of each of its files.

    Returns
    -------
    columns: The remaining messages.
    spans_ns: First and last log time of each file with remaining messages.
    findings: Descriptions of the removed messages.
    """
    names = [name for name, part in columns.items() if len(part)]
    log_ns = [columns[name].log_ns for name in names]
    joined = np.concatenate([np.zeros(0, dtype=np.int64), *log_ns])
    [is_log_far] = far([joined])
    log_masks = np.split(is_log_far, np.cumsum([len(stamps) for stamps in log_ns])[:-1]) if names else []
    # a topic that is far as a whole has another clock, which is detected and reported later
    log_masks = [np.zeros_like(mask) if len(mask) >= FEWEST_OF_A_CLOCK and mask.all() else mask for mask in log_masks]
    stamps_ns = [columns[name].stamped_ns for name in names]
    log_masks = [mask | wrong for mask, wrong in zip(log_masks, logged_elsewhere(stamps_ns, log_ns), strict=True)]
    is_log_far = np.concatenate([is_log_far[:0], *log_masks])
    # messages with wrong log times may have stamps of the same clock: they do not count
    stamp_masks = far([stamps[~is_removed] for stamps, is_removed in zip(stamps_ns, log_masks, strict=True)])
    kept = dict(columns)
    findings: list[Reason] = []
    for name, stamps, logged, by_log, by_stamp in zip(names, stamps_ns, log_ns, log_masks, stamp_masks, strict=True):
        is_removed = by_log.copy()
        is_removed[~by_log] = by_stamp  # by_stamp has only the messages with good log times
        findings += _named(name, "recorded", logged, by_log)
        findings += _named(name, "stamped", stamps, is_removed & ~by_log)
        if is_removed.any():
            kept[name] = columns[name].part(~is_removed)
    return kept, tuple(_within(spans_ns, joined[~is_log_far], set(joined[is_log_far].tolist()))), findings


def _named(topic: str, how: str, times_ns: Stamps, aside: Mask) -> Iterator[Reason]:
    """Yield the finding on the removed messages of a topic, from the mask (N,)."""
    if aside.any():
        far_ns = times_ns[aside]
        first, last = _date(int(far_ns.min())), _date(int(far_ns.max()))
        yield finding(
            "STAMPS_FAR", topic=topic, count=len(far_ns), how=how, when=f"at {first}" if first == last else
            f"from {first} to {last}", total=len(aside),
        )  # fmt: skip


def _date(at_ns: int) -> str:
    return datetime.fromtimestamp(at_ns // SECOND_NS, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")


def _within(spans_ns: Sequence[Span], kept_ns: Stamps, aside_ns: Collection[int]) -> Iterator[Span]:
    """Yield the spans without ends that were removed or are far from the times (N,) kept.

    An end may be far because of a message on an unread topic. aside_ns: removed times; a file with only these is
    omitted.
    """
    length_ns = int(kept_ns.max() - kept_ns.min()) if len(kept_ns) else 0
    most_ns = min(max(length_ns, LEAST_PAUSE_NS), SEGMENT_GAP_NS)
    for start_ns, end_ns in spans_ns:
        inside_ns = kept_ns[(kept_ns >= start_ns) & (kept_ns <= end_ns)]
        if len(inside_ns):
            first_ns, last_ns = int(inside_ns.min()), int(inside_ns.max())
            yield (
                first_ns if start_ns in aside_ns or first_ns - start_ns > most_ns else start_ns,
                last_ns if end_ns in aside_ns or end_ns - last_ns > most_ns else end_ns,
            )
        elif not aside_ns:
            yield start_ns, end_ns
