"""What a calibration is worth to dead reckoning, and the manoeuvre that would make it worth most more.

What is left of its errors carries a vehicle off a straight leg: yaw to the side, scale ahead. That drift is predicted
by the covariance of this recording; what another day adds to it, no manoeuvre of today takes away. A manoeuvre is
tried by what it would measure: a model's own H and noise on that motion, added to the information that there is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models import MODELS, Model
from ..models.base import Assumptions, Observations
from ..models.parameters import Parameters
from ..numerics.frames import FLU_FROM_FRD, Array, rotation_from_quaternion, skew
from ..numerics.samples import FRAME_CODES, VelocityFrame
from ..results.results import Estimate
from ..streams.aligner import Aligner

KM = 1000.0
# A manoeuvre is tried for so long, s, by samples of so many s; after so many of them nobody drives on.
TRIED_S, STEP_S, MOST = 60.0, 2.0, 30
CIRCLE_RADPS, EIGHT_RADPS = math.radians(6.0), math.radians(12.0)
DIVE_RAD, DIVE_S = math.radians(10.0), 30.0
SPEED_PERIOD_S = 20.0
# The manoeuvre that was named stays, unless another brings so many times more.
CLEARLY_BETTER = 1.2
_COMPASS = (("north", 0.0), ("east", 90.0), ("south", 180.0), ("west", 270.0))


class RecentMotion(NamedTuple):
    """How a vehicle moves. speed: m/s. heading: rad from east to north, None where it is not known.

    in_earth: whether the reference is in an earth frame, so that a constant error of it turns with the vehicle.
    noise: (m/s)² per axis, of one second of reference and DVL together.
    """

    speed: float
    heading: float | None
    in_earth: bool
    noise: float


class PredictedDrift(NamedTuple):
    """Predicted drift of dead reckoning on a straight leg, m per km, 1σ: to the side, ahead (nan where the model does
    not know the scale), and both together."""

    side: float
    ahead: float
    both: float


class Outlook(NamedTuple):
    """What to drive next, and about how long until the drift is within its target, s; None if it is or never will."""

    next: Reason
    seconds: float | None


def predicted_drift(model: Model, covariance: Array, parameters: Parameters) -> PredictedDrift:
    """Drift by what a model's state may be off, by its covariance (n, n)."""
    rows = _rows(model, parameters)
    side, ahead = (KM * math.sqrt(max(float(row @ covariance @ row), 0.0)) for row in rows)
    return PredictedDrift(side, ahead if model.scale_axes else math.nan, math.hypot(side, ahead))


def drift_left_open(estimate: Estimate, parameters: Parameters) -> float:
    """Drift (m per km, σ) at the speeds driven that an estimate leaves open."""
    return predicted_drift(MODELS[estimate.model], estimate.velocity_covariance, parameters).both


def _rows(model: Model, parameters: Parameters) -> Array:
    """(2, n) velocity to port and ahead, in m/s for each m/s ahead, by the state of a model."""
    t = parameters.rotation_dvl_from_body
    by_terms = t.T @ np.hstack([-skew(t[:, 0]), np.diag(t[:, 0])])
    rows: Array = by_terms[[1, 0]] @ model.error_terms_from_state
    return rows


def is_good_enough(model: Model) -> Reason:
    """What is said of a model's calibration whose drift is within its target."""
    return finding("NEXT_IS_GOOD" if model.scale_axes else "NEXT_IS_GOOD_BUT_SCALE")


def noise_of_a_second(estimate: Estimate, parameters: Parameters, seconds: float, mean_square_speed: float) -> float:
    """`RecentMotion.noise`, as the filter's information shows it after so many s of motion at this mean square speed.

    Of an information matrix, that on the yaw by itself is the sum of squared speeds over the noise.
    """
    model = MODELS[estimate.model]
    t = parameters.rotation_dvl_from_body
    about_z = np.concatenate([t[:, 2], np.zeros(model.n_state - 3)])
    information = about_z @ np.linalg.pinv(estimate.filter_covariance) @ about_z
    shown = information - parameters.initial_std_misalignment**-2
    usual: float = parameters.gnss_aided_std**2
    return seconds * mean_square_speed / shown if model.aided and shown > 0.0 and seconds > 0.0 else usual


def outlook(estimate: Estimate, parameters: Parameters, motion: RecentMotion, before: Reason | None = None) -> Outlook:
    """What to drive next: that of ten manoeuvres after which the predicted drift is least, and so on until it is good.

    before: what was said last, which stands while nothing is clearly better.
    """
    model = MODELS[estimate.model]
    target, rows = parameters.target_drift, _rows(model, parameters)
    now = predicted_drift(model, estimate.velocity_covariance, parameters)
    if now.both <= target:
        return Outlook(is_good_enough(model), None)
    if not estimate.used or motion.speed < parameters.min_speed or motion.speed <= 0.0:
        return Outlook(finding("NEXT_WAIT"), None)
    # samples of a minute are not as independent as a filter takes them for: by so much
    claimed = predicted_drift(model, estimate.filter_covariance, parameters)
    shared = max(1.0, (now.both / max(claimed.both, 1e-9)) ** 2)
    tried = [
        (reason, _information(model, parameters, motion, *course) / shared)
        for reason, course in _manoeuvres(motion).values()
    ]
    gains = np.array([gain for _, gain in tried])
    information = np.linalg.pinv(estimate.velocity_covariance)
    chosen, seconds = None, 0.0
    for _ in range(MOST):
        left = np.linalg.inv(information + gains)
        drifts = KM * np.sqrt(np.einsum("ri,kij,rj->k", rows, left, rows))
        best = int(np.argmin(drifts))
        if chosen is None:
            chosen = tried[best][0]
            for at, (reason, _) in enumerate(tried):
                is_same = before is not None and (reason.code, _name(reason)) == (before.code, _name(before))
                if is_same and now.both - drifts[best] < CLEARLY_BETTER * (now.both - drifts[at]):
                    chosen = reason
        if drifts[best] <= target:
            return Outlook(chosen, seconds + _until(information, gains[best], rows, target))
        information = information + gains[best]
        seconds += TRIED_S
    assert chosen is not None  # there are manoeuvres
    return Outlook(chosen, None)


def _name(reason: Reason) -> object:
    return reason.numbers.get("name", reason.numbers.get("side"))


def _until(information: Array, gain: Array, rows: Array, target: float) -> float:
    """After how much of a manoeuvre, s, the drift is within its target."""
    shares = np.linspace(0.0, 1.0, 13)[1:]
    left = np.linalg.inv(information + shares[:, None, None] * gain)
    drifts = KM * np.sqrt(np.einsum("ri,kij,rj->k", rows, left, rows))
    return TRIED_S * float(shares[int(np.argmax(drifts <= target))])


def _manoeuvres(motion: RecentMotion) -> dict[str, tuple[Reason, tuple[Array, Array, Array]]]:
    """Name -> what is said of it, and yaw (rad), speed (m/s), pitch (rad) over time (K,)."""
    time = np.arange(0.0, TRIED_S, STEP_S)
    heading, u = motion.heading or 0.0, np.full(len(time), motion.speed)
    ahead, level = np.full(len(time), heading), np.zeros(len(time))
    half = np.where(time < 0.5 * TRIED_S, time, TRIED_S - time)
    changing = u * (1.0 + 0.5 * np.sin(2.0 * np.pi * time / SPEED_PERIOD_S))
    found = {
        "faster": (finding("NEXT_FASTER", speed=1.5 * motion.speed), (ahead, 1.5 * u, level)),
        "speeds": (finding("NEXT_SPEEDS"), (ahead, changing, level)),
        "port": (finding("NEXT_CIRCLE", side="port"), (heading + CIRCLE_RADPS * time, u, level)),
        "starboard": (finding("NEXT_CIRCLE", side="starboard"), (heading - CIRCLE_RADPS * time, u, level)),
        "eight": (finding("NEXT_EIGHT"), (heading + EIGHT_RADPS * half, u, level)),
        "dive": (finding("NEXT_DIVE"), (ahead, u, DIVE_RAD * np.sin(2.0 * np.pi * time / DIVE_S))),
    }
    if motion.heading is None:
        return {"ahead": (finding("NEXT_AHEAD"), (ahead, u, level)), **found}
    legs = {
        name: (finding("NEXT_LEG", name=name, compass=compass), (level + math.radians(90.0 - compass), u, level))
        for name, compass in _COMPASS
    }
    return {**legs, **found}


def _information(
    model: Model, parameters: Parameters, motion: RecentMotion, yaw: Array, speed: Array, pitch: Array
) -> Array:
    """(n, n) that a motion would bring on a model's state, by its own H and noise."""
    t = parameters.rotation_dvl_from_body
    ahead = np.column_stack([speed, np.zeros((len(speed), 2))])
    (ca, sa), (cb, sb), zero = (np.cos(yaw), np.sin(yaw)), (np.cos(pitch), np.sin(pitch)), np.zeros(len(yaw))
    rotation = np.array([[ca * cb, -sa, ca * sb], [sa * cb, ca, sa * sb], [-sb, zero, cb]]).transpose(2, 0, 1)
    turning, pitching = np.gradient(yaw, STEP_S), np.gradient(pitch, STEP_S)
    rates = np.column_stack([-turning * np.sin(pitch), pitching, turning * np.cos(pitch)])
    if parameters.is_z_down:
        rotation, rates = rotation @ FLU_FROM_FRD, rates @ FLU_FROM_FRD
    seen = Observations(
        ahead @ t.T,
        ahead,
        None,
        t,
        np.zeros(2),
        noise=motion.noise * np.eye(3)[None],
        rotation_enu_from_body=rotation,
        angular_velocity=rates,
        interval=np.full(len(speed), STEP_S),
        assumptions=Assumptions(*(getattr(parameters, name) for name in Assumptions._fields)),
        earth_in_body=rotation.transpose(0, 2, 1)[:, :, :2] if motion.in_earth else None,
    )
    own = model.linearise(seen)[1]
    h = np.zeros((len(speed), own.shape[1], model.n_state))
    h[:, :, : own.shape[2]] = own
    names = model.state_names
    if model.aided and "lever_arm_x" in names:
        at = names.index("lever_arm_x")
        h[:, :, at : at + 3] = np.cross(np.eye(3), rates[:, None]).transpose(0, 2, 1)  # -ω×l
    if model.aided and "time_offset" in names:
        h[:, 0, names.index("time_offset")] = np.gradient(speed, STEP_S)
    noise = model.noise(seen) if model.noise is not None else seen.noise
    rows = own.shape[1]
    # noise of an aided model is that of a second; a vehicle's motion goes on from sample to sample
    seconds = STEP_S if model.aided else 1.0
    weight = seen.motion_weight if model.motion_is_noise else np.ones(len(speed))
    weighted = np.linalg.solve(noise[:, :rows, :rows], h) * (weight * seconds)[:, None, None]
    information: Array = np.tensordot(h, weighted, axes=((0, 1), (0, 1)))
    return information


def recent_motion(aligner: Aligner) -> RecentMotion | None:
    """Return how the vehicle moves by its newest samples; None before the first. Its noise is not known here."""
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
