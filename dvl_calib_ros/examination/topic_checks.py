"""Checks of a single topic: stamps, gaps, zeros, repetitions, covariances, axes."""

from __future__ import annotations

import numpy as np

from ..calibration.checks.data_warnings import STREAMS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Stream
from ..calibration.streams.clock_correction import SECOND_NS
from ..calibration.streams.stream_order import strays
from ..messages.drivers import VELOCITY_TYPES
from ..recordings.topic_messages import Recorded
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding

# with fewer messages, rates and jitter are not evaluated
ENOUGH = 20
# smallest shares of faulty messages that are reported
SOME, MANY = 0.005, 0.05
# with this share of repeated stamps, less than one sample in twenty is used
MOST = 0.95
# stamps with more jitter than this share of their interval ...
JITTER = 0.05
# ... and with negative correlation of successive intervals, as in reception jitter (white jitter gives -0.5)
AGAINST_RHYTHM = -0.3
# ... and with this correlation of intervals of stamps and reception: the way to the recorder adds less than a seventh
# of the jitter. A sensor that pings unevenly and stamps well has less.
BY_RECEPTION = 0.99
# a larger step of the stamps relative to the log means that the clock was set (s)
SET_CLOCK = 1.0
# smallest gap, and its smallest number of intervals (s, 1)
GAP, GAP_INTERVALS = 2.0, 5.0
# limits of the ratio of claimed to observed noise
CLAIMS_TOO_MUCH, CLAIMS_TOO_LITTLE = 5.0, 0.1
# a reference's noise is slow and not visible between messages, so only impossible claims are reported (m/s)
NO_RECEIVER = (1e-3, 1.0)
# ratio of a normal distribution's standard deviation to its median absolute deviation
NORMAL_FROM_MEDIAN = 1.4826
# a smaller noise is negligible (m/s)
QUIET = 0.02


def interval_s(topic: Recorded) -> float:
    """Return the median interval of the messages, s; 0 for fewer than two."""
    return float(np.median(np.diff(topic.log_ns))) * 1e-9 if len(topic) > 1 else 0.0


def stamp_findings(topic: Recorded, stream: Stream, parameters: Parameters) -> list[Reason]:
    """Report undecodable or too few messages, and faults of their stamps."""
    found = []
    if topic.unreadable:
        of_all = {"count": topic.unreadable, "total": topic.unreadable + len(topic)}
        unread = finding("DOCTOR_UNDECODABLE", topic=topic.topic, **of_all, reason=topic.unreadable_because)
        found.append(unread.weighed(Severity.WARNING if len(topic) >= ENOUGH else Severity.ERROR))
    if len(topic) < ENOUGH:
        return found or [finding("DOCTOR_TOO_FEW", topic=topic.topic, count=len(topic))]
    zero = topic.stamps_ns == 0
    if zero.any():
        found.append(finding("DOCTOR_STAMP_ZERO", topic=topic.topic, share=zero.mean()))
    stamps, log = topic.stamps_ns[~zero], topic.log_ns[~zero]
    if len(stamps) < ENOUGH:
        return found
    stray = strays(stamps, round(parameters.max_time_jump * SECOND_NS))
    if stray.any():  # a calibration does not use them
        found.append(finding("STAMP_STRAY", count=int(stray.sum()), stream=STREAMS[stream.value]))
        stamps, log = stamps[~stray], log[~stray]
    steps, log_steps = np.diff(stamps) * 1e-9, np.diff(log) * 1e-9
    back = steps < 0.0
    if back.any():
        seconds = float(-steps[back].min())
        found.append(finding("DOCTOR_STAMP_BACK", topic=topic.topic, count=int(back.sum()), seconds=seconds))
    comes_back = strays(stamps, round(SET_CLOCK * SECOND_NS))
    ahead = np.where(comes_back[1:] | comes_back[:-1], 0.0, steps - log_steps)
    if ahead.max() > SET_CLOCK:
        found.append(finding("DOCTOR_STAMP_JUMP", topic=topic.topic, seconds=float(ahead.max())))
    repeated = float((steps == 0.0).mean())
    if repeated > SOME:
        code = "DOCTOR_REPEATED_STAMP" if repeated < MOST else "DOCTOR_STANDING_STAMP"
        found.append(finding(code, topic=topic.topic, share=repeated))
    return found + _reception(topic.topic, steps, log_steps)


def _reception(name: str, steps: Array, log_steps: Array) -> list[Reason]:
    """Report stamps with the jitter of the reception around the sensor's steady rhythm.

    steps, log_steps: (N - 1,) s, between successive stamps and between successive log times.
    """
    period = float(np.median(steps))
    steady = (steps > 0.3 * period) & (steps < 1.7 * period)
    if period <= 0.0 or steady.sum() < ENOUGH:
        return []
    jitter = float(steps[steady].std())
    if jitter < JITTER * period:
        return []
    e = steps - period
    pairs = steady[1:] & steady[:-1]
    if pairs.sum() < ENOUGH:
        return []
    rhythm = float(np.corrcoef(e[1:][pairs], e[:-1][pairs])[0, 1])
    together = float(np.corrcoef(steps[steady], log_steps[steady])[0, 1]) if log_steps[steady].std() > 0.0 else 0.0
    if rhythm > AGAINST_RHYTHM or together < BY_RECEPTION:
        return []
    return [finding("DOCTOR_STAMP_RECEPTION", topic=name, jitter_ms=1e3 * jitter, period_ms=1e3 * period)]


def apart_findings(dvl: Recorded, reference: Recorded) -> list[Reason]:
    """Report a DVL and a reference that are never measured at the same time, by their stamps."""
    ours, theirs = (np.sort(topic.stamps_ns[topic.stamps_ns != 0]) for topic in (dvl, reference))
    if not len(ours) or not len(theirs):
        return []
    after = np.searchsorted(theirs, ours)
    near = np.minimum(
        np.abs(ours - theirs[np.minimum(after, len(theirs) - 1)]), np.abs(ours - theirs[np.maximum(after - 1, 0)])
    )
    share = float((near <= GAP * SECOND_NS).mean())
    return [finding("DOCTOR_APART", topic=dvl.topic, other=reference.topic, share=share)] if share <= MANY else []


def gap_findings(topic: Recorded) -> list[Reason]:
    """Report the gaps between the log times of a topic: their total length, number, and the longest."""
    if len(topic) < ENOUGH:
        return []
    steps = np.diff(topic.log_ns) * 1e-9
    gaps = steps > max(GAP, GAP_INTERVALS * float(np.median(steps)))
    if not gaps.any():
        return []
    at_s = float(topic.log_ns[int(np.argmax(steps))] - topic.log_ns[0]) * 1e-9
    fields = {"seconds": float(steps[gaps].sum()), "count": int(gaps.sum()), "at_s": at_s}
    return [finding("DOCTOR_GAPS", topic=topic.topic, **fields)]


def velocity_findings(topic: Recorded, is_dvl: bool) -> list[Reason]:
    """Report zeros, repetitions, non-finite values, refusals, axes and covariances of velocities."""
    if not len(topic):
        return []
    found = []
    values = topic.values
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        found.append(finding("DOCTOR_NOT_FINITE", topic=topic.topic, share=1.0 - finite.mean()))
    zero = (values == 0.0).all(axis=1)
    if zero.mean() > SOME:
        found.append(finding("DOCTOR_ZEROS", topic=topic.topic, share=zero.mean()))
    if is_dvl:
        for rule in VELOCITY_TYPES[topic.msgtype].rules:
            share = topic.refused.get(rule.counter, 0) / len(topic)
            if share > SOME and rule.counter != "zero_velocity":
                reason = {"reason": rule.in_words, "remedy": rule.remedy}
                found.append(finding("DOCTOR_REFUSED", topic=topic.topic, share=share, **reason))
    measured = values[finite & ~zero]
    if len(measured) < ENOUGH:
        return found
    repeats = float((measured[1:] == measured[:-1]).all(axis=1).mean())
    if repeats > MANY:
        found.append(finding("DOCTOR_FROZEN", topic=topic.topic, share=repeats))
    silent = [name for name, axis in zip("xyz", measured.T, strict=True) if not axis.any()]
    if silent:
        found.append(finding("DOCTOR_AXIS", topic=topic.topic, axes=" and ".join(silent)))
    return found + _covariance(topic, finite & ~zero, is_dvl)


def shown_noise(values: Array) -> float:
    """Return the noise per axis (m/s) from differences between messages, which include a little motion."""
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) < ENOUGH:
        return 0.0
    changes = np.median(np.abs(np.diff(values, n=2, axis=0)), axis=0) * NORMAL_FROM_MEDIAN
    return float(np.sqrt((changes**2).mean() / 6.0))  # a second difference of white noise has six times its variance


def _covariance(topic: Recorded, used: Array, is_dvl: bool) -> list[Reason]:
    """Report a constant covariance that the data contradict.

    used: (K,) indices of the valid messages.
    """
    variances = topic.variances[used]
    if np.isnan(variances).any() or (variances != variances[0]).any():
        return []
    reported = float(np.sqrt(variances[0].mean()))
    measured = shown_noise(topic.values[used])
    if is_dvl:
        wrong = reported > CLAIMS_TOO_MUCH * max(measured, 1e-4) or (
            reported < CLAIMS_TOO_LITTLE * measured and measured > QUIET and interval_s(topic) <= 0.25
        )
    else:
        wrong = not NO_RECEIVER[0] <= reported <= NO_RECEIVER[1]
    return [finding("DOCTOR_COVARIANCE", topic=topic.topic, claimed=reported, shown=measured)] if wrong else []


def orientation_findings(imu: Recorded) -> list[Reason]:
    """Report an IMU without orientation."""
    q = imu.values
    finite = np.isfinite(q @ np.ones(4))  # one product for all four columns, because a sum over narrow rows is slow
    given = q if finite.all() else q[finite]
    if not len(given):
        why = "orientation_covariance[0] is -1"
    elif not np.abs(np.sqrt(np.einsum("ni,ni->n", given, given)) - 1.0).min() < 0.1:
        why = "its quaternions have no length"
    elif len(given) > ENOUGH and (given == given[0]).all():
        why = "the same in every message"
    else:
        return []
    return [finding("DOCTOR_NO_ORIENTATION", topic=imu.topic, why=why)]
