"""Comparison of an IMU's angular velocity with the rotation of its attitude: conventions, and bias of the gyroscopes.

The calibration uses both: the attitude rotates the reference into the body, the angular velocity moves the DVL about
the reference point. A driver may mix conventions: negated rates, degrees, earth axes, compass heading as ENU yaw. A
wrong lever arm then fits the data nearly as well, and no residual shows it. A bias of the gyroscopes, times the lever
arm, looks like a bias of the DVL. The differentiated attitude has neither.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise, permutations
from itertools import product as all_of
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..numerics.frames import ENU_FROM_NED, Array, product, rotation_from_quaternion, rotation_vector
from ..numerics.robust import FEWEST_OF_MOTION
from ..numerics.samples import Index
from ..streams.imu_frame import quaternion_product

# Interval of differentiation, s: 0.05° of attitude noise become 0.1 °/s. Longer gaps are skipped.
SPAN_S, LONGEST_S = 0.5, 1.6
# Turn rate (rms, rad/s) needed for the test.
MIN_TURN_RADPS = 0.005
# Residual share of the squared turn rate: at most with another convention, also relative to the given one, and at least
# with the given one for a contradiction.
MAX_LEFT_SHARE, MIN_WRONG_SHARE = 0.25, 0.02
# Conventions within this factor of the best are reported too. Smallest rotation (°) and scale (log) that count as such.
EQUAL_FACTOR, TURNED_FROM_DEG, SCALED_FROM = 1.2, 20.0, 0.2
# A rotation with row elements this near 1 only exchanges axes, which is tested separately.
EXCHANGED_FROM = 0.95
# Priors: σ of a gyroscope's bias (MEMS, rad/s), and of the change of the attitude's error during a recording (rad).
GYRO_BIAS_STD, ATTITUDE_CHANGE_STD = math.radians(0.2), math.radians(1.0)
# Sine of the tilt below which an attitude is a heading only.
LEVEL_BELOW = 1e-6
_BODY, _ENU, _NED = range(3)
_AXES = "xyz"
_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])
_NAMED_SIGNS = {(1, 1, -1): "HEADING_CLOCKWISE", (-1, -1, -1): "RATES_NEGATED", (1, -1, -1): "IMU_AXES_MIXED"}


def _conventions() -> Iterator[tuple[Reason, Array]]:
    """Yield exchanges and negations of axes, likely ones first: finding and B (3, 3), turn rate = B angular velocity.

    On a level vehicle that only turns about z, many fit equally.
    """
    named = [(finding(code), np.diag(signs).astype(float)) for signs, code in _NAMED_SIGNS.items()]
    yield from named
    for order in permutations(range(3)):
        for signs in all_of((1, -1), repeat=3):
            axes = ", ".join("-"[: sign < 0] + _AXES[axis] for sign, axis in zip(signs, order, strict=True))
            matrix = np.diag(signs).astype(float) @ np.eye(3)[list(order)]
            if axes != "x, y, z" and not any((matrix == named_matrix).all() for _, named_matrix in named):
                yield finding("RATES_EXCHANGED", axes=axes), matrix


CONVENTIONS = tuple(_conventions())


class AttitudeRates:
    """Sums over rotations of the attitude and angular velocities; constant memory."""

    def __init__(self) -> None:
        self._n = 0
        self._tilted = False
        self._turning = np.zeros((3, 3))  # Σ a aᵀ, a: turn rate of the attitude, rad/s
        # Σ a wᵀ and Σ w wᵀ, with the angular velocity w assumed in body, ENU and NED axes
        self._both = np.zeros((3, 3, 3))
        self._rates = np.zeros((3, 3, 3))
        self.end_day()

    def end_day(self) -> None:
        """Forget the bias of the gyroscopes, which is another one after they are switched on again."""
        self._excess, self._seconds = np.zeros(3), 0.0  # rotation of the gyroscopes less that of the attitude, rad

    @property
    def bias(self) -> Array:
        """Return the bias (3,) rad/s of the gyroscopes; 0 if the attitude is a heading or has another convention."""
        if not self._tilted or self.contradiction():
            return np.zeros(3)
        prior = (ATTITUDE_CHANGE_STD / GYRO_BIAS_STD) ** 2
        return np.asarray(self._excess * self._seconds / (self._seconds**2 + prior))

    def add(self, times: Array, orientation: Array, angular_velocity: Array, begins: Sequence[int] = (0,)) -> None:
        """Add the next samples in order of time.

        times: (M,) s.
        orientation: (M, 4) unit quaternions (x, y, z, w), ``enu from body``.
        angular_velocity: (M, 3) rad/s, body. Both nan if not known.
        begins: indices of the first samples of stretches that are differentiated separately.
        """
        known = ~(np.isnan(orientation[:, 0]) | np.isnan(angular_velocity).any(axis=1))
        bounds = [*begins, len(times)]
        if not known.all():
            bounds = np.append(0, np.cumsum(known))[bounds].tolist()
            times, orientation, angular_velocity = times[known], orientation[known], angular_velocity[known]
        pairs = [_spans(times[start:end]) + start for start, end in pairwise(bounds) if end - start >= 2]
        if not pairs:
            return
        first, last = np.concatenate(pairs, axis=1)
        is_short = times[last] - times[first] <= LONGEST_S
        spans = _span_rates(times, orientation, angular_velocity, first[is_short], last[is_short])
        of_attitude, of_rates, body_from_enu, span_s = spans
        self._excess += ((of_rates - of_attitude) * span_s[:, None]).sum(axis=0)
        self._seconds += float(span_s.sum())
        self._n += len(of_attitude)
        self._tilted = self._tilted or bool((np.abs(body_from_enu[:, :2, 2]) > LEVEL_BELOW).any())
        self._turning += of_attitude.T @ of_attitude
        if_enu, if_ned = product(body_from_enu, of_rates), product(body_from_enu, of_rates @ ENU_FROM_NED.T)
        for frame, in_body in enumerate((of_rates, if_enu, if_ned)):
            self._both[frame] += of_attitude.T @ in_body
            self._rates[frame] += in_body.T @ in_body

    @property
    def is_level(self) -> bool:
        """Return whether the attitude is a heading only, without roll and pitch."""
        return self._n >= FEWEST_OF_MOTION and not self._tilted

    def contradiction(self) -> Reason | None:
        """Return the reason, and the convention that fits, if attitude and angular velocity disagree."""
        axes = slice(None) if self._tilted else slice(2, None)  # a heading only shows rotation about the vertical
        total = float(np.trace(self._turning[axes, axes]))
        if self._n < FEWEST_OF_MOTION or total < self._n * MIN_TURN_RADPS**2:
            return None
        if not self._rates[_BODY].any():
            return finding("IMU_NO_RATES")
        misfit_as_sent = self._misfit(_BODY, np.eye(3), axes)
        if misfit_as_sent < MIN_WRONG_SHARE * total:
            return None
        misfits = [(self._misfit(frame, matrix, axes), fits) for frame, matrix, fits in self._explanations()]
        best = min(misfit for misfit, _ in misfits)
        if best > MAX_LEFT_SHARE * min(total, misfit_as_sent):
            return None
        best_fit, *others = (fits for misfit, fits in misfits if misfit <= EQUAL_FACTOR * best + 1e-3 * total)
        if others:
            return finding("IMU_CONTRADICTS_EITHER", found=best_fit, other=others[0])
        return finding("IMU_CONTRADICTS", found=best_fit)

    def _misfit(self, frame: int, matrix: Array, observable: slice) -> float:
        """Return Σ|a - B w|² over the observable axes, for B (3, 3) and a frame of w."""
        matrix = matrix[observable]
        crossed = float((matrix * self._both[frame][observable]).sum())
        turning = float(np.trace(self._turning[observable, observable]))
        return turning - 2.0 * crossed + float(np.trace(matrix @ self._rates[frame] @ matrix.T))

    def _explanations(self) -> Iterator[tuple[int, Array, Reason]]:
        """Yield possible conventions: frame of the angular velocity, B (3, 3), and wording."""
        yield from ((_BODY, matrix, convention) for convention, matrix in CONVENTIONS)
        attitude_by_imu, imu_by_imu = self._both[_BODY], self._rates[_BODY]
        scale = float(np.trace(attitude_by_imu) / np.trace(imu_by_imu))
        if scale > 0.0 and abs(math.log(scale)) > SCALED_FROM:
            in_degrees = abs(math.log(scale * 180.0 / math.pi)) < SCALED_FROM
            size = finding("RATES_DEGREES") if in_degrees else finding("RATES_SCALED", times=1.0 / scale)
            yield _BODY, scale * np.eye(3), size
        yield _ENU, np.eye(3), finding("RATES_IN_EARTH", frame="ENU")
        yield _NED, np.eye(3), finding("RATES_IN_EARTH", frame="NED")
        yield _ENU, -np.eye(3), finding("ATTITUDE_INVERTED")
        u, _, vt = np.linalg.svd(attitude_by_imu)
        rotation = u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt
        angle = math.degrees(math.acos(float(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0))))
        if angle > TURNED_FROM_DEG and np.abs(rotation).max(axis=1).min() < EXCHANGED_FROM:
            yield _BODY, rotation, finding("RATES_TURNED", degrees=angle)


class _SpanRates(NamedTuple):
    """Mean turn rates (S, 3) rad/s over spans, by the attitude (body axes) and by the angular velocity (its axes).

    body_from_enu: (S, 3, 3) attitude in the middle. seconds: (S,) length.
    """

    of_attitude: Array
    of_rates: Array
    body_from_enu: Array
    seconds: Array


def _span_rates(times: Array, orientation: Array, angular_velocity: Array, first: Index, last: Index) -> _SpanRates:
    """Return the mean turn rates from samples `first` (S,) to `last` (S,). Streams: see `AttitudeRates.add`."""
    seconds = times[last] - times[first]
    before, after = orientation[first], orientation[last]
    of_attitude = rotation_vector(quaternion_product(before * _INVERSE, after)) / seconds[:, None]
    steps = 0.5 * (angular_velocity[1:] + angular_velocity[:-1]) * np.diff(times)[:, None]
    angles = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    middle = before + np.copysign(1.0, (before * after).sum(axis=1))[:, None] * after
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    body_from_enu = rotation_from_quaternion(middle).swapaxes(1, 2)
    return _SpanRates(of_attitude, (angles[last] - angles[first]) / seconds[:, None], body_from_enu, seconds)


def _spans(times: Array) -> Index:
    """Return indices of the first and last samples (2, S) of spans of about SPAN_S, from times (M > 1,) s."""
    # first samples after multiples of SPAN_S, with the arithmetic of np.arange, but without its memory for pauses
    start, step = times[0], (times[0] + SPAN_S) - times[0]
    number = np.floor((times - start) / step)
    number += start + (number + 1.0) * step <= times
    number -= start + number * step > times
    starts, last = np.flatnonzero(np.diff(number, prepend=-1.0)), len(times) - 1
    starts = starts if starts[-1] == last else np.append(starts, last)
    return np.stack([starts[:-1], starts[1:]])
