"""What the data has shown so far: per parameter, what is still missing, and how far the calibration is."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

import numpy as np

from .bank import prior
from .frames import Array
from .models import Model
from .parameters import Parameters

# A parameter counts as observed once the data has halved its prior standard deviation: it then holds three times the
# information of the prior.
OBSERVED_SHARE = 0.5
_BODY_AXES = ("roll", "pitch", "yaw")


class Convergence(Enum):
    """How far a calibration is."""

    COLLECTING = "collecting"
    COARSE = "coarse"
    FINE = "fine"


class Observability(NamedTuple):
    """One parameter of one model.

    std: standard deviation (rad, or dimensionless). observed: the data has halved the prior's. axis: roll, pitch, yaw
    (the body axis that a misalignment turns about most) or scale. missing: what to fly, '' once observed.
    """

    name: str
    std: float
    observed: bool
    axis: str
    missing: str


def observability(model: Model, covariance: Array, parameters: Parameters) -> tuple[Observability, ...]:
    """One entry per state of the model, from its covariance (n, n)."""
    prior_std = np.sqrt(np.diag(prior(model, parameters).p))
    entries = []
    for index, name in enumerate(model.state_names):
        std = math.sqrt(covariance[index, index])
        observed = bool(std <= OBSERVED_SHARE * prior_std[index])
        axis = "scale"
        if index < 3:  # row i of T is the i-th DVL axis in the body
            axis = _BODY_AXES[int(np.argmax(np.abs(parameters.rotation_dvl_from_body[index])))]
        entries.append(Observability(name, std, observed, axis, "" if observed else model.shown_by[axis]))
    return tuple(entries)


def convergence(entries: tuple[Observability, ...], parameters: Parameters) -> Convergence:
    """fine: an angle is observed, every observed angle and the scale are below their thresholds."""
    angles = [entry for entry in entries if entry.axis != "scale" and entry.observed]
    scales = [entry for entry in entries if entry.axis == "scale"]
    if not any(entry.observed for entry in entries):
        return Convergence.COLLECTING
    angles_fine = bool(angles) and all(entry.std < parameters.fine_std_misalignment for entry in angles)
    scales_fine = all(entry.std < parameters.fine_std_scale for entry in scales)
    return Convergence.FINE if angles_fine and scales_fine else Convergence.COARSE
