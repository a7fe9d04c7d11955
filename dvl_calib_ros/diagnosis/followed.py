"""What is left beside what it follows: the regressor as a navigator knows it, with its unit, for a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..calibration.numerics.frames import Array
from ..effects.base import EffectInput
from .composed import Problem
from .dictionary import FADES_S, faded
from .fitting import Fit

# Groups of equally many samples in which the mean is told
GROUPS = 15
MIN_GROUP = 4


@dataclass(frozen=True)
class Followed:
    """label: what is left follows, with its unit. axis: x, y or z, that follows it most. at: (M,) values of it.
    left: (M,) m/s, what the fit leaves along the axis.
    """

    label: str
    axis: str
    at: Array
    left: Array

    def groups(self) -> tuple[Array, Array, Array, Array]:
        """(G,) means of what it follows; mean, standard deviation, and that of the mean (m/s), of what is left."""
        count = max(1, min(GROUPS, len(self.at) // MIN_GROUP))
        parts = np.array_split(np.argsort(self.at, kind="stable"), count)
        at = np.array([self.at[part].mean() for part in parts])
        mean = np.array([self.left[part].mean() for part in parts])
        std = np.array([self.left[part].std(ddof=1) if len(part) > 1 else np.nan for part in parts])
        return at, mean, std, std / np.sqrt([len(part) for part in parts])


def what_it_follows(problem: Problem, fit: Fit, about: str | float) -> Followed | None:
    """What a fit leaves beside the regressor it follows most, of those that a name stands for; None if there is none.

    That axis and that regressor of which groups' means scatter most, against chance.
    """
    best: tuple[float, Followed] | None = None
    names = [name for name, measured in zip("xyz", problem.measured, strict=True) if measured]
    for label, at in _regressors(problem, fit, about).items():
        for axis, name in enumerate(names):
            followed = Followed(label, name, at, fit.residual[:, axis])
            _, mean, _, error = followed.groups()
            scatter = float(np.nanmean((mean / np.maximum(error, 1e-12)) ** 2))
            if best is None or scatter > best[0]:
                best = scatter, followed
    return None if best is None else best[1]


def _regressors(problem: Problem, fit: Fit, about: str | float) -> Mapping[str, Array]:
    """Label -> (M,) values, of what a name in `dictionary`, or a period in s, stands for."""
    if isinstance(about, float):
        return {f"time within a period of {about:.0f} s, s": np.mod(problem.time, about)}
    parts = [_of_motion(each.motion, about) for each in fit.seen]
    return {
        label: np.concatenate([grid.averaged(part[label]) for grid, part in zip(problem.grids, parts, strict=True)])
        for label in parts[0]
    }


def _of_motion(motion: EffectInput, about: str) -> dict[str, Array]:
    velocity, rotation, rates = motion.velocity_body, motion.rotation_enu_from_body, motion.angular_velocity
    if about in ("speed", "a band of speeds"):
        return {"speed, m/s": motion.speed}
    if about == "acceleration":
        return {"acceleration ahead, m/s²": np.gradient(velocity[:, 0], motion.time)}
    if about == "sway and heave":
        return {"velocity to port, m/s": velocity[:, 1], "velocity up, m/s": velocity[:, 2]}
    if about in ("time", "a step in time"):
        return {"time, s": motion.time}
    if rotation is not None and about == "heading":
        return {"yaw, ° from east to north": np.degrees(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))}
    if rotation is not None and about == "tilt":
        pitch = np.degrees(-np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0)))
        return {"pitch, ° (bow down)": pitch, "roll, °": np.degrees(np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]))}
    if rotation is not None and about == "depth":
        steps = np.clip(np.diff(motion.time, prepend=motion.time[0]), 0.0, 10.0)
        return {"height against the start, m": np.cumsum(np.einsum("ni,ni->n", rotation[:, 2], velocity) * steps)}
    if rates is not None and about == "turn rate":
        return {"turn rate, °/s (to port)": np.degrees(rates[:, 2])}
    if rates is not None and about == "turns before":
        turns = np.degrees(rates[:, 2])
        return {f"turns before, °/s, fading in {s:.0f} s": faded(motion.time, turns, s) for s in FADES_S}
    if rates is not None and about == "roll and pitch rate":
        return {"roll rate, °/s": np.degrees(rates[:, 0]), "pitch rate, °/s": np.degrees(rates[:, 1])}
    return {}
