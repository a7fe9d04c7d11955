"""An effect that dvl_calib_ros does not have: wash of the stern thruster under the DVL."""

from collections.abc import Mapping

import numpy as np

from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.effects.base import ActsOn, Effect, EffectInput, EffectNeeds, EffectParameter


class ThrusterWash(Effect):
    """Surge is measured too high (or too low) while the vehicle turns, to whichever side."""

    name = "thruster_wash"
    summary = "a surge error in turns to either side: coefficient · |ω_z|"
    manoeuvre = "turns to both sides, sharp ones and wide ones"
    parameters = (
        EffectParameter("coefficient_m", "m", 0.1, -5.0, 5.0, "surge error per turn rate", said="coefficient"),
    )
    acts_on = ActsOn.DVL
    needs = frozenset({EffectNeeds.ANGULAR_VELOCITY})
    confounded_with = ("lever_arm",)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """(coefficient · |ω_z|, 0, 0) m/s in the body frame."""
        surge = values["coefficient_m"] * np.abs(motion.turn_rate[:, 2])
        return surge[:, None] * [1.0, 0.0, 0.0]
