"""D1's entry in the table of models: positions with metres of noise, by where dead reckoning leads between them."""

from __future__ import annotations

import numpy as np

from ..frames import turned_skew
from ..models.base import SHOWN_WITH_GNSS, Linearised, Model, Needs
from ..observations import Observations


def _per_second(seen: Observations) -> Linearised:
    """z = -Tᵀv, H = [Tᵀ[v×], -Tᵀv] on φ and δk: what is displaced in a second, of which `legs` takes the integral."""
    t, v = seen.rotation_dvl_from_body.T, seen.velocity_dvl
    h = np.empty((len(v), 3, 4))
    h[:, :, :3] = turned_skew(t, v.T).transpose(2, 0, 1)
    h[:, :, 3] = -seen.velocity_in_body
    return -seen.velocity_in_body, h


D1 = Model(
    "D1", Needs.ATTITUDE, 3, _per_second,
    SHOWN_WITH_GNSS | {
        "roll": "positions with their height, while rolling or moving across the bow",
        "pitch": "positions with their height (USBL), and legs of minutes",
        "yaw": "legs of minutes, out and back on several headings",
        "scale": "legs of minutes, out and back",
    },
    assumes="attitude, and positions with any noise, also one that lasts for minutes, and outliers (USBL, plain GPS); "
    "the DVL anywhere within initial_std_lever_arm",
    wrong_when="the positions' frame is turned or scaled: a map off true north, a USBL with a wrong sound speed",
    scale_axes=(("delta_k", (0, 1, 2)),),
    from_positions=True,
    estimator="dvl_calib_ros.calibration.displacement.filter:Displacements",
)  # fmt: skip
