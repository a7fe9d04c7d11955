"""What a calibration model is: linear in its state, ``z = H x + noise``.

The residual misalignment φ (DVL frame, rad) comes first, its scale-factor errors after, and last what the model must
know to see them (nuisance states, such as a current).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..frames import Array
from ..observations import Observations

MISALIGNMENT_STATES = ("phi_x", "phi_y", "phi_z")
N_MEASUREMENT = 3  # rows of the largest measurement; models with fewer are padded in the bank


Linearised = tuple[Array, Array]
"""z (N, m) m/s and H (N, m, n): what one model makes of a block of observations."""


class Needs(Enum):
    """What a sample must come with, beside the DVL's velocity, for a model to use it."""

    __hash__ = object.__hash__  # Enum's own is slow, and asked for with every live sample
    NOTHING = "nothing"
    REFERENCE = "reference velocity"
    ATTITUDE = "attitude and angular velocity"


class Nuisance(NamedTuple):
    """A state that is estimated only because it would else be taken for misalignment or scale.

    std: prior standard deviation in `unit`, a number or the name of the parameter that holds it. of_the_day: another on
    another day. handed_on: gone on with from a result file all the same, as a node that is started again is on the same
    day more often than not, and has found it by much data.
    """

    name: str
    unit: str
    std: float | str
    of_the_day: bool = False
    handed_on: bool = True


@dataclass(frozen=True)
class Model:
    """One calibration model.

    linearise: observations -> z (N, m), H (N, m, n). shown_by: what lets it see roll, pitch, yaw and scale, for the
    operator. assumes, wrong_when: for the documentation. scale_axes: for every scale state its name and the DVL axes
    it acts on. needs_prior: True if it uses prior sway and heave.

    What a model may change of how it is filtered: noise: observations -> its own R (N or 1, 3, 3) (m/s)², of which a
    model with fewer rows uses the first ones; None: `Observations.noise`. vertical_from_reference: it takes the
    reference's vertical velocity for a measurement, so does without where there is none (M3 and M4 assume their own).
    heave: observations -> (H, z) (N, n+1) of what holds of heave in the mean, see heave.py. rows_in_body: its three
    rows are those of the body, else those of the DVL. motion_is_noise: its noise is the vehicle's motion, so samples
    count by `Observations.motion_weight`. in_correction_parameters: its filter's first
    five states are those of the correction, see `correction_parameters`. extends: the model whose states its own begin
    with, and which it equals while the data show nothing more. estimator: "module:class" of the `Estimator` that finds
    its states, '' for the linear filter.
    sideslip_std: σ (rad) about the body's yaw axis that no data of this model can take away, and that is in its P; 0
    for none. uses_height: it wants `Observations.height`. instead_of: the model that `auto` leaves for this one once
    headings show the current (headings.py). from_positions: it goes by positions, not by velocities made of them;
    `auto` takes it where these are too noisy.
    """

    name: str
    needs: Needs
    n_measurement: int
    linearise: Callable[[Observations], Linearised]
    shown_by: Mapping[str, str]
    assumes: str
    wrong_when: str
    scale_axes: tuple[tuple[str, tuple[int, ...]], ...] = ()
    needs_prior: bool = False
    nuisance: tuple[Nuisance, ...] = ()
    noise: Callable[[Observations], Array] | None = None
    heave: Callable[[Observations], Array] | None = None
    motion_is_noise: bool = False
    vertical_from_reference: bool = False
    rows_in_body: bool = False
    in_correction_parameters: bool = False
    extends: str | None = None
    estimator: str = ""
    instead_of: str | None = None
    sideslip_std: float = 0.0
    uses_height: bool = False
    from_positions: bool = False

    @property
    def aided(self) -> bool:
        """Whether it needs a reference: velocities, or positions."""
        return self.needs is Needs.REFERENCE or self.from_positions

    @property
    def n_errors(self) -> int:
        """Number of states that are errors of the DVL: misalignment and scale."""
        return 3 + len(self.scale_axes)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in order: misalignment (rad), scale-factor errors (dimensionless), nuisance states."""
        scales, nuisance = (name for name, _ in self.scale_axes), (each.name for each in self.nuisance)
        return (*MISALIGNMENT_STATES, *scales, *nuisance)

    @property
    def n_state(self) -> int:
        """Number of states n."""
        return self.n_errors + len(self.nuisance)

    @cached_property
    def of_day(self) -> NDArray[np.intp]:
        """Which states (u,) are of the day (`Nuisance.of_the_day`)."""
        return self._nuisance_that(lambda each: each.of_the_day)

    @cached_property
    def not_handed_on(self) -> NDArray[np.intp]:
        """Which states (u,) are not gone on with from a result file (`Nuisance.handed_on`)."""
        return self._nuisance_that(lambda each: not each.handed_on)

    def _nuisance_that(self, is_so: Callable[[Nuisance], bool]) -> NDArray[np.intp]:
        return np.array([self.n_errors + i for i, each in enumerate(self.nuisance) if is_so(each)], dtype=np.intp)

    @cached_property
    def error_terms_from_state(self) -> Array:
        """(6, n) matrix that takes the state to φ (3) and δk per axis (3)."""
        matrix = np.zeros((6, self.n_state))
        matrix[:3, :3] = np.eye(3)
        for column, (_, axes) in enumerate(self.scale_axes, start=3):
            matrix[[3 + axis for axis in axes], column] = 1.0
        return matrix


# What lets models see roll, pitch, yaw and scale, for the operator: with GNSS, and without.
SHOWN_WITH_GNSS = {
    "roll": "motion across the bow: turns, a box or a figure eight",
    "pitch": "motion ahead: a straight leg at 1 m/s or more",
    "yaw": "motion ahead: a straight leg at 1 m/s or more",
    "scale": "speed and time: longer legs, faster",
    "scale across": "motion across the bow: turns, a box or a figure eight",
}
SHOWN_WITHOUT = {
    "roll": "a reference velocity (GNSS): without one this cannot be seen",
    "pitch": "motion ahead without heave: a straight, level leg",
    "yaw": "motion ahead without sway: a straight leg, no current across",
    "scale": "a reference velocity (GNSS): without one this cannot be seen",
}
