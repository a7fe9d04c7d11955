"""What the pictures of a diagnosis show, sample by sample; collected only when somebody wants to look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibration.numerics.frames import Array
from .closure import HeldOutResiduals
from .followed import Followed, what_it_follows
from .noise import segments_of
from .selection import EffectSelection
from .unexplained import Unexplained
from .where import regimes

BODY_AXES = {"x": "ahead", "y": "to port", "z": "up"}


@dataclass(frozen=True)
class HeldOutTwin:
    """What the DVL of a recording measured, less what a simulated one does whose parameters had not seen it.

    These are the errors that the gap is made of, on the same samples: between those of a slow reference there is none
    of its noise, and an error without it would be of another size than the noise that is told beside it.

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
        (3,) m/s, rms of what of it is noise.
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
        """Length of `noise`, m/s."""
        return float(np.sqrt((self.noise**2).sum()))

    def errors(self, has_effects: bool) -> dict[str, Array]:
        """Recorded less twin (N, 3) m/s by what the twin has; of a diagnosis without effects there is one twin."""
        return {"without": self.without, "with": self.with_effects} if has_effects else {"twin": self.without}


@dataclass(frozen=True)
class DiagnosisSeries:
    """F samples of all recordings, ahead, to port and up; zero on an axis that is not measured.

    recordings: names. recording_of: (F,) index into them. time: (F,) s since the recording's start. segments: stretches
    without a gap. held_out: errors before and after the effects, and the noise. regimes: name -> (F,) bool.
    traces: by effect (F, 3) m/s, as fitted, without what misalignment and scale take in. phi: (3,) rad and scale: (3,),
    the calibration beside the effects, DVL frame; calibration_std: (6,) of both. rest: what is left after them.
    measured: (3,) axes that the reference measures. followed: what is left beside what it follows most.
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
    followed: Followed | None = None

    @property
    def axes(self) -> dict[str, str]:
        """Axes that the reference measures, with what they are called."""
        return {axis: BODY_AXES[axis] for axis, measured in zip("xyz", self.measured, strict=True) if measured}

    @property
    def twins(self) -> tuple[HeldOutTwin, ...]:
        """Recorded against simulated, by recording."""
        return tuple(self._twin(index) for index in range(len(self.recordings)) if (self.recording_of == index).any())

    def _twin(self, index: int) -> HeldOutTwin:
        at, held = self.recording_of == index, self.held_out
        return HeldOutTwin(
            self.recordings[index],
            self.time[at],
            segments_of([self.time[at]]),
            held.before[at],
            held.after[at],
            np.sqrt(held.floor[at].mean(axis=0)),
            {name: mask[at] for name, mask in self.regimes.items() if mask[at].any()},
        )


def collect_series(
    selection: EffectSelection, residuals: HeldOutResiduals, rest: Unexplained, covariance: Array
) -> DiagnosisSeries:
    """The series of what was selected and of what it leaves. covariance: (6 + p, 6 + p) of the fit."""
    fitter, fit = selection.fitter, selection.fit
    problem, n = fitter.problem, len(fit.seen)
    errors = problem.errors(fit.seen)
    traces = {}
    for effect in fit.effects:
        others = [other for other in fit.effects if other is not effect]
        # the calibration takes in what it can of the trace, so it is fitted anew without the effect
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
        rest=rest,
        measured=problem.measured,
        followed=what_it_follows(problem, fit, rest.about),
    )
