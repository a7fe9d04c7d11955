"""Segments of time that the messages of a recording lie in: those that are absurdly far from the data are set aside.

A computer without a clock battery begins in 1970, and one broken stamp may name any year. Whatever looks at a recording
later may so rely on it that time does not span decades. Pauses of hours, and clocks that are set, are left as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from itertools import chain

import numpy as np

from ..calibration.numerics.samples import Mask, Stamps
from ..calibration.streams.clock_correction import SECOND_NS
from ..calibration.streams.stream_order import SEGMENT_GAP_NS
from ..verdict.reasons import Reason, finding
from .columns import TopicColumns

# What is further away is never of use: no recording is as long, and 1970 is where a clock without a battery begins.
FURTHEST_NS = 365 * 86_400 * SECOND_NS
# A segment with a smaller share of a topic's messages is no second dive in the same recording.
SMALL_SHARE = 0.1
# Fewer messages of a topic, all of them far away, are strays and no clock.
FEWEST_OF_A_CLOCK = 10
Span = tuple[int, int]


def far(each: Sequence[Stamps]) -> list[Mask]:
    """Return, per stream, which stamps lie in a segment that is to be set aside.

    Segments are those of all streams together. A stream keeps the segment that most streams are in, of those that hold
    more than a small share of its own stamps; of the others it loses what is small, or more than a year away.

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


def without_far(
    columns: Mapping[str, TopicColumns], spans_ns: Sequence[Span]
) -> tuple[dict[str, TopicColumns], tuple[Span, ...], list[Reason]]:
    """Set aside what was recorded, or stamped, absurdly far from the rest of a recording.

    Parameters
    ----------
    columns: By topic, all messages of one recording.
    spans_ns: First and last log time of each of its files.

    Returns
    -------
    columns: The same without those messages.
    spans_ns: First and last log time of each file that holds others.
    findings: What was set aside.

    """
    names = [name for name, part in columns.items() if len(part)]
    log_ns = [columns[name].arrivals[1] for name in names]
    joined = np.concatenate([np.zeros(0, dtype=np.int64), *log_ns])
    [by_log] = far([joined])
    of_log = np.split(by_log, np.cumsum([len(own) for own in log_ns])[:-1]) if names else []
    # a topic that is far as a whole has another clock, which is found and said later
    of_log = [np.zeros_like(own) if len(own) >= FEWEST_OF_A_CLOCK and own.all() else own for own in of_log]
    by_log = np.concatenate([by_log[:0], *of_log])
    stamps_ns = [columns[name].stamps_ns for name in names]
    # what was recorded far away may be stamped by the same clock: it has no say
    of_stamps = far([own[~aside] for own, aside in zip(stamps_ns, of_log, strict=True)])
    kept = dict(columns)
    findings: list[Reason] = []
    for name, own, own_log, recorded, stamped in zip(names, stamps_ns, log_ns, of_log, of_stamps, strict=True):
        aside = recorded.copy()
        aside[~recorded] = stamped
        findings += chain(_named(name, "recorded", own_log, recorded), _named(name, "stamped", own, aside & ~recorded))
        if aside.any():
            kept[name] = columns[name].part(~aside)
    return kept, tuple(_within(spans_ns, joined[~by_log], bool(by_log.any()))), findings


def _named(topic: str, how: str, times_ns: Stamps, aside: Mask) -> Iterator[Reason]:
    """Yield what is said of the messages (N,) of a topic that are set aside."""
    if aside.any():
        own = times_ns[aside]
        first, last = _date(int(own.min())), _date(int(own.max()))
        yield finding(
            "STAMPS_FAR", topic=topic, count=len(own), how=how, when=f"at {first}" if first == last else
            f"from {first} to {last}", total=len(aside),
        )  # fmt: skip


def _date(at_ns: int) -> str:
    return datetime.fromtimestamp(at_ns // SECOND_NS, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")


def _within(spans_ns: Sequence[Span], kept_ns: Stamps, has_far: bool) -> Iterator[Span]:
    """Yield the spans without ends that are absurdly far from the times (N,) kept.

    Such an end is a message that was set aside, or of a topic that nobody reads. has_far: whether any was set aside; a
    file that holds nothing else is left out.
    """
    for start_ns, end_ns in spans_ns:
        own = kept_ns[(kept_ns >= start_ns) & (kept_ns <= end_ns)]
        if len(own):
            first_ns, last_ns = int(own.min()), int(own.max())
            yield (
                first_ns if first_ns - start_ns > SEGMENT_GAP_NS else start_ns,
                last_ns if end_ns - last_ns > SEGMENT_GAP_NS else end_ns,
            )
        elif not has_far:
            yield start_ns, end_ns
