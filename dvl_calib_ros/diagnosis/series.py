"""What the pictures of a diagnosis show, sample by sample; collected only when somebody wants to look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from .closure import HeldOutResiduals, held_out
from .fitting import Fit, Fitter
from .selection import Selection
from .unexplained import Unexplained
from .where import regimes


@dataclass(frozen=True)
class DiagnosisSeries:
    """M averaged samples of all recordings, body frame.

    recordings: names. recording_of: (M,) index into them. time: (M,) s since the recording's start. segments: stretches
    without a gap. held_out: residuals before and after the effects, and the noise. regimes: name -> (M,) bool.
    traces: by effect (M, 3) m/s, as fitted, without what misalignment and scale take in. phi: (3,) rad and scale: (3,),
    the calibration beside the effects, DVL frame; calibration_std: (6,) of both. rest: what is left after them.
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


def collect_series(selection: Selection, rest: Unexplained) -> DiagnosisSeries:
    """The series of what was selected and of what it leaves."""
    fitter, fit = selection.fitter, selection.fit
    problem = fitter.problem
    calibration = problem.calibration.changed(fit.change)
    traces = {effect.name: problem.trace(effect, fit.values[effect.name]) for effect in fit.effects}
    return DiagnosisSeries(
        recordings=tuple(recording.name for recording in problem.recordings),
        recording_of=problem.recording_of,
        time=problem.time,
        segments=problem.segments,
        held_out=held_out(selection, rest.columns),
        regimes=regimes(problem),
        traces={name: _not_absorbed(fitter, fit, trace) for name, trace in traces.items()},
        phi=calibration.phi,
        scale=calibration.scale,
        calibration_std=fit.change_std,
        rest=rest,
    )


def _not_absorbed(fitter: Fitter, fit: Fit, trace: Array) -> Array:
    """A trace (M, 3) less the change of calibration that explains most of it."""
    base = fitter.problem.base
    taken = np.linalg.lstsq(fit.noise.whiten(base), fit.noise.whiten(trace), rcond=None)[0]
    rest: Array = trace - base @ taken
    return rest
