"""Removal of messages whose times are absurdly far from the rest of a recording.

A computer without a clock battery begins in 1970, and a broken stamp may have any year. After the removal no recording
spans decades. Pauses of hours and clock steps remain: there stamps and log times change together. A log time that
changes alone is wrong, even if it is close.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from itertools import chain

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


def far(each: Sequence[Stamps]) -> list[Mask]:
    """Return, per stream, which stamps lie in a segment that must be removed.

    Segments are formed from all streams together. A stream keeps the segment shared by most streams, among those with
    more than a small share of its own stamps; it loses other segments that are small or more than a year away.

    Parameters
    ----------
    each: Stamps (N,) ns of each stream, in any order.
    """
    none = [np.zeros(len(stamps_ns), dtype=bool) for stamps_ns in each]
    given = [stamps_ns for stamps_ns in each if len(stamps_ns)]
    if not given or max(int(own.max()) for own in given) - min(int(own.min()) for own in given) <= SEGMENT_GAP_NS:
        return none
    in_order = np.sort(np.concatenate(given))
    breaks = np.flatnonzero(np.diff(in_order) > SEGMENT_GAP_NS) + 1
    if not len(breaks):
        return none
    starts, ends = in_order[np.append(0, breaks)], in_order[np.append(breaks, len(in_order)) - 1]
    segment_of = [np.searchsorted(starts, own, side="right") - 1 for own in each]
    shares = np.array([np.bincount(of, minlength=len(starts)) / max(len(of), 1) for of in segment_of])
    weights = shares.sum(axis=0)
    found = []
    for of, share in zip(segment_of, shares, strict=True):
        large = share >= min(SMALL_SHARE, share.max())
        main = int(np.argmax(np.where(large, weights, -1.0)))
        apart_ns = np.maximum(starts - ends[main], starts[main] - ends)
        aside = ~large | (apart_ns > FURTHEST_NS)
        aside[main] = False
        found.append(aside[of])
    return found


def logged_elsewhere(stamps_ns: Sequence[Stamps], log_ns: Sequence[Stamps]) -> list[Mask]:
    """Return, per stream, which log times contradict stamps and neighbours and would extend the recording.

    Most messages of a stream have a similar delay from stamp to log time. A message with another delay has a wrong log
    time if that lies outside all others, and its stamp inside.

    Parameters
    ----------
    stamps_ns: Stamps (N,) ns of each stream.
    log_ns: Log times (N,) ns of the same messages.
    """
    found, due_ns = [], []
    for stamps, logged in zip(stamps_ns, log_ns, strict=True):
        other = np.zeros(len(logged), dtype=bool)
        due: Array = logged.astype(float)
        if len(logged) > 2 and float(np.diff(due).max()) > LEAST_PAUSE_NS:
            delay = due - stamps
            usual = float(median(delay))
            off = np.abs(delay - usual)
            other = off > max(LEAST_PAUSE_NS, OTHER_DELAY * float(median(off)))
            other &= np.count_nonzero(other) <= max(SMALL_SHARE * len(other), 1)
            due -= delay - usual
        found.append(other)
        due_ns.append(due)
    sound = [logged[~other] for logged, other in zip(log_ns, found, strict=True) if not other.all()]
    if not any(other.any() for other in found) or not sound:
        return found
    first = min(int(own.min()) for own in sound) - LEAST_PAUSE_NS
    last = max(int(own.max()) for own in sound) + LEAST_PAUSE_NS
    return [
        other & ((logged < first) | (logged > last)) & (due >= first) & (due <= last)
        for other, logged, due in zip(found, log_ns, due_ns, strict=True)
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
    log_ns = [columns[name].arrivals[1] for name in names]
    joined = np.concatenate([np.zeros(0, dtype=np.int64), *log_ns])
    [by_log] = far([joined])
    of_log = np.split(by_log, np.cumsum([len(own) for own in log_ns])[:-1]) if names else []
    # a topic that is far as a whole has another clock, which is detected and reported later
    of_log = [np.zeros_like(own) if len(own) >= FEWEST_OF_A_CLOCK and own.all() else own for own in of_log]
    stamps_ns = [columns[name].stamps_ns for name in names]
    of_log = [own | other for own, other in zip(of_log, logged_elsewhere(stamps_ns, log_ns), strict=True)]
    by_log = np.concatenate([by_log[:0], *of_log])
    # messages with wrong log times may have stamps of the same clock: they do not count
    of_stamps = far([own[~aside] for own, aside in zip(stamps_ns, of_log, strict=True)])
    kept = dict(columns)
    findings: list[Reason] = []
    for name, own, own_log, recorded, stamped in zip(names, stamps_ns, log_ns, of_log, of_stamps, strict=True):
        aside = recorded.copy()
        aside[~recorded] = stamped
        findings += chain(_named(name, "recorded", own_log, recorded), _named(name, "stamped", own, aside & ~recorded))
        if aside.any():
            kept[name] = columns[name].part(~aside)
    return kept, tuple(_within(spans_ns, joined[~by_log], set(joined[by_log].tolist()))), findings


def _named(topic: str, how: str, times_ns: Stamps, aside: Mask) -> Iterator[Reason]:
    """Yield the finding on the removed messages of a topic, from the mask (N,)."""
    if aside.any():
        own = times_ns[aside]
        first, last = _date(int(own.min())), _date(int(own.max()))
        yield finding(
            "STAMPS_FAR", topic=topic, count=len(own), how=how, when=f"at {first}" if first == last else
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
        own = kept_ns[(kept_ns >= start_ns) & (kept_ns <= end_ns)]
        if len(own):
            first_ns, last_ns = int(own.min()), int(own.max())
            yield (
                first_ns if start_ns in aside_ns or first_ns - start_ns > most_ns else start_ns,
                last_ns if end_ns in aside_ns or end_ns - last_ns > most_ns else end_ns,
            )
        elif not aside_ns:
            yield start_ns, end_ns
