"""The first guess: delays of seconds, lever arm and mounting together, however large, before the noise is known.

Given the delays, the rest is closed form: g + ω × l = C v_dvl + b is linear in l, C and b. So delays are tried one by
one and the rest is solved, robustly: only the best half of the samples counts in comparing them, and weights come from
the scatter about the best fit, never from that of a poor one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
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

    @property
    def recording(self) -> Recording:
        return self.problem.recordings[0]

    @cached_property
    def rotation(self) -> Array | None:
        """(N, 3, 3), earth from body, at the times."""
        return None if self.recording.attitude is None else self.recording.rotation_enu_from_body(self.times)

    @cached_property
    def rates(self) -> Array | None:
        """(N, 3) rad/s at the times."""
        if Needs.ANGULAR_VELOCITY not in self.recording.available:
            return None
        return self.recording.angular_velocity(self.times)

    def solved(self, offsets: Offsets) -> tuple[float, Array]:
        """Spread of the best half, and (15,) C - Tᵀ row by row, lever arm, bias."""
        recording, problem = self.recording, self.problem
        at = self.times
        known = recording.dvl.covers(at + offsets.dvl) & recording.reference.covers(at + offsets.reference)
        if known.mean() < 0.5:
            return np.inf, np.zeros(15)
        at = at[known]
        rotation = None if self.rotation is None else self.rotation[known]
        rates = None if self.rates is None else self.rates[known]
        velocity = recording.dvl(at + offsets.dvl)
        g = recording.reference(at + offsets.reference)
        if recording.frame is not VelocityFrame.BODY and rotation is not None:
            g = np.einsum("nji,nj->ni", rotation, g)
        nominal = problem.rotation_dvl_from_body
        lever = np.zeros((len(at), 3)) if rates is None else cross(rates, problem.lever_arm)
        target = g + lever - velocity @ nominal
        columns = np.zeros((len(at), 3, 15))
        for axis in range(3):
            columns[:, axis, 3 * axis : 3 * axis + 3] = velocity
        if rates is not None:
            columns[:, :, 9:12] = -skew(rates)
        columns[:, :, 12:] = np.eye(3)
        projection = np.broadcast_to(problem.projection(recording, rotation), (len(at), problem.axes, 3))
        return _robust(projection @ columns, np.einsum("nij,nj->ni", projection, target))


_PRIOR = np.concatenate([np.full(9, _PRIOR_C), np.full(3, _PRIOR_LEVER), np.full(3, _PRIOR_BIAS)])


def _robust(columns: Array, target: Array) -> tuple[float, Array]:
    """Least trimmed squares by concentration: fit, keep the best three quarters, fit again."""
    weight = np.ones(len(target))
    held = np.diag((_NOISE_MPS / _PRIOR) ** 2)
    x = np.zeros(columns.shape[2])
    kept = len(target) * 3 // 4
    for _ in range(3):
        a = (columns * weight[:, None, None]).reshape(-1, columns.shape[2])
        x = np.linalg.solve(a.T @ a + held, a.T @ (target * weight[:, None]).ravel())
        distance = np.linalg.norm(target - columns @ x, axis=1)
        best = np.partition(distance, kept)[: kept + 1]
        weight = (distance <= best[kept]).astype(float)
    return float(np.sqrt(np.mean(best**2))), x


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
