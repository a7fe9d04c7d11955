"""Series of a diagnosis for its pictures.

Shapes: F samples, M bins of time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array
from ...effects.base import EffectInput
from ..fit.gauss_newton import Fit
from ..model.forward_model import Problem
from ..model.stream_curve import segments_of
from ..search.alternative_regressors import FADES_S, low_passed
from ..search.effect_selection import EffectSelection
from ..search.event_scan import EVENTS
from ..search.unexplained import Unexplained
from .gap_closure import HeldOutResiduals
from .gap_location import regimes

BODY_AXES = {"x": "ahead", "y": "to port", "z": "up"}


@dataclass(frozen=True)
class HeldOutTwin:
    """Recorded minus simulated DVL velocity of a recording, with parameters fitted to other data.

    These are the gap's errors on the same samples. Interpolation between a slow reference's samples lacks its
    noise, so an error there would not match the stated noise.

    Parameters
    ----------
    name
        Of the recording.
    time
        (N,) s since its start.
    segments
        Stretches without a gap.
    without, with_effects
        (N, 3) m/s, ahead, to port and up; zero on an axis that is not measured.
    noise
        (3,) m/s, RMS of the noise in it.
    regimes
        Name -> (N,) bool.
    """

    name: str
    time: Array
    segments: tuple[slice, ...]
    without: Array
    with_effects: Array
    noise: Array
    regimes: Mapping[str, NDArray[np.bool_]]

    @property
    def level(self) -> float:
        """Return the length of `noise`, m/s."""
        return float(np.sqrt((self.noise**2).sum()))

    def errors(self, has_effects: bool) -> dict[str, Array]:
        """Return recorded minus twin (N, 3) m/s by the twin's content; a diagnosis without effects has one twin."""
        return {"without": self.without, "with": self.with_effects} if has_effects else {"twin": self.without}


@dataclass(frozen=True)
class DiagnosisSeries:
    """F samples of all recordings, ahead, to port and up; zero on an axis that is not measured.

    recordings: names.
    recording_of: (F,) index into them.
    time: (F,) s since the recording's start.
    segments: stretches without a gap.
    held_out: errors before and after the effects, and the noise.
    regimes: name -> (F,) bool.
    traces: by effect (F, 3) m/s, as fitted, without the part that misalignment and scale absorb.
    phi: (3,) rad and scale: (3,), calibration, DVL frame.
    calibration_std: (6,) of both.
    rest: tests of the residual.
    measured: (3,) axes that the reference measures.
    by_regressor: residual against its regressor.
    """

    recordings: tuple[str, ...]
    recording_of: NDArray[np.intp]
    time: Array
    segments: tuple[slice, ...]
    held_out: HeldOutResiduals
    regimes: Mapping[str, NDArray[np.bool_]]
    traces: Mapping[str, Array]
    phi: Array
    scale: Array
    calibration_std: Array
    rest: Unexplained
    measured: tuple[bool, bool, bool] = (True, True, True)
    by_regressor: RegressorPlot | None = None

    @property
    def axes(self) -> dict[str, str]:
        """Return the measured axes and their names."""
        return {axis: BODY_AXES[axis] for axis, measured in zip("xyz", self.measured, strict=True) if measured}

    @property
    def twins(self) -> tuple[HeldOutTwin, ...]:
        """Return recorded against simulated velocities, by recording."""
        return tuple(self._twin(index) for index in range(len(self.recordings)) if (self.recording_of == index).any())

    def _twin(self, index: int) -> HeldOutTwin:
        """Return one recording against its simulated DVL."""
        rows, held_out = self.recording_of == index, self.held_out
        return HeldOutTwin(
            self.recordings[index],
            self.time[rows],
            segments_of([self.time[rows]]),
            held_out.before[rows],
            held_out.after[rows],
            np.sqrt(held_out.floor[rows].mean(axis=0)),
            {name: mask[rows] for name, mask in self.regimes.items() if mask[rows].any()},
        )


def collect_series(
    selection: EffectSelection, residuals: HeldOutResiduals, unexplained: Unexplained, covariance: Array
) -> DiagnosisSeries:
    """Collect the series of a selection and its residual. covariance: (6 + p, 6 + p) of the fit."""
    fitter, fit = selection.fitter, selection.fit
    problem, n = fitter.problem, fit.n_recordings
    errors = problem.errors(fit.seen)
    traces = {}
    for effect in fit.effects:
        others = [other for other in fit.effects if other is not effect]
        # the calibration absorbs part of the trace, so it is re-estimated without the effect
        without = fitter.fit_kept(fit.hypothesis.with_effects(others, n, {}), fit.noise)
        traces[effect.name] = problem.errors(without.seen) - errors
    recording_of = problem.recording_of[problem.bin_of]
    times = [problem.sample_time[recording_of == recording] for recording in range(n)]
    return DiagnosisSeries(
        recordings=tuple(recording.name for recording in problem.recordings),
        recording_of=recording_of,
        time=problem.sample_time,
        segments=segments_of(times),
        held_out=residuals,
        regimes=regimes(problem, fit.seen, per_sample=True),
        traces=traces,
        phi=fit.hypothesis.phi,
        scale=fit.hypothesis.scale,
        calibration_std=np.sqrt(np.diag(covariance)[:6]),
        rest=unexplained,
        measured=problem.measured,
        by_regressor=residual_by_regressor(problem, fit, unexplained.about),
    )


# Number of groups of equally many samples for which a mean is plotted
GROUPS = 15
MIN_GROUP = 4


@dataclass(frozen=True)
class RegressorPlot:
    """Residual against a regressor. label: of the regressor, with unit. axis: x, y or z, of the strongest dependence.
    at: (M,) regressor. residual: (M,) m/s, along the axis."""

    label: str
    axis: str
    at: Array
    residual: Array

    def groups(self) -> tuple[Array, Array, Array, Array]:
        """Return group means (G,) of the regressor; mean, standard deviation and standard error (m/s) of residuals."""
        count = max(1, min(GROUPS, len(self.at) // MIN_GROUP))
        parts = np.array_split(np.argsort(self.at, kind="stable"), count)
        at = np.array([self.at[part].mean() for part in parts])
        mean = np.array([self.residual[part].mean() for part in parts])
        std = np.array([self.residual[part].std(ddof=1) if len(part) > 1 else np.nan for part in parts])
        return at, mean, std, std / np.sqrt([len(part) for part in parts])


def residual_by_regressor(problem: Problem, fit: Fit, about: str | float) -> RegressorPlot | None:
    """Return the residual against the strongest regressor of a group, by the group's name. Return None without any.

    Strongest: axis and regressor whose group means scatter most relative to their standard errors.
    """
    best: tuple[float, RegressorPlot] | None = None
    names = [name for name, measured in zip("xyz", problem.measured, strict=True) if measured]
    for label, at in _regressors(problem, fit, about).items():
        for axis, name in enumerate(names):
            by_regressor = RegressorPlot(label, name, at, fit.residual[:, axis])
            _, mean, _, error = by_regressor.groups()
            scatter = float(np.nanmean((mean / np.maximum(error, 1e-12)) ** 2))
            if best is None or scatter > best[0]:
                best = scatter, by_regressor
    return None if best is None else best[1]


def _regressors(problem: Problem, fit: Fit, about: str | float) -> Mapping[str, Array]:
    """Return regressors (M,) by label, of a name in `dictionary` or a period in s."""
    if isinstance(about, float):
        return {f"time within a period of {about:.0f} s, s": np.mod(problem.time, about)}
    parts = [_of_motion(each.motion, about) for each in fit.seen]
    return {
        label: np.concatenate([grid.averaged(part[label]) for grid, part in zip(problem.grids, parts, strict=True)])
        for label in parts[0]
    }


def _of_motion(motion: EffectInput, about: str) -> dict[str, Array]:
    """Return the regressors (M,) of a group by their label with unit."""
    velocity, rotation, rates = motion.velocity_body, motion.rotation_enu_from_body, motion.angular_velocity
    if about in ("speed", "a band of speeds"):
        return {"speed, m/s": motion.speed}
    if about == "acceleration":
        return {"acceleration ahead, m/s²": np.gradient(velocity[:, 0], motion.time)}
    if about == "sway and heave":
        return {"velocity to port, m/s": velocity[:, 1], "velocity up, m/s": velocity[:, 2]}
    if about in ("time", *EVENTS):
        return {"time, s": motion.time}
    if rotation is not None and about == "heading":
        return {"yaw, ° from east to north": np.degrees(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))}
    if rotation is not None and about == "tilt":
        pitch = np.degrees(-np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0)))
        up = np.sign(rotation[:, 2, 2].mean())  # -1 for a z-down body
        roll = np.degrees(np.arctan2(up * rotation[:, 2, 1], up * rotation[:, 2, 2]))
        return {"pitch, ° (bow down)": pitch, "roll, °": roll}
    if rotation is not None and about == "depth":
        steps = np.clip(np.diff(motion.time, prepend=motion.time[0]), 0.0, 10.0)
        return {"height against the start, m": np.cumsum(np.einsum("ni,ni->n", rotation[:, 2], velocity) * steps)}
    if rates is not None and about == "turn rate":
        return {"turn rate, °/s (to port)": np.degrees(rates[:, 2])}
    if rates is not None and about == "turns before":
        turns = np.degrees(rates[:, 2])
        return {f"turns before, °/s, fading in {s:.0f} s": low_passed(motion.time, turns, s) for s in FADES_S}
    if rates is not None and about == "roll and pitch rate":
        return {"roll rate, °/s": np.degrees(rates[:, 0]), "pitch rate, °/s": np.degrees(rates[:, 1])}
    return {}
