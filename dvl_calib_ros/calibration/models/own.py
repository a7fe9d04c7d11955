"""Our models by the data of a run: `full` (reference velocities), `positions`, and `unaided` (linear, neither)."""

from __future__ import annotations

import numpy as np

from ..numerics.frames import Array, skew, turned_skew
from .base import SHOWN_WITH_GNSS, SHOWN_WITHOUT, Linearised, Model, Needs, Nuisance, Observations

# Sway (m/s, 1 σ) of a vehicle whose turns are not measured
UNSEEN_TURN_SWAY_STD = 0.1
# Sway and heave noise in turns beyond the proportional skid, s: m/s per (rad/s of turn · m/s of speed). On Snapir the
# skid is 1.8 s, and a third of it remains unexplained.
TURN_SWAY_STD_S, TURN_HEAVE_STD_S = 1.0, 0.5
# Steady sideslip (bent fin, trim, propeller torque), rad: 0.35 degrees. Without a reference it is not separable from
# misalignment. Ten recordings of Snapir scatter by 0.35 degrees.
SIDESLIP_STD = 0.006
# Shear of the current with depth, m/s per m: as large as `current_std` over 20 m.
SHEAR_STD = 0.005
# Least vertical component of the body z axis at which a vehicle holds depth by its pitch (60 degrees of tilt).
UPRIGHT = 0.5
_AHEAD = np.array([1.0, 0.0, 0.0])


def _unaided(observed: Observations) -> Linearised:
    """Linearise `unaided`: z = (Tᵀv)_yz - (0, e), state φ, c (east, north), b, d, h, s, a (docs/models.md).

    (Tᵀ(v + [v×]φ))_y = (Rᵀ(c + s z))_y + b ω_z u: current c with shear s over height z, skid b in turns. On one heading
    c and yaw are not separable, so their priors decide. (Tᵀ(v + [v×]φ))_z = (1 + d) e + h: e is the heave of
    a level path at this attitude, n·v_b = 0 with n the third row of R; d = -1 is a vehicle that moves where it points.
    R = rotation_enu_from_body, u the measured speed ahead.

    Samples without attitude have a constant sway a instead, and of [v×] the forward part only: in turns, sway and heave
    vary together and would look like roll.
    """
    rotation, rates = observed.rotation_enu_from_body, observed.angular_velocity
    oriented, v = observed.oriented, observed.velocity_in_body
    assert rotation is not None and rates is not None and oriented is not None
    up = rotation[:, 2]
    upright = oriented & (np.abs(up[:, 2]) > UPRIGHT)
    level_heave = np.where(upright, -(up[:, 0] * v[:, 0] + up[:, 1] * v[:, 1]) / np.where(upright, up[:, 2], 1.0), 0.0)
    h = np.zeros((len(v), 2, 11))
    h[:, :, :3] = -(skew(np.where(oriented[:, None], v, v * _AHEAD)) @ observed.rotation_dvl_from_body.T)[:, 1:]
    across = rotation[:, :2, 1] * oriented[:, None]
    h[:, 0, 3:5] = across
    h[:, 0, 5] = rates[:, 2] * v[:, 0]
    h[:, 1, 6] = level_heave
    h[:, 1, 7] = 1.0
    if observed.height is not None:
        h[:, 0, 8:10] = across * observed.height[:, None]
    h[:, 0, 10] = ~oriented
    z = v[:, 1:].copy()
    z[:, 1] -= level_heave
    return z, h


def _unaided_noise(observed: Observations) -> Array:
    """Return R (N, 3, 3) (m/s)² of `unaided`: sway and heave grow with the turn rate."""
    assert observed.angular_velocity is not None and observed.oriented is not None
    turn = observed.angular_velocity[:, 2] * observed.velocity_in_body[:, 0]
    noise = np.zeros((len(turn), 3, 3))
    noise[:, 0, 0] = np.where(observed.oriented, TURN_SWAY_STD_S * turn, UNSEEN_TURN_SWAY_STD) ** 2
    noise[:, 1, 1] = (TURN_HEAVE_STD_S * turn) ** 2
    noise += observed.assumptions.motion_std**2 * np.eye(3)
    return noise


SCALE_PER_AXIS = (("delta_k_x", (0,)), ("delta_k_y", (1,)))
UNAIDED = Model(
    "unaided", Needs.ATTITUDE_IF_KNOWN, 2, _unaided,
    SHOWN_WITHOUT | {
        "yaw": "another heading, best the opposite one: on one, yaw and a current look alike (needs attitude)",
        "pitch": "motion ahead, holding depth",
    },
    assumes="no GNSS; a current that changes only with depth, skid in proportion to the turn rate, depth held or pitch "
    "flown; without attitude, sway and heave near unknown constants, as large as current_std and heave_offset_std say",
    wrong_when="a current that changes along the run or, on one heading, exceeds current_std; without attitude, a run "
    "that is mostly turning",
    nuisance=(
        Nuisance("current_east", "m/s", "current_std", per_recording=True),
        Nuisance("current_north", "m/s", "current_std", per_recording=True),
        Nuisance("skid", "s", 3.0),
        Nuisance("dive", "", 0.5),
        Nuisance("heave", "m/s", "heave_offset_std"),
        Nuisance("shear_east", "1/s", SHEAR_STD, per_recording=True),
        Nuisance("shear_north", "1/s", SHEAR_STD, per_recording=True),
        Nuisance("sway", "m/s", "current_std", per_recording=True),
    ),
    sideslip_std=SIDESLIP_STD,
    uses_height=True,
    noise=_unaided_noise,
    motion_is_noise=True,
)  # fmt: skip


# States of `full`: misalignment, scale, lever arm, DVL bias, heading deviation (one and two cycles);
# per recording: delays of DVL and reference, constant error of the reference.
PHI, SCALE, LEVER_ARM, BIAS, HEADING = slice(0, 3), slice(3, 5), slice(5, 8), slice(8, 11), slice(11, 15)
DELAY, REFERENCE_DELAY, REFERENCE_ERROR = 15, 16, slice(17, 20)
N_STATE = 20


def heading_cycles(rotation_enu_from_body: Array) -> Array:
    """Return sine and cosine of the heading and of twice the heading (N, 4), of attitudes (N, 3, 3)."""
    heading = np.arctan2(rotation_enu_from_body[:, 1, 0], rotation_enu_from_body[:, 0, 0])
    return np.stack([np.sin(heading), np.cos(heading), np.sin(2.0 * heading), np.cos(2.0 * heading)], axis=1)


def linearise_full(observed: Observations) -> Linearised:
    """Linearise `full` at zero errors: z = g - T'v (N, 3) and H (N, 3, 20), body frame."""
    assert observed.reference_body is not None
    body_from_dvl = observed.rotation_dvl_from_body.T
    h = np.zeros((len(observed.velocity_dvl), 3, N_STATE))
    h[:, :, PHI] = turned_skew(body_from_dvl, observed.velocity_dvl.T).transpose(2, 0, 1)
    h[:, :, SCALE] = -body_from_dvl[:, :2] * observed.velocity_dvl[:, None, :2]
    h[:, :, BIAS] = -body_from_dvl
    if observed.angular_velocity is not None:
        h[:, :, LEVER_ARM] = -skew(observed.angular_velocity)
    if observed.earth_in_body is not None and observed.rotation_enu_from_body is not None:
        h[:, :, REFERENCE_ERROR] = observed.rotation_enu_from_body.transpose(0, 2, 1)
        up = observed.rotation_enu_from_body[:, 2]
        across = np.cross(up, observed.velocity_in_body)
        h[:, :, HEADING] = across[:, :, None] * heading_cycles(observed.rotation_enu_from_body)[:, None]
    return observed.reference_body - observed.velocity_in_body, h


# Motion that makes the published nuisance states observable, by state.
_SHOWN_TO_FULL = {
    "lever_arm_x": "turns to both sides, or of different sharpness (needs angular velocity)",
    "lever_arm_y": "turns to both sides, or of different sharpness (needs angular velocity)",
    "lever_arm_z": "rolling and pitching: waves, or dives (needs angular velocity)",
    "time_offset": "speeding up and slowing down, entering and leaving turns (needs angular velocity)",
}
# Prior σ of the reference delay after registration, s.
REFERENCE_DELAY_STD_S = 0.05


FULL = Model(
    "full", Needs.REFERENCE, 3, linearise_full, SHOWN_WITH_GNSS | _SHOWN_TO_FULL,
    assumes="attitude and angular velocity, or a reference in the body's frame; a DVL anywhere on the vehicle, stamps "
    "off by up to 3 s",
    wrong_when="the delay changes along the run; a vehicle that bends",
    scale_axes=SCALE_PER_AXIS,
    nuisance=(
        Nuisance("lever_arm_x", "m", "initial_std_lever_arm"),
        Nuisance("lever_arm_y", "m", "initial_std_lever_arm"),
        Nuisance("lever_arm_z", "m", "initial_std_lever_arm"),
        Nuisance("dvl_bias_x", "m/s", "dvl_bias_std"),
        Nuisance("dvl_bias_y", "m/s", "dvl_bias_std"),
        Nuisance("dvl_bias_z", "m/s", "dvl_bias_std"),
        Nuisance("heading_sin", "rad", "heading_deviation_std"),
        Nuisance("heading_cos", "rad", "heading_deviation_std"),
        Nuisance("heading_sin2", "rad", "heading_deviation_std"),
        Nuisance("heading_cos2", "rad", "heading_deviation_std"),
        Nuisance("time_offset", "s", "initial_std_time_offset", per_recording=True),
        Nuisance("reference_time_offset", "s", REFERENCE_DELAY_STD_S, per_recording=True, handed_on=False),
        Nuisance("reference_east", "m/s", "reference_offset_std", per_recording=True, handed_on=False),
        Nuisance("reference_north", "m/s", "reference_offset_std", per_recording=True, handed_on=False),
        Nuisance("reference_up", "m/s", "reference_offset_std", per_recording=True, handed_on=False),
    ),
    noise=lambda seen: seen.noise_in_body,
    estimator="dvl_calib_ros.calibration.estimators.block_estimator:FullEstimator",
)  # fmt: skip


def _per_second(observed: Observations) -> Linearised:
    """Linearise the displacement rate of `positions`: z = -Tᵀv, H = [Tᵀ[v×], -Tᵀv] on φ and δk.

    `legs` integrates both over time.
    """
    t, v = observed.rotation_dvl_from_body.T, observed.velocity_dvl
    h = np.empty((len(v), 3, 4))
    h[:, :, :3] = turned_skew(t, v.T).transpose(2, 0, 1)
    h[:, :, 3] = -observed.velocity_in_body
    return -observed.velocity_in_body, h


POSITIONS = Model(
    "positions", Needs.ATTITUDE, 3, _per_second,
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
    estimator="dvl_calib_ros.calibration.estimators.displacement_estimator:Displacements",
)  # fmt: skip
