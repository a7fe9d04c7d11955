"""Hold-out verification of a calibration, on samples that it did not use.

For each fold (filters/cross_validation.py) the models are solved without it, and their correction is compared with the
reference velocity on it. So every sample with a reference is judged once. The gate decisions are those of the whole
run, and the random walk is neglected.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, by_severity, finding
from ..filters.cross_validation import HeldOutError
from ..filters.observability import OBSERVED_SHARE, Convergence, body_angle_std
from ..models import Model
from ..models.parameters import Parameters
from ..numerics.error_model import corrected_mounting
from ..numerics.frames import Array, whole_degrees
from ..numerics.kalman import GaussianState
from ..numerics.tests import CHANCE, Z_ONE_TEST, chi2_isf
from .results import Verification

# Drift that an accepted calibration may leave open, in `target_drift`: 1 % of distance by default, which a mounting by
# hand (0.5°) has.
ACCEPTED_DRIFT = 5.0
# Significant growth of the squared error in variances of the estimate, for the three angles at least.
WORSE_VARIANCES = chi2_isf(CHANCE, 3) / 3.0
# Held-out error in predicted errors that slightly small claims of noise do not explain.
MAX_ERROR_RATIO = 3.0
# Smallest plausible held-out error as a share of the claimed noise: below, reference and DVL share their noise.
MIN_ERROR_RATIO = 0.2
# Largest share of gated samples: above, the estimate is that of a minority.
MAX_GATED = 0.5
# Largest error without outliers in predicted errors; smallest error with outliers in errors without.
AS_PREDICTED, OUTLIER_RATIO = 1.25, 1.5


def verify(
    model: Model,
    state: GaussianState,
    convergence: Convergence,
    held_out: HeldOutError | None,
    parameters: Parameters,
    used_and_gated: tuple[int, int] | None = None,
    suggestion: Reason | None = None,
    reference_claims: bool = True,
    lever_arm_turns: Reason | None = None,
    finds_lever_arm: bool = False,
    typical_error: float | None = None,
    own_error: float = 0.0,
    remaining_drift: float = 0.0,
) -> Verification:
    """Judge an estimate of all data by its size, its used samples, and its held-out error.

    Parameters
    ----------
    model: Model of the estimate.
    state: x (n,) and P (n, n).
    convergence: Convergence of the estimate.
    held_out: Held-out error; None for too few samples.
    parameters: Thresholds.
    used_and_gated: Numbers of samples used and gated; None if unknown.
    suggestion: Configuration that fits better than the configured one.
    reference_claims: True if the messages of the reference claim the predicted noise, False if a parameter does.
    lever_arm_turns: Angle error due to the lever arm, if the motion does not separate the two.
    finds_lever_arm: True if the σ of the angles include the lever arm.
    typical_error: Velocity error without outliers, m/s rms, if the held-out one is large.
    own_error: Velocity error predicted by σ of time blocks, m/s rms (`calibration_error`).
    remaining_drift: Drift predicted from σ of the estimate, m per km (`drift_left_open`).
    """
    reasons = by_severity(
        [
            # the cause before its effects on the samples
            *([finding("CONFIGURATION_WRONG", says=suggestion).weighed(Severity.REJECT)] if suggestion else []),
            *use_findings(used_and_gated),
            *_lever_arm_findings(lever_arm_turns, finds_lever_arm, parameters),
            *_size_findings(model, state, parameters),
            *_drift_findings(convergence, remaining_drift, parameters),
            _error_finding(held_out, parameters, reference_claims, typical_error, own_error),
        ]
    )
    inspect = _to_inspect(model, state, parameters)
    return Verification(model.name, held_out, reasons[0].severity, tuple(reasons), inspect)


def use_findings(used_and_gated: tuple[int, int] | None) -> list[Reason]:
    """Return findings on the numbers of samples used and gated."""
    if used_and_gated is None:
        return []
    used, gated = used_and_gated
    if not used:
        return [finding("NO_SAMPLE_USED")]
    if gated > MAX_GATED * (used + gated):
        return [finding("MOST_SAMPLES_GATED", gated=gated, given=used + gated, used=used)]
    return []


def _lever_arm_findings(turns: Reason | None, is_found: bool, parameters: Parameters) -> list[Reason]:
    """Return the finding on a lever arm that can rotate an angle; none if turns separate the two."""
    if turns is None:
        return []
    if is_found:
        return [finding("LEVER_ARM_NOT_SHOWN", turns=turns)]
    return [finding("LEVER_ARM_TURNS_ANGLE", std=parameters.initial_std_lever_arm, turns=turns)]


def shown_misalignment(model: Model, state: GaussianState, parameters: Parameters) -> Array:
    """Return the misalignment (3,) about body axes, as φ is; 0 about axes that are not observable."""
    dvl_from_body = parameters.rotation_dvl_from_body
    angles = dvl_from_body.T @ (model.error_terms_from_state @ state.x)[:3]
    std = body_angle_std(state.p, parameters)
    observable = (std <= OBSERVED_SHARE * parameters.initial_std_misalignment) | (np.abs(angles) > Z_ONE_TEST * std)
    return np.where(observable, angles, 0.0)


def shown_mounting(model: Model, state: GaussianState, parameters: Parameters) -> tuple[float, float, float]:
    """Return the mounting_rpy (rad, whole degrees) that corrects the misalignment about the observable body axes."""
    t = parameters.rotation_dvl_from_body
    return whole_degrees(corrected_mounting(t @ shown_misalignment(model, state, parameters), t))


def _angle_deg(model: Model, state: GaussianState, parameters: Parameters) -> float:
    """Return the misalignment angle, degrees, about the observable body axes."""
    return math.degrees(math.atan(float(np.linalg.norm(shown_misalignment(model, state, parameters)))))


def _to_inspect(model: Model, state: GaussianState, parameters: Parameters) -> Reason | None:
    angle, from_deg = _angle_deg(model, state, parameters), math.degrees(parameters.accept_misalignment)
    return None if angle < from_deg else finding("MOUNTING_FAR", degrees=angle, limit=from_deg)


def _size_findings(model: Model, state: GaussianState, parameters: Parameters) -> list[Reason]:
    """Return findings on a misalignment or scale error too large to be plausible."""
    errors = model.error_terms_from_state @ state.x
    angle, reject = _angle_deg(model, state, parameters), math.degrees(parameters.reject_misalignment)
    findings = []
    if angle >= reject:
        rpy = map(math.degrees, shown_mounting(model, state, parameters))
        option = dict(zip(("roll", "pitch", "yaw"), rpy, strict=True))
        findings.append(finding("MISALIGNMENT_LARGE", degrees=angle, limit=reject, **option))
    variance = np.diag(model.error_terms_from_state @ state.p @ model.error_terms_from_state.T)[3:]
    std = np.sqrt(variance)
    is_observable = (variance > 0.0) & (
        (std <= OBSERVED_SHARE * parameters.initial_std_scale) | (np.abs(errors[3:]) > Z_ONE_TEST * std)
    )
    scale = float(np.abs(errors[3:][is_observable]).max(initial=0.0))
    if scale > parameters.max_scale_error:
        findings.append(finding("SCALE_LARGE", percent=100.0 * scale, limit=100.0 * parameters.max_scale_error))
    return findings


def _error_finding(
    held_out: HeldOutError | None,
    parameters: Parameters,
    reference_claims: bool,
    typical_error: float | None,
    own_error: float,
) -> Reason:
    """Return the finding on the held-out error: outliers, worse, too large, implausible, noisier or as predicted.

    typical_error, own_error: velocity errors without outliers, and by σ of time blocks, see `verify`.
    """
    if held_out is None:
        return finding("HELD_OUT_TOO_FEW")
    uncorrected, corrected, predicted = held_out.uncorrected, held_out.corrected, held_out.predicted
    errors: dict[str, float] = {
        "samples": held_out.samples,
        "uncorrected": uncorrected,
        "corrected": corrected,
        "predicted": predicted,
    }
    # if there is nothing to correct, a correction adds about the variance of the estimate; correlated noise makes this
    # more than the filter predicts, so a larger error is no contradiction
    growth = corrected**2 - uncorrected**2
    is_large = corrected > MAX_ERROR_RATIO * predicted
    is_worse = growth - held_out.interpolated**2 > WORSE_VARIANCES * max(held_out.calibration, own_error) ** 2
    if typical_error is not None and (is_large or is_worse):
        # outliers make this comparison meaningless
        is_usual = typical_error < (MAX_ERROR_RATIO if is_large else AS_PREDICTED) * predicted
        if is_usual and corrected > OUTLIER_RATIO * typical_error:
            return finding("HELD_OUT_OUTLIERS", **errors, typical=typical_error)
    if is_worse:
        return finding("HELD_OUT_WORSE", **errors)
    if is_large:
        return finding("HELD_OUT_SEVERAL_TIMES", **errors)
    if reference_claims and corrected < MIN_ERROR_RATIO * (expected := max(predicted, held_out.claimed)):
        return finding("HELD_OUT_IMPLAUSIBLE", **errors | {"predicted": expected})
    if growth > WORSE_VARIANCES * held_out.calibration**2:
        return finding("HELD_OUT_NO_BETTER", **errors)
    dof = 3.0 * (held_out.samples if held_out.independent is None else held_out.independent)
    by_chance = math.sqrt(chi2_isf(CHANCE, dof) / dof)
    if corrected > predicted * parameters.max_error_ratio * by_chance:
        return finding("HELD_OUT_NOISIER", **errors)
    return finding("HELD_OUT", **errors)


def _drift_findings(convergence: Convergence, remaining_drift: float, parameters: Parameters) -> list[Reason]:
    """Return a finding if no angle is observable, or σ still allows a drift well above the target."""
    if convergence is Convergence.COLLECTING:
        return [finding("NO_ANGLE_SHOWN")]
    limit = ACCEPTED_DRIFT * parameters.target_drift
    return [] if remaining_drift <= limit else [finding("DRIFT_OPEN", open=remaining_drift, limit=limit)]


def verification_document(verification: Verification) -> dict[str, Any]:
    """Return a verification as plain data, for JSON and YAML."""
    held_out = verification.held_out
    return {
        "verdict": verification.verdict.value,
        "reasons": [reason.sentence for reason in verification.reasons],
        "findings": [reason.as_dict() for reason in verification.reasons],
        "mounting": verification.mounting.sentence if verification.mounting is not None else "",
        "held_out": None
        if held_out is None
        else {
            "samples": held_out.samples,
            "uncorrected_mps": held_out.uncorrected,
            "corrected_mps": held_out.corrected,
            "predicted_mps": held_out.predicted,
        },
    }
