"""Where a calibration says that the DVL sits and how it measures, in terms that calibrations of any model share.

A model's angles are relative to the mounting that it was given, and its states are its own. What two calibrations can
be compared in is the whole: the corrected mounting in the body, the lever arm, the scale of motion ahead and the delay.
A calibration is right for its own day: what another day makes of it (`days`) is in the covariance here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..filters.day_to_day_covariance import day_covariance
from ..filters.observability import OBSERVED_SHARE
from ..models import Model
from ..models.parameters import FLU, FRD, Parameters
from ..numerics.error_model import corrected_mounting
from ..numerics.frames import Array, quaternion_from_rotation, turn_between
from ..numerics.kalman import GaussianState

COMPONENTS = (
    "turn_x", "turn_y", "turn_z", "lever_arm_x", "lever_arm_y", "lever_arm_z", "scale", "time_offset",
)  # fmt: skip
N_COMPONENTS, N_AXES = len(COMPONENTS), 3
TURN, LEVER_ARM, SCALE, TIME_OFFSET = slice(0, 3), slice(3, 6), 6, 7
# What differences are told of, each by its marginal covariance: mounting, scale, delay
MOUNTING, ONLY_SCALE, ONLY_CLOCK = GROUPS = np.arange(SCALE), np.array([SCALE]), np.array([TIME_OFFSET])
# For derivatives by differences: of angles of some degrees exact to nine digits
_STEP = 1e-6


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
    rotation_body_from_dvl
        (3, 3), corrected mounting.
    lever_arm
        (3,) m, body frame: found, else as the parameters said.
    scale
        Scale-factor error of motion ahead, dimensionless; 0 where the model has none.
    time_offset
        By how much the DVL's stamps are late, s: found, else as the parameters said.
    covariance
        (8, 8) of `COMPONENTS` as of another day: a turn of the mounting about the body's axes (rad), lever arm, scale
        and delay; zero where `shown` is not.
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
    """

    name: str
    model: str
    first_ns: int
    last_ns: int
    rotation_body_from_dvl: Array
    lever_arm: Array
    scale: float
    time_offset: float
    covariance: Array
    shown: NDArray[np.bool_]
    used: int
    remarks: tuple[str, ...] = field(default=())
    dvl: str = ""
    by_bias: Array = field(default_factory=lambda: np.zeros((N_COMPONENTS, N_AXES)))

    @cached_property
    def information(self) -> Array:
        """(8, 8) inverse of the covariance of what was shown, were the bias known: of mounting, scale and delay, each
        for itself."""
        found, covariance = np.zeros((N_COMPONENTS, N_COMPONENTS)), self.covariance - self.by_bias @ self.by_bias.T
        for group in GROUPS:
            at = np.ix_(group[self.shown[group]], group[self.shown[group]])
            found[at] = np.linalg.inv(covariance[at])
        return found

    @cached_property
    def components(self) -> Array:
        """(9,) quaternion of the mounting (x, y, z, w), lever arm, scale and delay."""
        quaternion = quaternion_from_rotation(self.rotation_body_from_dvl)
        return np.array([*quaternion, *self.lever_arm, self.scale, self.time_offset])

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
) -> Extrinsics:
    """What a state (n,) of a model says of the DVL, with the parameters that it was found with.

    state: with σ of its recording, by which a component is shown: if that without the bias is at most half of what the
    parameters say is known without data, as for observability. span_ns: stamps of the first and last sample.
    by_bias: (n, 3), `OfBias.columns` of the state.
    """
    found = _components(model, state.x, parameters)
    jacobian = np.empty((N_COMPONENTS, len(state.x)))
    for index in range(len(state.x)):
        step = np.zeros(len(state.x))
        step[index] = _STEP
        up, down = (_components(model, state.x + way * step, parameters) for way in (1.0, -1.0))
        turn = turn_between(found[0], up[0]) - turn_between(found[0], down[0])
        jacobian[:, index] = np.concatenate([turn, up[1] - down[1]]) / (2.0 * _STEP)
    covariance = jacobian @ state.p @ jacobian.T
    common = np.zeros((N_COMPONENTS, N_AXES)) if by_bias is None else jacobian @ by_bias
    std = np.sqrt(np.diag(covariance - common @ common.T))
    shown = jacobian.any(axis=1) & (std <= OBSERVED_SHARE * _unknown(parameters))
    covariance += jacobian @ day_covariance(model, parameters) @ jacobian.T
    covariance[~shown] = 0.0
    covariance[:, ~shown] = 0.0
    rotation, rest = found
    return Extrinsics(
        name=name,
        model=model.name,
        first_ns=span_ns[0],
        last_ns=span_ns[1],
        rotation_body_from_dvl=rotation,
        lever_arm=rest[:3],
        scale=float(rest[3]),
        time_offset=float(rest[4]),
        covariance=0.5 * (covariance + covariance.T),
        shown=shown,
        used=used,
        remarks=tuple(remarks),
        dvl=dvl,
        by_bias=np.where(shown[:, None], common, 0.0),
    )


def dvl_in_words(frame: str, turned: bool) -> str:
    """Which DVL: two of a vehicle have frames of their own. turned: from forward-right-down, whose bias is another."""
    return f"{frame}, {FRD if turned else FLU}"


def _components(model: Model, x: Array, p: Parameters) -> tuple[Array, Array]:
    """Corrected mounting (3, 3), and lever arm, scale and delay (5,)."""
    errors = model.error_terms_from_state @ x
    rotation = corrected_mounting(errors[:3], p.rotation_dvl_from_body)
    own = dict(zip(model.state_names, x.tolist(), strict=True))
    arm = [known + own.get(f"lever_arm_{axis}", 0.0) for axis, known in zip("xyz", p.lever_arm, strict=True)]
    scale = float(rotation[0] ** 2 @ errors[3:])
    return rotation, np.array([*arm, scale, p.dvl_time_offset + own.get("time_offset", 0.0)])


def _unknown(p: Parameters) -> Array:
    """(8,) standard deviations without data."""
    angle, scale = p.initial_std_misalignment, p.initial_std_scale
    return np.array([*[angle] * 3, *[p.initial_std_lever_arm] * 3, scale, p.initial_std_time_offset])
