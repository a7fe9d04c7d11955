"""Use of an estimate: the errors of ~/estimate, and corrected velocities with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

from ..models import Model
from ..numerics.error_model import correction_jacobian, correction_matrix
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState

_SCALE_FIRST = [3, 4, 5, 0, 1, 2]
NOT_ESTIMATED = -1.0  # variance of a component that the model does not estimate


def twist_terms(model: Model, state: GaussianState) -> tuple[Array, Array]:
    """Return δk per axis, then φ (6,) with their joint covariance (6, 6).

    A component that the model does not estimate is 0 with variance NOT_ESTIMATED.
    """
    terms = model.error_terms_from_state[_SCALE_FIRST]
    covariance = terms @ state.p @ terms.T
    missing = ~terms.any(axis=1)
    covariance[missing, missing] = NOT_ESTIMATED
    return terms @ state.x, covariance


def lever_arm(model: Model, state: GaussianState, nominal: Sequence[float]) -> tuple[float, float, float]:
    """Return the DVL position, m from the reference point, body frame: configured plus estimated."""
    found = dict(zip(model.state_names, state.x.tolist(), strict=True))
    x, y, z = (known + found.get(f"lever_arm_{axis}", 0.0) for axis, known in zip("xyz", nominal, strict=True))
    return x, y, z


class Correction:
    """Correction of DVL velocities by a model state."""

    def __init__(self, model: Model, state: GaussianState, rotation_dvl_from_body: Array) -> None:
        terms = model.error_terms_from_state
        errors = terms @ state.x
        self._rotation_dvl_from_body = rotation_dvl_from_body
        self._matrix = correction_matrix(errors[:3], errors[3:], rotation_dvl_from_body)
        self._error_covariance = terms @ state.p @ terms.T

    def apply(self, velocity_dvl: Array, noise_dvl: Array) -> tuple[Array, Array]:
        """Return the body velocity (3,) m/s and its covariance (3, 3), including that of the calibration.

        noise_dvl: (3, 3) (m/s)², DVL frame.
        """
        jacobian = correction_jacobian(velocity_dvl, self._rotation_dvl_from_body)
        noise = self._matrix @ noise_dvl @ self._matrix.T
        return self._matrix @ velocity_dvl, noise + jacobian @ self._error_covariance @ jacobian.T
