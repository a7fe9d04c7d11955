"""Description of the DVL for another simulator: mounting, rate, noise and size of each error.

Sizes are in m/s, so that errors that a simulator lacks can be weighed. The size of an error is the change of the DVL's
velocity when that error alone is removed from the composed model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...calibration.models.parameters import Parameters
from ...calibration.numerics.frames import Array
from ...effects.registry import EFFECTS
from ..model.forward_model import Problem
from ..model.hypothesis import Hypothesis, Values
from ..model.recorded_streams import RecordedStreams
from ..model.stream_curve import Curve
from ..search.arm_clock_ambiguity import ARM, ARM_PARAMETERS, DVL_CLOCK
from ..search.effect_selection import EffectSelection
from .simulated_twin import simulated, with_denoised_reference

Three = tuple[float, float, float]


@dataclass(frozen=True)
class DvlSeen:
    """A DVL on its vehicle, over all recordings.

    mounting_rpy: (3,) rad, nominal, and lever_arm: (3,) m, both as configured, without the estimate.
    time_offset: s, and clock_drift: s per s, configured corrections of its stamps.
    rate_hz: samples per second.
    noise_std: (3,) m/s, per axis, from sample to sample, upper bound.
    speed: (3,) m/s, RMS along its axes.
    sizes: RMS, m/s, of the velocity change by each error: `misalignment`, `scale`, effects, and repeated samples.
    """

    mounting_rpy: Three
    lever_arm: Three
    time_offset: float
    clock_drift: float
    rate_hz: float
    noise_std: Three
    speed: Three
    sizes: Mapping[str, float]


# Size of the finding stale_samples: change of the velocity since the repeated sample
STALE = "stale_samples"


def dvl_seen(selection: EffectSelection, parameters: Parameters) -> DvlSeen:
    """Describe the DVL of a selection; parameters: those with which the recordings were read."""
    problem = replace(selection.fitter.problem, lever_arm=np.zeros(3))
    hypothesis = _with_configured(selection, parameters)
    measured = _measured(problem, hypothesis)
    without = {
        "misalignment": replace(hypothesis, phi=np.zeros(3)),
        "scale": replace(hypothesis, scale=np.zeros(3)),
        **{
            effect.name: replace(hypothesis, effects=tuple(each for each in hypothesis.effects if each is not effect))
            for effect in hypothesis.effects
        },
    }
    sizes = {name: _rms(measured - _measured(problem, each)) for name, each in without.items()}
    repeats, received = (sum(getattr(each, name) for each in problem.recordings) for name in ("repeats", "received"))
    if repeats:
        sizes[STALE] = float(np.sqrt(repeats / received)) * _rms(np.diff(measured, axis=0))
    return DvlSeen(
        mounting_rpy=_triple(parameters.mounting_rpy),
        lever_arm=_triple(parameters.lever_arm),
        time_offset=parameters.dvl_time_offset,
        clock_drift=parameters.dvl_clock_drift,
        rate_hz=1.0 / float(np.median([each.dvl.interval for each in problem.recordings])),
        noise_std=_triple(_noise(problem.recordings, selection)),
        speed=_triple(np.sqrt((measured**2).mean(axis=0))),
        sizes=sizes,
    )


def _with_configured(selection: EffectSelection, parameters: Parameters) -> Hypothesis:
    """Return the hypothesis plus the corrections that the parameters had made before the fit."""
    hypothesis = selection.fit.hypothesis
    n = len(selection.fitter.problem.recordings)
    before = {
        ARM: dict(zip(ARM_PARAMETERS, parameters.lever_arm, strict=True)),
        DVL_CLOCK: {"seconds": parameters.dvl_time_offset},
        "clock_drift": {"seconds_per_hour": 3600.0 * parameters.dvl_clock_drift},
    }
    values: dict[str, tuple[Values, ...]] = {}
    for name, known in before.items():
        if not any(known.values()) or not EFFECTS[name].needs <= selection.fitter.problem.available:
            continue
        found = hypothesis.values.get(name) or (EFFECTS[name].defaults,) * n
        values[name] = tuple({**each, **{key: each.get(key, 0.0) + known[key] for key in known}} for each in found)
    added = [EFFECTS[name] for name in values if EFFECTS[name] not in hypothesis.effects]
    return hypothesis.with_effects([*hypothesis.effects, *added], n, values)


def _measured(problem: Problem, hypothesis: Hypothesis) -> Array:
    """Simulate the DVL velocity (N, 3) m/s, DVL frame, without noise, of all recordings."""
    return np.concatenate([simulated(problem, hypothesis, index) for index in range(len(problem.recordings))])


def _rms(difference: Array) -> float:
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _noise(recordings: Sequence[RecordedStreams], selection: EffectSelection) -> Array:
    """Return the noise (3,) m/s: the lesser roughness of the DVL's samples and of their residual.

    The former includes motion too fast for the DVL's rate, bounded by the reported noise if slow. The latter includes
    noise of the reference.
    """
    problem = with_denoised_reference(selection.fitter.problem)
    variances = []
    for index, recording in enumerate(recordings):
        residual = recording.dvl.values - simulated(problem, selection.fit.hypothesis, index)
        own = recording.dvl.noise
        variances.append(np.minimum(own, Curve(recording.dvl.time, residual).roughness) ** 2)
    return np.asarray(np.sqrt(np.mean(variances, axis=0)))


def _triple(values: Sequence[float] | Array) -> Three:
    x, y, z = map(float, values)
    return x, y, z
