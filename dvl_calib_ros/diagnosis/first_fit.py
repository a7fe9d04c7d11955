"""The first guess: delays of seconds, lever arm and mounting together, however large, before the noise is known.

Given the delays, the rest is closed form: g + ω × l = C v_dvl + b is linear in l, C and b. So delays are tried one by
one and the rest is solved, robustly: only the best half of the samples counts in comparing them, and weights come from
the scatter about the best fit, never from that of a poor one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..calibration.frames import Array, cross, skew
from ..calibration.samples import VelocityFrame
from ..effects.base import Needs
from .composed import Offsets, Problem, make_problem
from .recordings import Recording
from .settings import SETTINGS

# Times of a recording that are looked at; its sums change little with more
_MAX_TIMES = 1000
# Weak priors, std: of what C departs from the nominal mounting, of the lever arm (m), of a bias (m/s)
_PRIOR_C, _PRIOR_LEVER, _PRIOR_BIAS = 0.05, 5.0, 0.05
_NOISE_MPS = 0.05
# Second look about so many of the best first ones, in steps down to this, s
_BEST, _FINEST_S = 4, 0.03


@dataclass(frozen=True)
class FirstGuess:
    """Of one recording. offsets: of clocks. lever_arm: (3,) m. phi: (3,) rad. spread: m/s, of the best half."""

    offsets: Offsets
    lever_arm: Array
    phi: Array
    spread: float


@dataclass(frozen=True)
class _Look:
    problem: Problem
    times: Array
    _streams: dict[tuple[bool, float], tuple[NDArray[np.bool_], Array]] = field(default_factory=dict)

    @property
    def recording(self) -> Recording:
        return self.problem.recordings[0]

    @cached_property
    def rotation(self) -> Array | None:
        """(N, 3, 3), earth from body, at the times."""
        return None if self.recording.attitude is None else self.recording.rotation_enu_from_body(self.times)

    @cached_property
    def rates(self) -> Array:
        """(N, 3) rad/s at the times, zero where they are not known: then nothing is learnt of the lever arm."""
        if Needs.ANGULAR_VELOCITY not in self.recording.available:
            return np.zeros((len(self.times), 3))
        return self.recording.angular_velocity(self.times)

    @cached_property
    def lever(self) -> Array:
        """(N, 3) m/s, of the lever arm that is known."""
        return cross(self.rates, self.problem.lever_arm)

    @cached_property
    def projection(self) -> Array | None:
        """(N, A, 3) from the body frame to the axes that are compared, None if these are all of it."""
        if all(self.problem.measured):
            return None
        projection = self.problem.projection(self.recording, self.rotation)
        return np.broadcast_to(projection, (len(self.times), self.problem.axes, 3))

    def _stream(self, of_dvl: bool, offset: float) -> tuple[NDArray[np.bool_], Array]:
        """Whether a stream is known at the times (N,), and its values (N, 3), those of the reference in the body."""
        recording = self.recording
        if (of_dvl, offset) not in self._streams:
            curve, at = recording.dvl if of_dvl else recording.reference, self.times + offset
            values = curve(at)
            if not of_dvl and recording.frame is not VelocityFrame.BODY and self.rotation is not None:
                values = np.einsum("nji,nj->ni", self.rotation, values)
            self._streams[of_dvl, offset] = curve.covers(at), values
        return self._streams[of_dvl, offset]

    def solved(self, offsets: Offsets) -> tuple[float, Array]:
        """Spread of the best half, and (15,) C - Tᵀ row by row, lever arm, bias."""
        has_dvl, velocity = self._stream(True, offsets.dvl)
        has_reference, g = self._stream(False, offsets.reference)
        known = has_dvl & has_reference
        if known.mean() < 0.5:
            return np.inf, np.zeros(15)
        target = g + self.lever - velocity @ self.problem.rotation_dvl_from_body
        regressors = np.column_stack([velocity, self.rates, np.ones(len(known))])
        projection = None if self.projection is None else self.projection[known]
        return _robust(regressors[known], target[known], projection)


_PRIOR = np.concatenate([np.full(9, _PRIOR_C), np.full(3, _PRIOR_LEVER), np.full(3, _PRIOR_BIAS)])


def _by_parameters() -> Array:
    """(7, 3, 15): what each of (velocity, angular velocity, 1) makes of each parameter on each axis of the body."""
    found = np.zeros((7, 3, 15))
    for axis in range(3):
        found[:3, axis, 3 * axis : 3 * axis + 3] = np.eye(3)
        found[6, axis, 12 + axis] = 1.0
    found[3:6, :, 9:12] = -skew(np.eye(3))
    return found


_BY_PARAMETERS = _by_parameters()


def _robust(regressors: Array, target: Array, projection: Array | None) -> tuple[float, Array]:
    """Least trimmed squares by concentration: fit, keep the best three quarters, fit again.

    regressors: (N, 7), of which all columns are made (`_BY_PARAMETERS`), so their products are all that is summed up.
    """
    products, aims = regressors, target
    if projection is not None:
        seen = np.swapaxes(projection, 1, 2) @ projection  # (N, 3, 3)
        products = (regressors[:, :, None] * seen.reshape(-1, 1, 9)).reshape(-1, 63)
        aims = np.einsum("nij,nj->ni", seen, target)
    columns = _BY_PARAMETERS.reshape(21, 15)
    held = np.diag((_NOISE_MPS / _PRIOR) ** 2)
    kept = len(target) * 3 // 4
    weighted = regressors.T
    for _ in range(3):
        squares = (weighted @ products).reshape(7, 7, -1)
        squares = (squares if projection is not None else squares * np.eye(3).ravel()).reshape(7, 7, 3, 3)
        squares = squares.transpose(0, 2, 1, 3).reshape(21, 21)
        x = np.linalg.solve(columns.T @ squares @ columns + held, columns.T @ (weighted @ aims).ravel())
        left = target - regressors @ (columns @ x).reshape(7, 3)
        left = left if projection is None else np.einsum("nij,nj->ni", projection, left)
        distance = np.einsum("ni,ni->n", left, left)
        best = np.partition(distance, kept)[: kept + 1]
        weighted = regressors.T * (distance <= best[kept])
    return float(np.sqrt(np.mean(best))), x


def first_guess(recording: Recording, rotation_dvl_from_body: Array, lever_arm: Array) -> FirstGuess:
    """Delays, lever arm and mounting of one recording."""
    problem = make_problem([recording], rotation_dvl_from_body, lever_arm, [Offsets()])
    times = np.linspace(recording.dvl.time[0], recording.dvl.time[-1], _MAX_TIMES)
    times = times[recording.attitude.covers(times)] if recording.attitude is not None else times
    look = _Look(problem, times)
    reach, step = SETTINGS.first_offset, SETTINGS.first_step
    turned = recording.frame is not VelocityFrame.BODY
    by_reference = np.arange(-0.5 * reach, 0.5 * reach + step, 3.0 * step) if turned else np.zeros(1)
    by_dvl = np.arange(-reach, reach + step, 2.0 * step)
    found = [(look.solved(Offsets(float(d), float(r)))[0], float(d), float(r)) for d in by_dvl for r in by_reference]
    found = sorted([(look.solved(Offsets())[0], 0.0, 0.0), *found])[:_BEST]
    refined = sorted(_refined(look, each, turned, step) for each in found)
    spread, dvl, reference = refined[0]
    _, x = look.solved(Offsets(dvl, reference))
    matrix = x[:9].reshape(3, 3) + rotation_dvl_from_body.T
    u, _, vt = np.linalg.svd(matrix.T)
    turned_mounting = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    phi = Rotation.from_matrix(turned_mounting @ rotation_dvl_from_body.T).as_rotvec()
    return FirstGuess(Offsets(dvl, reference), x[9:12], phi, spread)


def _refined(look: _Look, start: tuple[float, float, float], turned: bool, step: float) -> tuple[float, float, float]:
    """Coordinate search with steps that halve."""
    best = start
    while step > _FINEST_S:
        spread, dvl, reference = best
        moves = [(dvl + step, reference), (dvl - step, reference)]
        if turned:
            moves += [(dvl, reference + step), (dvl, reference - step), (dvl + step, reference + step)]
            moves += [(dvl - step, reference - step)]
        tried = min((look.solved(Offsets(*move))[0], *move) for move in moves)
        if tried[0] < spread:
            best = tried
        else:
            step *= 0.5
    return best
