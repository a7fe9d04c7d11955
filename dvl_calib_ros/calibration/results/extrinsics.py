"""Mounting, lever arm, scale and delay of a calibration, comparable between models.

Angles are of the corrected mounting in URDF axes, not relative to the configured one. The scale is for motion ahead,
and σ is for the next recording (`day_covariance`), as `replay` prints them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..filters.observability import OBSERVED_SHARE
from ..models import Model
from ..models.parameters import FLU, FRD, Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from .results import corrected_rpy, lever_arm, rpy_jacobian, scale_and_delay


def day_covariance(model: Model, parameters: Parameters) -> Array:
    """Return the addition (n, n) to the covariance of a model; zero for models without a reference.

    `day_std_heading` acts about the body's vertical, `day_std_scale` on all scales alike.
    """
    covariance = np.zeros((model.n_state, model.n_state))
    if model.aided:
        upwards = parameters.rotation_dvl_from_body[:, 2]
        covariance[:3, :3] = parameters.day_std_heading**2 * np.outer(upwards, upwards)
        covariance[3 : model.n_errors, 3 : model.n_errors] = parameters.day_std_scale**2
    return covariance


COMPONENTS = ("roll", "pitch", "yaw", "lever_arm_x", "lever_arm_y", "lever_arm_z", "scale", "time_offset")
N_COMPONENTS, N_AXES = len(COMPONENTS), 3
ANGLES, LEVER_ARM, SCALE, TIME_OFFSET = slice(0, 3), slice(3, 6), 6, 7
# Groups that are averaged separately by their marginal covariance: mounting, scale, delay
MOUNTING, ONLY_SCALE, ONLY_CLOCK = GROUPS = np.arange(SCALE), np.array([SCALE]), np.array([TIME_OFFSET])

_OF_SIZE = "MISALIGNMENT_LARGE"


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Calibration of one DVL.

    Parameters
    ----------
    name
        Name for the user: a file, a bag.
    model
        Name of its model.
    first_ns, last_ns
        First and last stamp of its data.
    value
        (8,) of `COMPONENTS`: roll, pitch, yaw (rad) of the corrected mounting, within half a turn of the configured
        ones; lever arm (m, body frame), scale-factor error of motion ahead and DVL delay (s, positive late); estimated
        or else configured.
    covariance
        (8, 8) for the next recording; zero where `shown` is False.
    shown
        (8,) components that the data make observable.
    used
        Number of samples.
    remarks
        Caveats for the user, in sentences.
    dvl
        The DVL, by frame and axes of its data; '' if unknown, which never equals another.
    by_bias
        (8, 3) change of `COMPONENTS` per σ of the DVL bias along each axis; zero where `shown` is False. Included in
        the covariance, and common to all calibrations of that DVL.
    rejected
        Reason to reject its numbers and σ, in a sentence; '' if there is none, or it was not verified.
    """

    name: str
    model: str
    first_ns: int
    last_ns: int
    value: Array
    covariance: Array
    shown: NDArray[np.bool_]
    used: int
    remarks: tuple[str, ...] = field(default=())
    dvl: str = ""
    by_bias: Array = field(default_factory=lambda: np.zeros((N_COMPONENTS, N_AXES)))
    rejected: str = ""

    @cached_property
    def information(self) -> Array:
        """Inverse (8, 8) of the covariance for a known bias, separately for mounting, scale and delay."""
        found, covariance = (np.zeros((N_COMPONENTS, N_COMPONENTS)), self.covariance - self.by_bias @ self.by_bias.T)
        for group in GROUPS:
            block = np.ix_(group[self.shown[group]], group[self.shown[group]])
            found[block] = np.linalg.inv(covariance[block])
        return found

    @property
    def std(self) -> Array:
        """Standard deviations (8,), nan for components that are not observable."""
        return np.where(self.shown, np.sqrt(np.diag(self.covariance)), np.nan)


def extrinsics_of(
    name: str,
    model: Model,
    state: GaussianState,
    parameters: Parameters,
    span_ns: tuple[int, int],
    used: int,
    remarks: Sequence[str] = (),
    dvl: str = "",
    by_bias: Array | None = None,
    rejected: str = "",
) -> Extrinsics:
    """Return the extrinsics of a model state (n,), estimated with these parameters.

    state: with the σ of its recording. A component is observable if its σ without bias is at most half of its prior σ.
    span_ns: stamps of the first and last sample.
    by_bias: (n, 3), `BiasCovariance.columns` of the state.
    """
    others = scale_and_delay(model, state, parameters)
    value = np.array(
        [
            *corrected_rpy((model.error_terms_from_state @ state.x)[:3], parameters),
            *lever_arm(model, state, parameters.lever_arm),
            others.scale,
            others.time_offset,
        ]
    )
    jacobian = _jacobian(model, state, parameters)
    covariance = jacobian @ state.p @ jacobian.T
    biases = np.zeros((N_COMPONENTS, N_AXES)) if by_bias is None else jacobian @ by_bias
    std = np.sqrt(np.diag(covariance - biases @ biases.T))
    shown = jacobian.any(axis=1) & (std <= OBSERVED_SHARE * _unknown(parameters))
    covariance += jacobian @ day_covariance(model, parameters) @ jacobian.T
    covariance = np.where(np.outer(shown, shown), 0.5 * (covariance + covariance.T), 0.0)
    biases = np.where(shown[:, None], biases, 0.0)
    return Extrinsics(name, model.name, *span_ns, value, covariance, shown, used, tuple(remarks), dvl, biases, rejected)


def rejection(findings: Iterable[Mapping[str, Any]]) -> str:
    """Return the reason to reject a calibration from its findings as plain data; '' if there is none.

    A large misalignment alone does not invalidate the numbers: a mounting may have moved.
    """
    sentences = (reason["says"] for reason in findings if reason["severity"] == "reject" and reason["code"] != _OF_SIZE)
    return str(next(sentences, ""))


def dvl_in_words(frame: str, turned: bool) -> str:
    """Return the identity of a DVL by frame and axes. turned: the data were forward-right-down."""
    return f"{frame}, {FRD if turned else FLU}"


def _jacobian(model: Model, state: GaussianState, parameters: Parameters) -> Array:
    """Return the derivative (8, n) of the components with respect to the state."""
    errors = model.error_terms_from_state
    jacobian = np.zeros((N_COMPONENTS, model.n_state))
    jacobian[ANGLES] = rpy_jacobian(errors[:3] @ state.x, parameters) @ errors[:3]
    jacobian[SCALE] = parameters.rotation_dvl_from_body[:, 0] ** 2 @ errors[3:]
    for component, name in enumerate(COMPONENTS):
        if name in model.state_names:
            jacobian[component, model.state_names.index(name)] = 1.0
    return jacobian


def _unknown(p: Parameters) -> Array:
    """Return the prior standard deviations (8,)."""
    angle, scale = p.initial_std_misalignment, p.initial_std_scale
    return np.array([*[angle] * 3, *[p.initial_std_lever_arm] * 3, scale, p.initial_std_time_offset])
