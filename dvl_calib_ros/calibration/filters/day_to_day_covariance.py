"""What is constant on one day and another on the next.

By how much the heading reference is off goes into yaw one to one, the speed of sound into scale; no scatter within a
recording shows either. A σ is worth what happens in the next recording, so that which is published, and that by which
recordings are compared, hold both; how far a calibration is, and what its data showed, goes by the recording alone.

A constant error of the reference is of the day as well, but headings show it, so it is a state, with the prior of a
good reference, σ_p. Many are worse, and where headings do not show it σ holds that: of a true error o the estimate is
off by S o, S = P_o / σ_p², beside what it claims. So (F² - 1) σ_p² S Sᵀ is added, of an o of F σ_p; and of a larger one
where what the data show of it, x_o = (1 - S_o) o, contradicts the prior. An error of the same size upwards, of the
reference or of the DVL, is no state; where an error across is a yaw it is a pitch of that size.
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np

from ..models import Model
from ..models.parameters import Parameters
from ..numerics.frames import Array

# References are off by so many times `reference_offset_std` without being broken.
OFTEN_OFF = 4.0
# Data that see this share of an error, or less, show nothing of it; so many σ contradict the prior.
SEEN_FROM, SURELY = 0.02, 3.0
# So large a share of the prior's variance that is left: headings hardly show a constant error.
HARDLY_SEEN = 0.1
OFFSETS = "reference_east", "reference_north"


def offset_covariance(model: Model, state: Array, claimed: Array, parameters: Parameters) -> Array:
    """(n, n) to be added to a model's covariance for references that are worse than their prior.

    state: (n,). claimed: (n, n) what the filter alone claims.
    """
    at = [model.state_names.index(name) for name in OFFSETS if name in model.state_names and not model.estimator]
    if not at:
        return np.zeros_like(claimed)
    variance = parameters.reference_offset_std**2
    sensitivity = claimed[:, at] / variance
    (east, _), (cross, north) = (np.eye(2) - sensitivity[at]).tolist()
    # its axes in closed form: with each live message a decomposition by LAPACK would cost as much as all the rest
    turn = 0.5 * atan2(2.0 * cross, east - north)
    middle, apart = 0.5 * (east + north), hypot(0.5 * (east - north), cross)
    x, y = state[at].tolist()
    first, second = cos(turn) * x + sin(turn) * y, cos(turn) * y - sin(turn) * x
    off = 0.0
    for share, along in ((middle + apart, first), (middle - apart, second)):
        if share > SEEN_FROM:
            seen = along**2 / share  # σ_p² each, by the prior
            off += seen / share if seen > (SURELY * parameters.reference_offset_std) ** 2 else 0.0
    found: Array = (max(OFTEN_OFF**2 * variance, off) - variance) * (sensitivity @ sensitivity.T)
    if np.diag(claimed)[at].min() > HARDLY_SEEN * variance:
        _, across, up = parameters.rotation_dvl_from_body.T
        yaw = up @ sensitivity[:3]  # by an error across, for each m/s
        found[:3, :3] += OFTEN_OFF**2 * variance * float(yaw @ yaw) * np.outer(across, across)
    return found


def day_covariance(model: Model, parameters: Parameters) -> Array:
    """(n, n) to be added to a model's covariance: `day_std_heading` about the body's vertical, `day_std_scale` of every
    scale alike. Zero for models without a reference, which these do not reach.
    """
    found = np.zeros((model.n_state, model.n_state))
    if model.aided:
        upwards = parameters.rotation_dvl_from_body[:, 2]
        found[:3, :3] = parameters.day_std_heading**2 * np.outer(upwards, upwards)
        found[3 : model.n_errors, 3 : model.n_errors] = parameters.day_std_scale**2
    return found
