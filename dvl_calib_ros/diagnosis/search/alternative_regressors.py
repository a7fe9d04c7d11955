"""Dictionary of functions of motion or time that a systematic residual may follow.

Shapes: M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...calibration.numerics.distributions import chi2_logsf
from ...calibration.numerics.frames import Array
from ...effects.base import recursion
from ..model.forward_model import Problem
from ..model.seen import Seen
from ..model.time_grid import Grid

# Of piecewise linear functions of time and of speed
KNOTS = 7
# Time constants, s, with which the effect of a turn decays
FADES_S = (4.0, 12.0, 40.0)
# rad/s; threshold of a turn, whose side may act until the next
TURNING_RADPS = float(np.deg2rad(2.0))
# Groups tested in parts of this many functions: one, or a cosine and its sine
ALTERNATIVES = {"a band of speeds": 1, "turns before": 1, "heading": 2}
HEADING_HARMONICS = 4


class Regressor(NamedTuple):
    """What a residual may follow, with its test.

    about: its name, or a period (s).
    columns: (M, A, c).
    energy: chi-square of dof under the null, once divided by its inflation in simulated recordings.
    log_tried: logarithm of the number of alternatives, such as times of an event.
    left: deviance that inexact interpolation may leave, where no simulated recordings tell.
    """

    about: str | float
    columns: Array
    energy: float
    dof: int
    log_tried: float = 0.0
    inflation: float = 1.0
    left: float = 0.0

    @property
    def log_p(self) -> float:
        """Return log p of the test, adjusted for the alternatives."""
        return (float(chi2_logsf(self.energy / self.inflation, self.dof)) if self.dof else 0.0) + self.log_tried


def dictionary(problem: Problem, seen: Sequence[Seen]) -> dict[str, Array]:
    """Return functions (M, c) of motion or time, by name, dimensionless."""
    parts = [_of_motion(grid, each) for grid, each in zip(problem.grids, seen, strict=True)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _of_motion(grid: Grid, seen: Seen) -> dict[str, Array]:
    """Return functions (M, c) of speed, acceleration, turn rate and time by name."""
    motion = seen.motion
    velocity, speed = motion.velocity_body, motion.speed
    acceleration = np.gradient(velocity[:, 0], motion.time)
    typical = max(float(np.median(speed)), 0.1)
    hats = _hats(motion.time, np.linspace(motion.time[0], motion.time[-1], KNOTS))
    s = speed / typical
    found: dict[str, Array] = {
        "speed": np.column_stack([np.ones_like(s), s, s**2, s**3, np.maximum(s - 1.0, 0.0)]),
        "a band of speeds": _hats(speed, np.quantile(speed, 0.01) + np.linspace(0.0, 1.0, KNOTS) * _spread(speed)),
        "acceleration": np.column_stack([acceleration, np.abs(acceleration)]),
        "sway and heave": np.column_stack([velocity[:, 1:], np.abs(velocity[:, 1:])]),
        "time": np.column_stack([hats, hats * s[:, None]]),
    }
    if motion.rotation_enu_from_body is not None:
        rotation = motion.rotation_enu_from_body
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        roll, pitch = rotation[:, 2, 1], -rotation[:, 2, 0]
        one_cycle = np.column_stack([np.cos(yaw), np.sin(yaw)])
        more = [wave(n * yaw) for n in range(2, HEADING_HARMONICS + 1) for wave in (np.cos, np.sin)]
        found["heading"] = np.column_stack([one_cycle, one_cycle * s[:, None], *more])
        found["tilt"] = np.column_stack([roll, pitch, np.abs(roll), np.abs(pitch), roll * s, pitch * s])
        steps = np.clip(np.diff(motion.time, prepend=motion.time[0]), 0.0, 10.0)
        up = np.einsum("ni,ni->n", rotation[:, 2], velocity)
        found["depth"] = np.cumsum(up * steps)[:, None]
    if motion.angular_velocity is not None:
        rate = motion.angular_velocity
        turning = rate[:, 2]
        found["turn rate"] = np.column_stack([turning, np.abs(turning), turning * s, np.abs(turning) * s, turning**2])
        turn_memories = [low_passed(motion.time, turning, seconds) for seconds in FADES_S]
        found["turns before"] = np.column_stack([*turn_memories, _side_of_last_turn(turning)])
        found["roll and pitch rate"] = np.column_stack([rate[:, :2], np.abs(rate[:, :2])])
    return {name: grid.averaged(values) for name, values in found.items()}


def _spread(speed: Array) -> float:
    return max(float(np.quantile(speed, 0.99) - np.quantile(speed, 0.01)), 1e-3)


def low_passed(time: Array, values: Array, seconds: float) -> Array:
    """Return (N,) values (N,) low-pass filtered with a time constant."""
    steps = np.clip(np.diff(time, prepend=time[0]), 0.0, 10.0)
    decay = np.exp(-steps / seconds)
    return recursion(decay, (1.0 - decay) * values)


def _side_of_last_turn(turn_rate: Array) -> Array:
    """Return (N,) 1 after a turn to port, -1 after one to starboard, 0 before the first."""
    side = np.where(np.abs(turn_rate) > TURNING_RADPS, np.sign(turn_rate), 0.0)
    last = np.maximum.accumulate(np.where(side != 0.0, np.arange(len(side)), -1))
    return np.where(last >= 0, side[np.maximum(last, 0)], 0.0)


def _hats(values: Array, knots: Array) -> Array:
    """Return piecewise linear functions (N, knots) that are one at one knot and zero at the others."""
    return np.column_stack([np.interp(values, knots, row) for row in np.eye(len(knots))])
