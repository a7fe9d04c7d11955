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
from ..numerics.frames import ENU_FROM_NED, FLU_FROM_FRD, Array, rotation_from_rpy, rpy_from_rotation, turn_between
from ..numerics.samples import VelocityFrame
from ..streams.interpolation import attitude_at
from .earth_frame_velocity import Directions
from .gauss_newton import ARM, FEW_ROWS, MOST_ROWS, REFERENCE, SCALE, TURN, Fitted, MotionFit, N
from .motion_streams import GAP_S, MIRRORED, Curves, MotionStreams
from .registration import Registration

# A configuration is wrong from here on: what is left of the motion, as a share of it, is that of 10 degrees.
WRONG_FROM = math.sin(math.radians(10.0))
# What is said to fit leaves less than this share, and less than half of what the configuration given leaves.
FITS_BELOW, BETTER_BY = math.sqrt(0.05), 0.5
# A rotation this near another is that one, rad: what is left is misalignment, for the calibration to find.
SAME_WITHIN = math.radians(12.0)
# Mountings are drawn with multiples of such an angle, rad, and one that is the same but for a misalignment is named.
DRAWN = math.pi / 4.0
# Axes turned round are the right ones if they leave so much less than those given: in chi-square, were all samples
# independent; of blocks of ten that are alike it is a tenth.
CLEARLY = 40.0
# ... of which a sample counts no more than by so many times what is left of the most.
OUTLYING = 4.0
# Delays that differ by less read the DVL at the same times, s.
ALIKE_S = 0.1
# ... and no more than so many times what is left with whichever clocks.
AS_WELL = 1.1
# ... by few rows, whose median is good to 4 %: what leaves more is not fitted to all.
FAR_WORSE = 1.5 * AS_WELL
# A registration explains the motion with a misalignment (rad) and a scale below these.
MISALIGNED, SCALED = math.radians(10.0), 0.1
# So many σ of a turn are chance.
BY_CHANCE = 3.0
# From where the DVL's delay is looked for, s: within what a calibration finds, at a step that is short beside waves.
LATE_S = (-2.4, -1.2, 0.0, 1.2, 2.4)
# A clock that was held in time is so to this, s.
HELD_TO_S = 1e-3
# Whatever else is tried than what is configured is tried without another lever arm.
WITHOUT_ARM: Sequence[Array] = (REFERENCE, *np.eye(N)[ARM])
_FRAMES = (VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED)


def fitting_configuration(
    motion: MotionStreams, declared: VelocityFrame, nominal: Array, lever_arm: Array, given: Registration | None
) -> Reason | None:
    """What fits much better than what is configured; None if nothing does, or the configuration fits.

    declared: the frame that the reference is said to be in. nominal: rotation_body_from_dvl (3, 3). given: the motion
    registered with it.
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
        return _other_signs(motion, curves, nominal, lever_arm, given)
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
    if given is not None and (axis := _mirrored(motion, curves, nominal, lever_arm, given, found[best])):
        return finding("DVL_LEFT_HANDED", axis=axis)
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


def _other_signs(
    motion: MotionStreams, curves: Curves, nominal: Array, lever_arm: Array, registered: Registration
) -> Reason | None:
    """Return the finding of the signs of the DVL's axes that explain most, where others than those given do."""
    turned = _turned_round(motion, curves, nominal, lever_arm, registered)
    axis = _mirrored(motion, curves, nominal, lever_arm, registered, turned)
    if axis:
        return finding("DVL_LEFT_HANDED", axis=axis)
    return None if turned is None else finding("DVL_AXES_FRD")


def _turned_round(
    motion: MotionStreams, curves: Curves, nominal: Array, lever_arm: Array, registered: Registration
) -> Fitted | None:
    """Return the fit with y and z turned round, where without a lever arm it explains more than those given with any.

    A vehicle that swims ahead shows its axes only in the sway of turns and the heave of dives, which are small beside
    its speed; and at one speed the sway of a DVL that points down is that of one with a lever arm. registered: the axes
    given with whichever clocks; where a clock is off, neither fits with clocks in time.
    """
    fit, quick = (MotionFit(motion, lever_arm, curves, most) for most in (MOST_ROWS, FEW_ROWS))

    def fitted(rotation: Array, held: Sequence[Array], most: float = math.inf) -> Fitted | None:
        near = nearest(quick, rotation, held, most)
        return None if near is None or near.level > most else fit(0.0, near.dvl_late, rotation, held)

    turned = fitted(nominal @ FLU_FROM_FRD, WITHOUT_ARM, FAR_WORSE * registered.spread)
    if turned is None or turned.level > AS_WELL * registered.spread:
        return None
    if abs(registered.reference.late) < HELD_TO_S and abs(registered.dvl.late) < LATE_S[-1]:  # found already
        given = fit(0.0, registered.dvl.late, nominal, (REFERENCE,))
    else:
        given = fitted(nominal, (REFERENCE,))
    if given is None:
        return None
    # read at other times, the DVL's noise is another one: what is left differs by that alone
    by_chance = math.sqrt(6.0 * turned.rows) if abs(given.dvl_late - turned.dvl_late) > ALIKE_S else 0.0
    return turned if _gain(given, turned) > CLEARLY + by_chance else None


def _mirrored(
    motion: MotionStreams,
    curves: Curves,
    nominal: Array,
    lever_arm: Array,
    registered: Registration,
    rival: Fitted | None,
) -> str:
    """Return the axis of a left-handed DVL, of which the other sign explains more, with any lever arm; '' for none.

    The sign of y is that of the sway of turns, which at one speed is a lever arm of the other sign; the sign of z is
    that of the heave. rival: another explanation, a rotation, of which it has to explain more as well.
    """
    held = (REFERENCE,)
    given: Fitted | None = None
    levels: dict[str, float] = {}
    for axis, signs in MIRRORED.items():
        other = replace(motion, dvl=motion.dvl._replace(velocity=motion.dvl.velocity * signs))
        of_other = curves.mirrored(axis)
        near = nearest(MotionFit(other, lever_arm, of_other, FEW_ROWS), nominal, held, registered.spread)
        if near is None or near.level > registered.spread:
            continue
        turned = MotionFit(other, lever_arm, of_other, MOST_ROWS)(0.0, near.dvl_late, nominal, held)
        given = given or MotionFit(motion, lever_arm, curves, MOST_ROWS)(0.0, registered.dvl.late, nominal, held)
        if turned is None or given is None:
            continue
        gain = min(_gain(each, turned) for each in (given, rival) if each is not None)
        # noise that lasts is that of fewer samples (survey 34211)
        if gain > max(given.inflation, turned.inflation) ** 2 * (CLEARLY + math.sqrt(6.0 * turned.rows)):
            levels[axis] = turned.level
    return min(levels, key=levels.__getitem__, default="")


def _gain(given: Fitted, turned: Fitted) -> float:
    """By how much less is left of axes that are turned, in chi-square, were all samples independent.

    Of the same samples but for those at the ends. Outliers judge nothing, and neither does the level, which the middle
    one tells: of samples of which none fits any better it is another one by chance (survey 47135).
    """
    most = (OUTLYING * max(min(given.level, turned.level), 1e-6)) ** 2
    as_given, as_turned = (float(np.minimum(each.squares, most).mean()) for each in (given, turned))
    return 3.0 * turned.rows * math.log(max(as_given, 1e-12) / max(as_turned, 1e-12))


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
        turned = finding("DVL_AXES_FRD")
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
