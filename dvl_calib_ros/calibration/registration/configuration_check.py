"""What configuration the data fit, where the one given is grossly wrong: frames, axes, mounting.

A mounting wrong by 45 degrees, or a reference that is not in the frame that it is said to be in, shows in a filter only
as samples that are gated. So the motion is registered as it would be with the reference in the body, in ENU and in NED,
with whatever mounting fits, and what fits is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import FRD
from ..numerics.frames import ENU_FROM_NED, FLU_FROM_FRD, Array, rotation_from_rpy, rpy_from_rotation, turn_between
from ..numerics.samples import VelocityFrame
from ..streams.interpolation import attitude_at
from .earth_frame_velocity import Directions
from .gauss_newton import ARM, FEW_ROWS, MOST_ROWS, REFERENCE, SCALE, TURN, Fitted, MotionFit, N
from .motion_streams import GAP_S, Curves, MotionStreams
from .registration import Registration

# A configuration is wrong from here on: what is left of the motion, as a share of it, is that of 10 degrees.
WRONG_FROM = math.sin(math.radians(10.0))
# What is said to fit leaves less than this share, and less than half of what the configuration given leaves.
FITS_BELOW, BETTER_BY = math.sqrt(0.05), 0.5
# A rotation this near another is that one, rad: what is left is misalignment, for the calibration to find.
SAME_WITHIN = math.radians(12.0)
# Mountings are drawn with multiples of such an angle, rad, and one that is the same but for a misalignment is named.
DRAWN = math.pi / 4.0
# Signs of the DVL's axes: as given, y or z mirrored, turned over. A vehicle that goes ahead shows that of x.
SIGNS: Sequence[Array] = [np.array([1.0, y, z]) for y in (1.0, -1.0) for z in (1.0, -1.0)]
# What leaves so many times what the registration leaves is no explanation, by few rows and by all.
AS_WELL, FAR_WORSE = 1.1, 1.5
# An axis points the other way, or is scaled alone, where its factor says so by this many σ (two-sided p = 6e-7: eight
# tests of each look, and a look every few blocks), and by so much more than another speed of sound would.
SIGNIFICANT, SCALED_ALONE = 5.0, 0.2
# A registration explains the motion with a misalignment (rad) and a scale below these.
MISALIGNED, SCALED = math.radians(10.0), 0.1
# So many σ of a turn are chance.
BY_CHANCE = 3.0
# From where the DVL's delay is looked for, s: within what a calibration finds, at a step that is short beside waves.
LATE_S = (-2.4, -1.2, 0.0, 1.2, 2.4)
# Whatever else is tried than what is configured is tried without another lever arm.
WITHOUT_ARM: Sequence[Array] = (REFERENCE, *np.eye(N)[ARM])
_FRAMES = (VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED)


def fitting_configuration(
    motion: MotionStreams,
    declared: VelocityFrame,
    nominal: Array,
    lever_arm: Array,
    given: Registration | None,
    dvl_axes: str = "from_message",
) -> Reason | None:
    """What fits much better than what is configured; None if nothing does, or the configuration fits.

    declared: the frame that the reference is said to be in. nominal: rotation_body_from_dvl (3, 3). given: the motion
    registered with it. dvl_axes: the parameter.
    """
    if not all(motion.measured):
        return None
    if motion.has_attitude:
        directions = Directions()
        rotation, known = attitude_at(motion.imu, motion.dvl.times, GAP_S)
        directions.add((motion.dvl.velocity @ nominal.T)[known], rotation[known])
        if directions.turn_with_heading:
            return finding("DVL_TURNS_WITH_HEADING")
    curves = Curves(motion)
    as_given = 1.0
    if given is not None:
        as_given = _left(given.left, given.scale, _shown_turn(given.rotation_body_from_dvl, nominal, given.turn_std))
    if as_given < WRONG_FROM:
        assert given is not None
        return _wrong_axes(motion, curves, nominal, lever_arm, AS_WELL * given.spread, dvl_axes)
    found: dict[VelocityFrame, Fitted] = {}
    also_turned = set()
    for frame in _FRAMES:
        fit = MotionFit(_as_if(motion, declared, frame), lever_arm, curves, FEW_ROWS)
        # the mountings that have a name, and whichever fits
        likely = nominal, FLU_FROM_FRD @ nominal, nominal @ FLU_FROM_FRD, None
        of_use = FITS_BELOW * fit.speed / math.sqrt(3.0)
        each = [nearest(fit, rotation, most=of_use) for rotation in likely]
        if (turned := each[1]) is not None and misfit(turned, FLU_FROM_FRD @ nominal) < FITS_BELOW:
            also_turned.add(frame)
        if some := [one for one in each if one is not None]:
            found[frame] = min(some, key=lambda one: one.level)
    if not found:
        return None
    # of two that fit alike the frame given is the likelier
    best = min(found, key=lambda frame: found[frame].left * (math.sqrt(0.5) if frame is declared else 1.0))
    if found[best].left > min(FITS_BELOW, BETTER_BY * min(as_given, 1.0)):
        return None
    wrong = _wrong_axes(motion, curves, nominal, lever_arm, found[best].level, dvl_axes)
    if wrong is not None and wrong.code == "DVL_LEFT_HANDED":  # which leaves less than the best rotation
        return wrong
    return _named(declared, best, found[best].rotation_body_from_dvl, nominal, best in also_turned)


def nearest(
    fit: MotionFit,
    rotation_body_from_dvl: Array | None,
    held: Sequence[Array] = WITHOUT_ARM,
    most: float = math.inf,
) -> Fitted | None:
    """The best with a DVL that is late by no more than a calibration finds; None without any. most: m/s, of which what
    is left may be, to be of use."""
    each = (fit(0.0, late, rotation_body_from_dvl, held, most=most) for late in LATE_S)
    found = [one for one in each if one is not None and np.isfinite(one.x).all()]
    return min(found, key=lambda one: one.level, default=None)


def misfit(one: Fitted, nominal: Array, left: float | None = None) -> float:
    """What is left, as a share of the speed, with a mounting (3, 3): what a turn explains that is no misalignment is.

    left: as another measure than its own has it.
    """
    turned = _shown_turn(one.rotation_body_from_dvl, nominal, one.std[TURN])
    return _left(one.left if left is None else left, float(one.x[SCALE]), turned)


def _shown_turn(rotation: Array, nominal: Array, std: Array) -> float:
    """By what angle (rad) a mounting is turned from another, but for what chance turns it by, with σ (3,) rad: a level
    vehicle hardly shows its roll."""
    about = np.abs(turn_between(nominal, rotation))
    return float(np.linalg.norm(np.maximum(about - BY_CHANCE * std, 0.0)))


def _left(left: float, scale: float, turned: float) -> float:
    is_misalignment = turned < MISALIGNED and abs(scale) < SCALED
    return left if is_misalignment else math.hypot(left, 2.0 * math.sin(0.5 * turned), scale)


def _as_if(motion: MotionStreams, declared: VelocityFrame, frame: VelocityFrame) -> MotionStreams:
    """The motion with its reference, said to be in one frame, as in another."""
    reference, ned = motion.reference, VelocityFrame.NED
    if (declared is ned) is not (frame is ned):
        reference = reference @ ENU_FROM_NED.T
    return replace(motion, reference=reference, in_earth=frame is not VelocityFrame.BODY)


def _wrong_axes(
    motion: MotionStreams, curves: Curves, nominal: Array, lever_arm: Array, most: float, dvl_axes: str
) -> Reason | None:
    """Return the finding of axes of the DVL that are mirrored, turned over, or scaled alone.

    Each pattern of signs is registered with clocks of its own: in waves a clock that is off by half of one looks like a
    sign. That which leaves least is judged by the factors of its axes, beside lever arm and delay. most: m/s per axis
    that it may leave.
    """
    found: list[tuple[float, Array, Fitted]] = []
    for signs in SIGNS:
        quick = MotionFit(_signed(motion, signs), lever_arm, curves.signed(signs), FEW_ROWS)
        near = nearest(quick, nominal, (REFERENCE,), FAR_WORSE * most)
        # axes turned over, and turned back by the fit, are those as given
        if near is not None and _shown_turn(near.rotation_body_from_dvl, nominal, near.std[TURN]) < MISALIGNED:
            found.append((near.level, signs, near))
    if not found:
        return None
    _, signs, near = min(found, key=lambda each: each[0])
    fit = MotionFit(_signed(motion, signs), lever_arm, curves.signed(signs), MOST_ROWS)
    fitted = fit(0.0, near.dvl_late, nominal, (REFERENCE,))
    if fitted is None or fitted.level > most:
        return None
    factors, std = fit.axis_factors(fitted, nominal)
    is_shown, is_turned = factors > SIGNIFICANT * std, signs < 0.0
    if (is_shown & is_turned).any():
        if is_turned.sum() == 1 and (is_shown & ~is_turned)[1:].any():
            return finding("DVL_LEFT_HANDED", axis="xyz"[int(np.argmax(is_turned))])
        return finding("DVL_AXES_TURNED", axes={FRD: "flu", "flu": FRD}.get(dvl_axes, "the other of flu and frd"))
    too_small = np.where(is_shown, factors / factors[0] - SCALED_ALONE - SIGNIFICANT * std, 0.0)
    if not is_turned.any() and too_small.max() > 1.0:
        at = int(np.argmax(too_small))
        return finding("DVL_AXIS_SCALED", axis="xyz"[at], factor=float(factors[0] / factors[at]))
    return None


def _signed(motion: MotionStreams, signs: Array) -> MotionStreams:
    return replace(motion, dvl=motion.dvl._replace(velocity=motion.dvl.velocity * signs))


def _named(
    declared: VelocityFrame, best: VelocityFrame, rotation: Array, nominal: Array, also_turned: bool
) -> Reason | None:
    """also_turned: the axes of the body turned round fit as well."""
    same_frame, as_given = best is declared, angle_between(rotation, nominal) < SAME_WITHIN
    if same_frame and as_given:  # a large misalignment, for the calibration to find
        return None
    body = VelocityFrame.BODY
    frame = {"name": "the body frame" if best is body else best.value.upper(), "frame": best.value}
    earth = body not in (best, declared)
    if as_given and earth and also_turned:
        return finding("REFERENCE_OR_IMU_NED", **frame)
    if as_given:  # the frame explains it
        return finding("REFERENCE_LOOKS", **frame)
    if not same_frame and earth and angle_between(rotation, FLU_FROM_FRD @ nominal) < SAME_WITHIN:
        return finding("IMU_LOOKS_NED")
    if angle_between(rotation, nominal @ FLU_FROM_FRD) < SAME_WITHIN:
        turned = finding("DVL_AXES_TURNED", axes="the other of flu and frd")
    else:
        rpy = (round(float(angle), 4) + 0.0 for angle in rpy_from_rotation(_as_drawn(rotation)))
        turned = finding("MOUNTING_FITS", **dict(zip(("roll", "pitch", "yaw"), rpy, strict=True)))
    if same_frame:
        return turned
    return finding("TWO_CONTRADICTIONS", one=finding("REFERENCE_LOOKS", **frame), other=turned)


def _as_drawn(rotation: Array) -> Array:
    """The rotation by multiples of `DRAWN` that a mounting (3, 3) is the same as; itself if it is of none."""
    drawn = rotation_from_rpy(np.round(rpy_from_rotation(rotation) / DRAWN) * DRAWN)
    return drawn if angle_between(rotation, drawn) < SAME_WITHIN else rotation


def angle_between(a: Array, b: Array) -> float:
    """Angle of the rotation between two rotations (3, 3), rad."""
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(a.T @ b)) - 1.0))))
