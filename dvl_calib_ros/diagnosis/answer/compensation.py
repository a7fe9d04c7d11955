"""Corrections for the node and replay from a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from ...calibration.models.parameters import SCHEMA, Parameters
from ...calibration.numerics.frames import Array
from ...calibration.numerics.samples import VelocityFrame
from ...effects.registry import EFFECTS
from ...errors import InputError
from ..fit.cross_validation import fitted_without, folds_of
from ..model.hypothesis import Hypothesis, is_time_of_run
from ..search.arm_clock_ambiguity import ARM, ARM_PARAMETERS, ATTITUDE_CLOCK, CLOCKS, TWO_CLOCKS
from ..search.event_scan import TIME_TOLERANCE_S
from .results import Diagnosis, FoundEffect, certain_sizes

# Parameter that corrects each clock
OFFSETS = {name: name for name in TWO_CLOCKS} | {ATTITUDE_CLOCK: "imu_time_offset"}
# Effects that a parameter can correct
CORRECTED = (ARM, *OFFSETS, "water_lock", "clock_drift", "time_offset_jump")


@dataclass(frozen=True)
class AppliedCorrection:
    """Parameters with a correction, verified on held-out data.

    changed: values by name, of the parameters that differ. errors: held-out rms without and with it, m/s.
    """

    parameters: Parameters
    changed: Mapping[str, Any]
    errors: tuple[float, float]

    @property
    def sentence(self) -> str:
        """Return the changed values, and the held-out error without and with them."""
        values = ", ".join(f"{name} {_rounded(value)}" for name, value in self.changed.items())
        return f"{values}; held-out error {1e3 * self.errors[0]:.1f} to {1e3 * self.errors[1]:.1f} mm/s"


def verified_corrections(
    parameters: Parameters, diagnosis: Diagnosis, days: Sequence[int | None]
) -> dict[int | None, AppliedCorrection]:
    """Return the corrections that change a parameter, of the vehicle (None) or of a recording by index.

    Raises
    ------
    InputError
        If none changes a parameter, or one does not lower the error on held-out data.

    """
    found = {}
    for day in days:
        corrected = compensated(parameters, diagnosis, day)
        before = parameters.as_dict()
        changed = {name: value for name, value in corrected.as_dict().items() if value != before[name]}
        if not changed:
            continue
        found[day] = AppliedCorrection(corrected, changed, held_out_errors(diagnosis, day))
        if not found[day].errors[1] < found[day].errors[0]:
            raise InputError(f"not written, since the error does not fall: {found[day].sentence}")
    if not found:
        names = ", ".join(" or ".join((each.name, *each.equivalent_to)) for each in diagnosis.effects)
        raise InputError(f"not written: no parameter corrects what was found ({names or 'no effect'})")
    return found


def held_out_errors(diagnosis: Diagnosis, recording: int | None) -> tuple[float, float]:
    """Return the held-out RMS error (m/s) without a correction and with exactly its values; only φ and δk are fitted.

    recording: index, for its error and correction; None: all, with the vehicle's correction.
    """
    assert diagnosis.selection is not None
    selection = diagnosis.selection
    problem = selection.fitter.problem
    n = len(problem.recordings)
    of_each = [corrections(diagnosis, None if recording is None else index) for index in range(n)]
    effects = [effect for effect in selection.fit.effects if any(effect.name in each for each in of_each)]
    values = {effect.name: tuple(each.get(effect.name, {}) for each in of_each) for effect in effects}
    hypotheses = selection.base.hypothesis, selection.fit.hypothesis.with_effects(effects, n, values)
    errors = np.zeros((2, len(problem.bin_of)))
    fold_of = folds_of(problem)
    for fold, fits in fitted_without(selection.fitter, hypotheses, selection.fit.noise, fold_of, frozenset(values)):
        at = (fold_of == fold)[problem.bin_of]
        for fit, square in zip(fits, errors, strict=True):
            square[at] = (problem.errors(fit.seen)[at] ** 2).sum(axis=1)
    if recording is not None:
        errors = errors[:, problem.recording_of[problem.bin_of] == recording]
    before, after = np.sqrt(errors.mean(axis=1)).tolist()
    return before, after


def corrections(diagnosis: Diagnosis, recording: int | None = None) -> dict[str, dict[str, float]]:
    """Return the values, by effect, that parameters of the calibration correct.

    recording: index, with its own parameters; None: only parameters of the vehicle, and the recording's if there is
    one. Sizes whose interval includes zero are omitted, and effects with equivalents, which need another correction. A
    lever arm is kept: its interval includes the ambiguity.
    """
    found: dict[str, dict[str, float]] = {}
    for effect in diagnosis.effects:
        parameters = effect.parameters
        if effect.by_recording:
            if recording is None:
                continue
            parameters = effect.by_recording.get(diagnosis.recordings[recording][0], {})
        if effect.name not in CORRECTED or (effect.name != ARM and not _is_one_correction(diagnosis, effect)):
            continue
        times = {spec.name for spec in EFFECTS[effect.name].parameters if is_time_of_run(spec)}
        sizes = certain_sizes(effect.name, parameters)
        begin_end = {name: value for name, (value, _, _) in parameters.items() if name in times}
        if effect.name == "water_lock":
            if begin_end["from_s"] >= TIME_TOLERANCE_S or np.isfinite(begin_end["to_s"]):
                continue
            begin_end["from_s"] = 0.0
        if sizes and "again_seconds" not in parameters:  # one jump cannot correct two
            found[effect.name] = sizes | begin_end
    return found


def _is_one_correction(diagnosis: Diagnosis, effect: FoundEffect) -> bool:
    """Return whether an effect and its equivalents imply the same clock correction.

    A shift of all three clocks changes nothing, nor does the attitude's clock where the reference is in the body frame.
    """
    if not effect.equivalent_to:
        return True
    if diagnosis.selection is None or not {effect.name, *effect.equivalent_to} <= {*CLOCKS}:
        return False
    selection = diagnosis.selection
    if all(each.frame is VelocityFrame.BODY for each in selection.fitter.problem.recordings):
        return {effect.name, *effect.equivalent_to} <= {*TWO_CLOCKS}
    rivals = [rival for each in selection.selected if each.effect.name == effect.name for rival in each.rivals]
    own, (_, low, high) = _delays_from_attitude(selection.fit.hypothesis), effect.parameters["seconds"]
    equal_delays = [each for each in rivals if np.all(np.abs(_delays_from_attitude(each) - own) < 0.5 * (high - low))]
    return all(any(name in rival.values for rival in equal_delays) for name in effect.equivalent_to)


def _delays_from_attitude(hypothesis: Hypothesis) -> Array:
    """Return the delays of DVL and reference relative to the attitude, s, (2, recordings)."""
    none = ({"seconds": 0.0},)
    dvl, reference, attitude = (
        np.array([each["seconds"] for each in hypothesis.values.get(name, none)]) for name in CLOCKS
    )
    return np.stack(np.broadcast_arrays(dvl - attitude, reference - attitude))


def compensated(parameters: Parameters, diagnosis: Diagnosis, recording: int | None = None) -> Parameters:
    """Return the parameters with the `corrections` of a diagnosis added."""
    values: dict[str, Any] = {}
    found = corrections(diagnosis, recording)
    for name, each in sorted(found.items(), key=lambda item: item[0] == "time_offset_jump"):
        if name == ARM:
            axes = zip(parameters.lever_arm, ARM_PARAMETERS, strict=True)  # a height may be unobservable
            values["lever_arm"] = tuple(known + each.get(axis, 0.0) for known, axis in axes)
        elif name in OFFSETS:
            values[OFFSETS[name]] = getattr(parameters, OFFSETS[name]) + each["seconds"]
        elif name == "water_lock":
            east, north = parameters.reference_velocity_offset
            values["reference_velocity_offset"] = (east - each.get("east_mps", 0.0), north - each.get("north_mps", 0.0))
        elif name == "clock_drift":
            values["dvl_clock_drift"] = parameters.dvl_clock_drift + each["seconds_per_hour"] / 3600.0
        else:
            offset = values.get("dvl_time_offset", parameters.dvl_time_offset)
            first_ns = diagnosis.recordings[recording or 0][1]
            values["dvl_time_jump"] = each["seconds"]
            values["dvl_time_jump_at"] = 1e-9 * first_ns + each["at_s"] + offset + 0.5 * each["seconds"]
    return parameters.replace(**values)


def _rounded(value: Any) -> str:
    """Return a value, or a list of them, to micrometres and microseconds."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_rounded, value))}]"
    return str(round(value, 6))


def parameter_file(parameters: Parameters) -> str:
    """Return a ROS 2 parameter file with all values that differ from the defaults."""
    values = {
        name: value
        for name, value in parameters.as_dict().items()
        if value != (list(default) if isinstance(default := SCHEMA[name].default, tuple) else default)
    }
    return yaml.safe_dump({"/**": {"ros__parameters": values}}, sort_keys=False, default_flow_style=None)
