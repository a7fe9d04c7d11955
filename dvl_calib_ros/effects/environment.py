"""Effects of the environment: water instead of ground, an inaccurate compass."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ..calibration.numerics.frames import Array
from .base import HOUR_S, ActsOn, Effect, EffectInput, EffectNeeds, EffectParameter, within

_CURRENT = "{} component of the added velocity (the negative of the current)"


class WaterLock(Effect):
    """The DVL tracks the water, always or for some time, so the current is missing from its velocity."""

    name = "water_lock"
    summary = "the DVL tracks water: an earth-fixed velocity (the negative of the current) is added from from_s to to_s"
    remedy = (
        "a part of the run tracks the water: have the driver send bottom track only; in a whole run the bed "
        "may also move: --apply corrects it"
    )
    manoeuvre = "straight legs on four headings or more, over ground known to be in range"
    parameters = (
        within("east_mps", "m/s", 0.1, 5.0, _CURRENT.format("east"), "east"),
        within("north_mps", "m/s", 0.1, 5.0, _CURRENT.format("north"), "north"),
        EffectParameter(
            "from_s", "s", 0.0, 0.0, math.inf, "when it begins, since the start", linear=False, said="from"
        ),
        EffectParameter(
            "to_s", "s", math.inf, 0.0, math.inf, "when it ends", default=math.inf, linear=False, said="to"
        ),
    )
    per_recording = True
    acts_on = ActsOn.MOTION
    of_velocity = False
    needs = frozenset({EffectNeeds.ATTITUDE})
    confounded_with = ("heading_error", "velocity_bias")

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return R_body_from_enu c while from_s <= t < to_s."""
        locked = slice(*np.searchsorted(motion.elapsed, [values["from_s"], values["to_s"]]))
        east, north = motion.attitude[locked, 0], motion.attitude[locked, 1]  # for each axis of the body
        added = np.zeros_like(motion.velocity_body)
        added[locked] = values["east_mps"] * east + values["north_mps"] * north
        return added


class HeadingError(Effect):
    """The heading error varies with the heading, as of an uncompensated compass, or grows with time.

    It rotates the reference, which is computed with the wrong heading. A constant error is misalignment about z. Hard
    iron causes one cycle per turn, soft iron two.
    """

    name = "heading_error"
    summary = (
        "the reference's yaw ψ (east to north) is wrong by sin_rad · sin ψ + cos_rad · cos ψ; in several recordings "
        "also by sin2_rad · sin 2ψ + cos2_rad · cos 2ψ, or by rad_per_hour · (t - start)"
    )
    remedy = "calibrate the compass, away from magnetic material; a mounting cannot cause this"
    manoeuvre = "straight legs on eight headings, at two speeds"
    parameters = (
        within("sin_rad", "rad", 0.02, 0.5, "part in phase with the sine of yaw", "sin", linear=False),
        within("cos_rad", "rad", 0.02, 0.5, "part in phase with the cosine of yaw", "cos", linear=False),
        within("sin2_rad", "rad", 0.02, 0.5, "part in phase with sin 2ψ", "sin 2ψ", linear=False),
        within("cos2_rad", "rad", 0.02, 0.5, "part in phase with cos 2ψ", "cos 2ψ", linear=False),
        within("rad_per_hour", "rad/h", 0.05, 2.0, "part that grows with time", "drift", linear=False),
    )
    rarer = frozenset({"sin2_rad", "cos2_rad", "rad_per_hour"})
    per_recording = True
    acts_on = ActsOn.REFERENCE
    needs = frozenset({EffectNeeds.ATTITUDE})
    confounded_with = ("water_lock",)

    def trace(self, motion: EffectInput, values: Mapping[str, float]) -> Array:
        """Return g - R_body_from_enu Rz(-error) R_enu_from_body g, also for a body-frame reference."""
        rotation = motion.attitude
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        error = values["sin_rad"] * np.sin(yaw) + values["cos_rad"] * np.cos(yaw)
        sine2, cosine2, drift = (values.get(name, 0.0) for name in ("sin2_rad", "cos2_rad", "rad_per_hour"))
        if sine2 or cosine2:
            error = error + sine2 * np.sin(2.0 * yaw) + cosine2 * np.cos(2.0 * yaw)
        if drift:
            error = error + drift / HOUR_S * motion.elapsed
        east, north, _ = np.einsum("nij,nj->in", rotation, motion.velocity_body)
        sine, cosine_less_one = np.sin(error), -2.0 * np.sin(0.5 * error) ** 2
        added = [cosine_less_one * east + sine * north, cosine_less_one * north - sine * east, np.zeros_like(east)]
        return -np.einsum("nji,jn->ni", rotation, np.array(added))
