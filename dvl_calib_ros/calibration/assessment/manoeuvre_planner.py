"""Manoeuvre that reduces the predicted drift of dead reckoning most.

The drift is predicted from this recording's covariance, because no manoeuvre reduces day-to-day variation. A
manoeuvre's information comes from the model's H and noise on its motion, and is added to the present information.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..filters.observability import KM, drift_rows, predicted_drift
from ..models import MODELS, Model
from ..models.base import Assumptions, Observations
from ..models.parameters import Parameters
from ..numerics.frames import FLU_FROM_FRD, Array, rotation_from_quaternion
from ..numerics.samples import FRAME_CODES, VelocityFrame
from ..results.results import Estimate
from ..streams.aligner import Aligner

# Duration and sample interval of a manoeuvre, s, and largest number of manoeuvres.
DURATION_S, STEP_S, MAX_MANOEUVRES = 60.0, 2.0, 30
CIRCLE_RADPS, EIGHT_RADPS = math.radians(6.0), math.radians(12.0)
DIVE_RAD, DIVE_S = math.radians(10.0), 30.0
SPEED_PERIOD_S = 20.0
# Advantage from which another manoeuvre replaces the last suggestion.
REPLACED_FROM = 1.2
_COMPASS = (("north", 0.0), ("east", 90.0), ("south", 180.0), ("west", 270.0))


class RecentMotion(NamedTuple):
    """Motion of the vehicle.

    speed: m/s.
    heading: rad, counterclockwise from east; None if unknown.
    in_earth: whether the reference is in an earth frame, so that its constant error rotates relative to the vehicle.
    noise: (m/s)² per axis, of one second of reference and DVL.
    """

    speed: float
    heading: float | None
    in_earth: bool
    noise: float


class Outlook(NamedTuple):
    """Next manoeuvre, and time until the drift is within its target, s; None if it is already or never will be."""

    next: Reason
    seconds: float | None


def drift_left_open(estimate: Estimate, parameters: Parameters) -> float:
    """Return the predicted drift (m per km, σ) of an estimate, at the speeds driven."""
    return predicted_drift(MODELS[estimate.model], estimate.velocity_covariance, parameters).both


def is_good_enough(model: Model) -> Reason:
    """Return the reason that a model's drift is within its target."""
    return finding("NEXT_IS_GOOD" if model.scale_axes else "NEXT_IS_GOOD_BUT_SCALE")


def noise_of_a_second(estimate: Estimate, parameters: Parameters, seconds: float, mean_square_speed: float) -> float:
    """Return `RecentMotion.noise` from the filter's information on yaw, or `gnss_aided_std` squared without any.

    The information on yaw is the sum of squared speeds over the noise. seconds: duration of the data.
    mean_square_speed: (m/s)².
    """
    model = MODELS[estimate.model]
    dvl_from_body = parameters.rotation_dvl_from_body
    about_z = np.concatenate([dvl_from_body[:, 2], np.zeros(model.n_state - 3)])
    information = about_z @ np.linalg.pinv(estimate.filter_covariance) @ about_z
    from_data = information - parameters.initial_std_misalignment**-2
    if model.aided and from_data > 0.0 and seconds > 0.0:
        return seconds * mean_square_speed / from_data
    configured: float = parameters.gnss_aided_std**2
    return configured


def outlook(estimate: Estimate, parameters: Parameters, motion: RecentMotion, before: Reason | None = None) -> Outlook:
    """Return the next manoeuvre, and the time until the predicted drift is on target.

    The manoeuvre that reduces the predicted drift most is added to the information again and again, until the drift is
    on target. The first one is the next manoeuvre.

    before: the last suggestion, kept unless another is clearly better.
    """
    model = MODELS[estimate.model]
    target, rows = parameters.target_drift, drift_rows(model, parameters)
    drift = predicted_drift(model, estimate.velocity_covariance, parameters)
    if drift.both <= target:
        return Outlook(is_good_enough(model), None)
    if not estimate.used or motion.speed < parameters.min_speed or motion.speed <= 0.0:
        return Outlook(finding("NEXT_WAIT"), None)
    # correlated samples hold less information than the filter assumes, by this factor
    claimed_drift = predicted_drift(model, estimate.filter_covariance, parameters)
    excess = max(1.0, (drift.both / max(claimed_drift.both, 1e-9)) ** 2)
    reasons, courses = zip(*_manoeuvres(motion).values(), strict=True)
    gains = np.array([_information(model, parameters, motion, *course) / excess for course in courses])
    information = np.linalg.pinv(estimate.velocity_covariance)
    chosen, seconds = None, 0.0
    for _ in range(MAX_MANOEUVRES):
        posterior = np.linalg.inv(information + gains)
        drifts = KM * np.sqrt(np.einsum("ri,kij,rj->k", rows, posterior, rows))
        best = int(np.argmin(drifts))
        if chosen is None:
            chosen = reasons[best]
            for index, reason in enumerate(reasons):
                is_same = before is not None and (reason.code, _name(reason)) == (before.code, _name(before))
                if is_same and drift.both - drifts[best] < REPLACED_FROM * (drift.both - drifts[index]):
                    chosen = reason
        if drifts[best] <= target:
            return Outlook(chosen, seconds + _until(information, gains[best], rows, target))
        information = information + gains[best]
        seconds += DURATION_S
    assert chosen is not None  # the list of manoeuvres is not empty
    return Outlook(chosen, None)


def _name(reason: Reason) -> object:
    return reason.numbers.get("name", reason.numbers.get("side"))


def _until(information: Array, gain: Array, rows: Array, target: float) -> float:
    """Return the duration, s, of a manoeuvre after which the drift is within its target."""
    shares = np.linspace(0.0, 1.0, 13)[1:]
    posterior = np.linalg.inv(information + shares[:, None, None] * gain)
    drifts = KM * np.sqrt(np.einsum("ri,kij,rj->k", rows, posterior, rows))
    return DURATION_S * float(shares[int(np.argmax(drifts <= target))])


def _manoeuvres(motion: RecentMotion) -> dict[str, tuple[Reason, tuple[Array, Array, Array]]]:
    """Return by name the wording, and yaw (rad), speed (m/s) and pitch (rad) over time (K,)."""
    time = np.arange(0.0, DURATION_S, STEP_S)
    heading, speed = motion.heading or 0.0, np.full(len(time), motion.speed)
    ahead, level = np.full(len(time), heading), np.zeros(len(time))
    there_and_back = np.where(time < 0.5 * DURATION_S, time, DURATION_S - time)
    varying = speed * (1.0 + 0.5 * np.sin(2.0 * np.pi * time / SPEED_PERIOD_S))
    manoeuvres = {
        "faster": (finding("NEXT_FASTER", speed=1.5 * motion.speed), (ahead, 1.5 * speed, level)),
        "speeds": (finding("NEXT_SPEEDS"), (ahead, varying, level)),
        "port": (finding("NEXT_CIRCLE", side="port"), (heading + CIRCLE_RADPS * time, speed, level)),
        "starboard": (finding("NEXT_CIRCLE", side="starboard"), (heading - CIRCLE_RADPS * time, speed, level)),
        "eight": (finding("NEXT_EIGHT"), (heading + EIGHT_RADPS * there_and_back, speed, level)),
        "dive": (finding("NEXT_DIVE"), (ahead, speed, DIVE_RAD * np.sin(2.0 * np.pi * time / DIVE_S))),
    }
    if motion.heading is None:
        return {"ahead": (finding("NEXT_AHEAD"), (ahead, speed, level)), **manoeuvres}
    legs = {
        name: (finding("NEXT_LEG", name=name, compass=compass), (level + math.radians(90.0 - compass), speed, level))
        for name, compass in _COMPASS
    }
    return {**legs, **manoeuvres}


def _information(
    model: Model, parameters: Parameters, motion: RecentMotion, yaw: Array, speed: Array, pitch: Array
) -> Array:
    """Return the information (n, n) that a motion adds on a model's state, from its H and noise."""
    dvl_from_body = parameters.rotation_dvl_from_body
    ahead = np.column_stack([speed, np.zeros((len(speed), 2))])
    (ca, sa), (cb, sb), zero = (np.cos(yaw), np.sin(yaw)), (np.cos(pitch), np.sin(pitch)), np.zeros(len(yaw))
    rotation = np.array([[ca * cb, -sa, ca * sb], [sa * cb, ca, sa * sb], [-sb, zero, cb]]).transpose(2, 0, 1)
    turning, pitching = np.gradient(yaw, STEP_S), np.gradient(pitch, STEP_S)
    rates = np.column_stack([-turning * np.sin(pitch), pitching, turning * np.cos(pitch)])
    if parameters.is_z_down:
        rotation, rates = rotation @ FLU_FROM_FRD, rates @ FLU_FROM_FRD
    observations = Observations(
        ahead @ dvl_from_body.T, ahead, None, dvl_from_body, np.zeros(2), noise=motion.noise * np.eye(3)[None],
        rotation_enu_from_body=rotation, angular_velocity=rates, interval=np.full(len(speed), STEP_S),
        assumptions=Assumptions(*(getattr(parameters, name) for name in Assumptions._fields)),
        earth_in_body=rotation.transpose(0, 2, 1)[:, :, :2] if motion.in_earth else None,
        oriented=np.full(len(speed), motion.heading is not None),
    )  # fmt: skip
    jacobian = model.linearise(observations)[1]
    design = np.zeros((len(speed), jacobian.shape[1], model.n_state))
    design[:, :, : jacobian.shape[2]] = jacobian
    names = model.state_names
    if model.aided and "lever_arm_x" in names:
        first = names.index("lever_arm_x")
        design[:, :, first : first + 3] = np.cross(np.eye(3), rates[:, None]).transpose(0, 2, 1)  # -ω×l
    if model.aided and "time_offset" in names:
        design[:, 0, names.index("time_offset")] = np.gradient(speed, STEP_S)
    noise = model.noise(observations) if model.noise is not None else observations.noise
    rows = jacobian.shape[1]
    # an aided model's noise is per second; motion noise of the others is correlated between samples
    seconds = STEP_S if model.aided else 1.0
    weight = observations.motion_weight if model.motion_is_noise else np.ones(len(speed))
    weighted = np.linalg.solve(noise[:, :rows, :rows], design) * (weight * seconds)[:, None, None]
    information: Array = np.tensordot(design, weighted, axes=((0, 1), (0, 1)))
    return information


def recent_motion(aligner: Aligner) -> RecentMotion | None:
    """Return the motion by the newest samples, its noise unknown (nan); None before the first sample."""
    rows, imu, reference = aligner.rows, aligner.imu, aligner.reference
    if rows.size == rows.begin:
        return None
    heading = None
    if imu.newest_ns is not None and not np.isnan(quaternion := imu.values[imu.size - 1, :4]).any():
        forward = rotation_from_quaternion(quaternion[None])[0, :, 0]
        heading = float(np.arctan2(forward[1], forward[0]))
    in_earth = reference.newest_ns is not None and bool(
        reference.frames[reference.size - 1] != FRAME_CODES[VelocityFrame.BODY]
    )
    speed = float(np.linalg.norm(rows.velocity_dvl[rows.size - 1]))
    return RecentMotion(speed, heading, in_earth, math.nan)
