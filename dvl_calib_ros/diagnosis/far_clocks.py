"""Clocks so far apart that nothing can be compared: found by correlation over the whole run, and refused.

Delays up to `LONGEST_OFFSET_S` are effects, which are fitted. Beyond that the fit would settle in the best of its wrong
places, and what it names there would be believed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from ..calibration.samples import VelocityFrame
from ..effects.timing import LONGEST_OFFSET_S
from ..errors import InputError
from .curve import Curve
from .recordings import Recording
from .settings import SETTINGS

# A delay beyond what can be fitted is believed if it leaves no more than this share of the squares that the best of the
# others leaves: repeated legs are alike to a half, an effect is no reason for two series to agree elsewhere
BELIEVED = 0.25
# Time step of the series, s; and the share of the shorter one that must overlap
STEP_S, OVERLAP = 0.5, 0.4
# Steps of the running median that takes spikes out of a speed
SPIKE_STEPS = 9
# Slower, a course says nothing of the heading
MOVING_MPS = 0.2
Series = NDArray[Any]  # of complex numbers


def check_clocks(recording: Recording, rotation_dvl_from_body: Array) -> None:
    """Raise InputError if the stamps of DVL and reference, or of attitude and both, are too far apart to be fitted.

    Parameters
    ----------
    recording: What is to be compared.
    rotation_dvl_from_body: (3, 3), the nominal mounting.

    """
    dvl, reference, attitude = recording.dvl, recording.reference, recording.attitude
    body = Curve(dvl.time, dvl.values @ rotation_dvl_from_body)
    known = reference.covers(_steps(reference)).astype(float)  # across an outage the curve is anything
    own = body.covers(_steps(body)).astype(float)
    late, is_far = lag(_speed(body), body.time[0], _speed(reference), reference.time[0], known, own)
    if is_far:
        raise InputError(_refused(recording.name, "the DVL's", "the reference's", late))
    if attitude is None or recording.frame is VelocityFrame.BODY:
        return
    at = np.arange(max(dvl.time[0] - late, reference.time[0]), min(dvl.time[-1] - late, reference.time[-1]), STEP_S)
    if not len(at):
        return
    course: Series = (reference(at)[:, :2] @ [1.0, 1j]) * np.conj(body(at + late)[:, :2] @ [1.0, 1j])
    turned = np.arange(attitude.time[0], attitude.time[-1], STEP_S)
    ahead: Series = recording.rotation_enu_from_body(turned)[:, :2, 0] @ [1.0, 1j]
    moving = ((np.abs(course) > MOVING_MPS**2) & reference.covers(at)).astype(float)
    late, is_far = lag(_unit(ahead), attitude.time[0], _unit(course), at[0], moving)
    if is_far:
        raise InputError(_refused(recording.name, "the IMU's", "those of DVL and reference", late))


def _unit(series: Series) -> Series:
    found: Series = series / np.maximum(np.abs(series), 1e-9)
    return found


def _refused(name: str, whose: str, others: str, late: float) -> str:
    way = "later" if late > 0.0 else "earlier"
    return (
        f"{name}: {whose} stamps are about {abs(late):.0f} s {way} than {others}; up to {LONGEST_OFFSET_S:.0f} s can "
        "be diagnosed and taken off: set that clock right, or correct the stamps in the bag"
    )


def _steps(curve: Curve) -> Array:
    return np.arange(curve.time[0], curve.time[-1], STEP_S)


def _speed(curve: Curve) -> Series:
    """(N,) horizontal speed, m/s, every STEP_S from the curve's first sample on."""
    values = curve(_steps(curve))
    around = np.pad(np.hypot(values[:, 0], values[:, 1]), SPIKE_STEPS // 2)
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(around, SPIKE_STEPS), axis=1), dtype=complex)


def lag(
    one: Series,
    one_start: float,
    other: Series,
    other_start: float,
    weight: Array | None = None,
    own: Array | None = None,
) -> tuple[float, bool]:
    """By how many s a series is later than another, and whether that is surely more than LONGEST_OFFSET_S.

    That of all lags at which the squares of the difference are least; far ones only if they are so clearly.

    Parameters
    ----------
    one, other: (N,), (M,), every STEP_S.
    one_start, other_start: Times of their first samples, s.
    weight, own: (M,) of samples of the other, (N,) of the one; by default all alike.

    """
    n, m = len(one), len(other)
    weight = np.ones(m) if weight is None else weight
    own = np.ones(n) if own is None else own
    size = n + m

    def correlated(a: Series | Array, b: Series | Array) -> Array:
        """Σ Re(a(i + lag) conj(b(i))) for lags -(m - 1) .. n - 1."""
        sums = np.real(np.fft.ifft(np.fft.fft(a, size) * np.conj(np.fft.fft(b, size))))
        return np.concatenate([sums[size - (m - 1) :], sums[:n]])

    def means(weight: Array) -> Array:
        """Mean square of the difference at each lag, infinite where too little overlaps."""
        count = correlated(own, weight)
        squares = correlated(own * np.abs(one) ** 2, weight) + correlated(own, weight * np.abs(other) ** 2)
        squares -= 2.0 * correlated(own * one, weight * other)
        enough = count >= max(OVERLAP * min(float(n), float(weight.sum())), SETTINGS.min_seconds / STEP_S)
        return np.where(enough, np.maximum(squares, 0.0) / np.maximum(count, 1.0), np.inf)

    mean = means(weight)
    late = one_start - other_start + STEP_S * np.arange(-(m - 1), n)
    near = np.abs(late) <= LONGEST_OFFSET_S + STEP_S
    best = int(np.argmin(mean))
    nearest = float(mean[near].min()) if near.any() else np.inf
    if not near[best] and mean[best] < BELIEVED * nearest:
        # on the same samples as well: a stretch that is noisy may be out of the far one's overlap
        index = np.arange(m) + best - (m - 1)
        overlap = np.where((index >= 0) & (index < n), weight, 0.0)
        nearest = min(nearest, float(means(overlap)[near].min(initial=np.inf)))
        # motion that repeats agrees at far lags as well, by chance better than at the near ones on this grid; but then
        # it agrees there, too, to what one step of the grid makes
        both = weight[1:] * weight[:-1]
        of_a_step = float((both * np.abs(np.diff(other)) ** 2).sum() / max(both.sum(), 1.0))
        if mean[best] < BELIEVED * nearest and nearest > of_a_step:
            # legs that repeat agree at more than one lag
            as_good = np.where(mean <= 1.5 * mean[best], np.abs(late), np.inf)
            return float(late[int(np.argmin(as_good))]), True
    if not np.isfinite(mean[near].min(initial=np.inf)):
        return 0.0, False
    return float(late[near][np.argmin(mean[near])]), False
