"""Where and how the DVL sits, as others take it: a pose in the body frame with its covariance."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .correction import NOT_ESTIMATED, lever_arm
from .models import Model
from .models.parameters import FROM_REFERENCE, TOLD, UNKNOWN, Parameters
from .numerics.error_model import corrected_mounting
from .numerics.frames import FLU_FROM_FRD, Array, rpy_from_rotation
from .numerics.kalman import GaussianState
from .numerics.samples import Mask
from .observability import observability, scale_std_ahead
from .told_arm import stands

_ARM = ("lever_arm_x", "lever_arm_y", "lever_arm_z")


class MountingPose(NamedTuple):
    """A DVL's frame in the body.

    position: (3,) m in the body, nan where it is not known. rotation_body_from_dvl: (3, 3), of the frame that the
    driver's data are in. covariance: (6, 6) of position (m²) and of a small turn about the body's axes (rad²), as in
    geometry_msgs/PoseWithCovariance; NOT_ESTIMATED on the diagonal of what the model does not estimate.
    """

    position: tuple[float, float, float]
    rotation_body_from_dvl: Array
    covariance: Array


def position_in_body(model: Model, state: GaussianState, parameters: Parameters) -> tuple[float, float, float] | None:
    """Where the DVL is in the body (3,) m, by one model's state x (n,), P (n, n); None where that is not known.

    The lever arm is from the reference point, of which `dvl_position` says what is known. On an axis that the data do
    not show it is as it was given, and where they contradict it or know it worse. If it was not given, nothing is
    known.
    """
    if parameters.dvl_position == UNKNOWN:
        return None
    given = np.array(parameters.lever_arm)
    arm = given
    if parameters.dvl_position == FROM_REFERENCE:
        seen = {each.name for each in observability(model, state.p, parameters) if each.observed}
        shown: Mask = np.array([name in seen for name in _ARM])
        if not given.any() and not shown.all():
            return None
        shown = shown & ~stands(model, state, parameters)
        arm = np.where(shown, lever_arm(model, state, given.tolist()), given)
    x, y, z = (arm + parameters.reference_position).tolist()
    return x, y, z


def mounting_pose(model: Model, state: GaussianState, parameters: Parameters, turned: bool = False) -> MountingPose:
    """Pose of the DVL by one model's state, to first order in its misalignment.

    Parameters
    ----------
    model: Whose state it is.
    state: x (n,), P (n, n).
    parameters: Nominal mounting and lever arm.
    turned: Whether the driver's data are forward-right-down, and were turned.

    """
    t = parameters.rotation_dvl_from_body
    misalignment = (model.error_terms_from_state @ state.x)[:3]
    rotation = corrected_mounting(misalignment, t)
    # R = Tᵀ (I + [φ×])ᵀ, so φ turns the DVL by -Tᵀφ about the body's axes
    terms = np.zeros((6, model.n_state))
    names = model.state_names
    for row, name in enumerate(_ARM):
        if name in names:
            terms[row, names.index(name)] = 1.0
    terms[3:] = -t.T @ model.error_terms_from_state[:3]
    covariance = terms @ state.p @ terms.T
    missing = ~terms.any(axis=1)
    covariance[missing, missing] = NOT_ESTIMATED
    position = position_in_body(model, state, parameters)
    if position is None or parameters.dvl_position == TOLD:
        covariance[:3] = covariance[:, :3] = 0.0
        covariance[[0, 1, 2], [0, 1, 2]] = NOT_ESTIMATED
    return MountingPose(
        (math.nan,) * 3 if position is None else position, rotation @ FLU_FROM_FRD if turned else rotation, covariance
    )


# Turn (rad) over which the angles of a URDF are differentiated: their second derivatives are of order one.
_SMALL_TURN = 1e-5


def rpy_std(misalignment: Array, covariance: Array, parameters: Parameters) -> Array:
    """Standard deviations (3,) rad of roll, pitch, yaw of the corrected mounting, as a URDF's origin has them.

    Not those of turns about the body's axes: of a DVL at 45 degrees, a roll of the body that the motion does not show
    is as much pitch as roll.

    Parameters
    ----------
    misalignment: φ (3,) rad, DVL frame.
    covariance: (n, n) of a model's state, which begins with φ.
    parameters: Nominal mounting.

    """
    t = parameters.rotation_dvl_from_body
    rpy = rpy_from_rotation(corrected_mounting(misalignment, t))
    turned = [rpy_from_rotation(corrected_mounting(misalignment + each, t)) for each in _SMALL_TURN * np.eye(3)]
    jacobian = np.array([(each - rpy + np.pi) % (2.0 * np.pi) - np.pi for each in turned]).T / _SMALL_TURN
    return np.sqrt(np.diag(jacobian @ covariance[:3, :3] @ jacobian.T))


class ScaleAndDelay(NamedTuple):
    """What a pose does not hold. scale: of motion ahead, dimensionless. time_offset: of the DVL's stamps, s, positive
    late, as the parameters say and what was found. Each with its σ, None where the model does not estimate it."""

    scale: float
    scale_std: float | None
    time_offset: float
    time_offset_std: float | None


def scale_and_delay(model: Model, state: GaussianState, parameters: Parameters) -> ScaleAndDelay:
    """Scale ahead and delay by one model's state, x (n,), P (n, n)."""
    ahead = parameters.rotation_dvl_from_body[:, 0] ** 2 @ model.error_terms_from_state[3:]
    std = scale_std_ahead(model, state.p, parameters)
    delay, delay_std = parameters.dvl_time_offset, None
    if "time_offset" in model.state_names:
        index = model.state_names.index("time_offset")
        delay, delay_std = delay + float(state.x[index]), float(np.sqrt(state.p[index, index]))
    return ScaleAndDelay(float(ahead @ state.x), float(std[0]) if len(std) else None, delay, delay_std)
