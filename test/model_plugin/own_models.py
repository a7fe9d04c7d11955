"""A linear model, which is one entry, and the entry of a model that an estimator of its own finds (own_estimators.py).

W1: M1 with the scale known, so three angles alone. Y1: by how much the reference is wrong in the vertical, and
nothing of the mounting.
"""

from __future__ import annotations

import numpy as np

from dvl_calib_ros.calibration.models import Model, Needs, Nuisance
from dvl_calib_ros.calibration.models.base import SHOWN_WITH_GNSS, Observations

PRIOR_STD = 0.1


def _angles(seen: Observations) -> tuple[np.ndarray, np.ndarray]:
    """z = r - v, H = [r×]."""
    r, r_skew = seen.reference
    return r - seen.velocity_dvl, r_skew


W1 = Model(
    "W1", Needs.REFERENCE, 3, _angles, SHOWN_WITH_GNSS,
    assumes="a scale that is known",
    wrong_when="it is not",
    vertical_from_reference=True,
)  # fmt: skip

Y1 = Model(
    "Y1", Needs.REFERENCE, 3, _angles, SHOWN_WITH_GNSS,
    assumes="a reference that is wrong in the vertical all along",
    wrong_when="it heaves",
    nuisance=(Nuisance("reference_up", "m/s", PRIOR_STD),),
    estimator="own_estimators:MeanRise",
)  # fmt: skip
