"""G2's entry in the table of models: G1 with a lever arm and a delay, which no linear filter can begin to find."""

from __future__ import annotations

from ..models.base import SHOWN_WITH_GNSS, Model, Needs, Nuisance
from ..models.own import G1_NUISANCE, SCALE_PER_AXIS, g1_heave, linearise_g1, noise_in_body

# What shows the states that G1 has not, by name.
_SHOWN_TO_G2 = {
    "lever_arm_x": "turns to both sides, or of different sharpness (needs angular velocity)",
    "lever_arm_y": "turns to both sides, or of different sharpness (needs angular velocity)",
    "lever_arm_z": "rolling and pitching: waves, or dives (needs angular velocity)",
    "time_offset": "speeding up and slowing down, entering and leaving turns (needs angular velocity)",
}


G2 = Model(
    "G2", Needs.REFERENCE, 3, linearise_g1, SHOWN_WITH_GNSS | _SHOWN_TO_G2,
    assumes="as G1, with a DVL anywhere on the vehicle whose stamps are off by up to 3 s; needs angular velocity",
    wrong_when="the delay changes along the run; a vehicle that bends",
    scale_axes=SCALE_PER_AXIS,
    nuisance=(
        *G1_NUISANCE,
        Nuisance("lever_arm_x", "m", "initial_std_lever_arm"),
        Nuisance("lever_arm_y", "m", "initial_std_lever_arm"),
        Nuisance("lever_arm_z", "m", "initial_std_lever_arm"),
        Nuisance("time_offset", "s", "initial_std_time_offset", of_the_day=True),
    ),
    noise=noise_in_body,
    heave=g1_heave,
    vertical_from_reference=True,
    rows_in_body=True,
    in_correction_parameters=True,
    extends="G1",
    estimator="dvl_calib_ros.calibration.delay.filter:DelayFilter",
)  # fmt: skip
