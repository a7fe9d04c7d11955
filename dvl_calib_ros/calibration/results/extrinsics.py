"""Mounting, scale and delay of one calibration in terms that calibrations of any model share.

A model's angles are relative to the configured mounting, and its states are its own. Two calibrations can be compared
in the whole: the corrected mounting in the axes of a URDF, lever arm, scale of motion ahead and delay, with σ of the
next recording (`day_covariance`), as `replay` prints them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..filters.day_to_day_covariance import day_covariance
from ..filters.observability import OBSERVED_SHARE
from ..models import Model
from ..models.parameters import FLU, FRD, Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from .results import corrected_rpy, rpy_jacobian, scale_and_delay
from .velocity_correction import lever_arm

COMPONENTS = ("roll", "pitch", "yaw", "lever_arm_x", "lever_arm_y", "lever_arm_z", "scale", "time_offset")
N_COMPONENTS, N_AXES = len(COMPONENTS), 3
ANGLES, LEVER_ARM, SCALE, TIME_OFFSET = slice(0, 3), slice(3, 6), 6, 7
# Averaged each by its marginal covariance: mounting, scale, delay
MOUNTING, ONLY_SCALE, ONLY_CLOCK = GROUPS = np.arange(SCALE), np.array([SCALE]), np.array([TIME_OFFSET])

_OF_SIZE = "MISALIGNMENT_LARGE"


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """One calibration of a DVL.

    Parameters
    ----------
    name
        What people know it by: a file, a bag.
    model
        Name of the model that found it.
    first_ns, last_ns
        Stamps of the data that it was found from.
    value
        (8,) of `COMPONENTS`: roll, pitch, yaw (rad) of the corrected mounting, within half a turn of the configured
        ones; lever arm (m, body frame), scale-factor error of motion ahead and delay of the DVL's stamps (s, positive
        late), each estimated, else configured.
    covariance
        (8, 8) of the next recording; zero where `shown` is not.
    shown
        (8,) which of them the data showed.
    used
        Samples.
    remarks
        What to know when it is believed, in sentences.
    dvl
        Which DVL, by the frame and the axes of its data; '' where that is not known, which is another each time.
    by_bias
        (8, 3) by how much `COMPONENTS` are off where that DVL is off by one σ of its bias along each of its axes; zero
        where `shown` is not. It is in the covariance, and common to all calibrations of that DVL.
    rejected
        Why its numbers and σ are not to be believed, in a sentence; '' if they are, or nobody has judged them.
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
        """(8, 8) inverse of the covariance if the bias were known: of mounting, scale and delay, each for itself."""
        found, covariance = np.zeros((N_COMPONENTS, N_COMPONENTS)), self.covariance - self.by_bias @ self.by_bias.T
        for group in GROUPS:
            at = np.ix_(group[self.shown[group]], group[self.shown[group]])
            found[at] = np.linalg.inv(covariance[at])
        return found

    @property
    def std(self) -> Array:
        """(8,) standard deviations, nan for what was not shown."""
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
    """Return what a state (n,) of a model says of the DVL, with the parameters that it was estimated with.

    state: with σ of its recording, by which a component is shown: if that without the bias is at most half of what the
    parameters say is known without data, as for observability. span_ns: stamps of the first and last sample.
    by_bias: (n, 3), `OfBias.columns` of the state.
    """
    beside = scale_and_delay(model, state, parameters)
    value = np.array(
        [
            *corrected_rpy((model.error_terms_from_state @ state.x)[:3], parameters),
            *lever_arm(model, state, parameters.lever_arm),
            beside.scale,
            beside.time_offset,
        ]
    )
    jacobian = _jacobian(model, state, parameters)
    covariance = jacobian @ state.p @ jacobian.T
    common = np.zeros((N_COMPONENTS, N_AXES)) if by_bias is None else jacobian @ by_bias
    std = np.sqrt(np.diag(covariance - common @ common.T))
    shown = jacobian.any(axis=1) & (std <= OBSERVED_SHARE * _unknown(parameters))
    covariance += jacobian @ day_covariance(model, parameters) @ jacobian.T
    covariance = np.where(np.outer(shown, shown), 0.5 * (covariance + covariance.T), 0.0)
    common = np.where(shown[:, None], common, 0.0)
    return Extrinsics(name, model.name, *span_ns, value, covariance, shown, used, tuple(remarks), dvl, common, rejected)


def rejection(findings: Iterable[Mapping[str, Any]]) -> str:
    """Return why a calibration is not to be believed, by its findings as plain data; '' if it is.

    A large misalignment alone leaves numbers and σ as they are: a mounting that moved has one.
    """
    against = (each["says"] for each in findings if each["severity"] == "reject" and each["code"] != _OF_SIZE)
    return str(next(against, ""))


def dvl_in_words(frame: str, turned: bool) -> str:
    """Which DVL: two of a vehicle have frames of their own. turned: from forward-right-down, whose bias is another."""
    return f"{frame}, {FRD if turned else FLU}"


def _jacobian(model: Model, state: GaussianState, p: Parameters) -> Array:
    """Differentiate the components by a model's state: (8, n)."""
    errors = model.error_terms_from_state
    found = np.zeros((N_COMPONENTS, model.n_state))
    found[ANGLES] = rpy_jacobian(errors[:3] @ state.x, p) @ errors[:3]
    found[SCALE] = p.rotation_dvl_from_body[:, 0] ** 2 @ errors[3:]
    for at, name in enumerate(COMPONENTS):
        if name in model.state_names:
            found[at, model.state_names.index(name)] = 1.0
    return found


def _unknown(p: Parameters) -> Array:
    """(8,) standard deviations without data."""
    angle, scale = p.initial_std_misalignment, p.initial_std_scale
    return np.array([*[angle] * 3, *[p.initial_std_lever_arm] * 3, scale, p.initial_std_time_offset])
