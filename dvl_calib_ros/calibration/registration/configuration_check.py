"""Check of the configuration against the data: frames, axes, mounting.

In a filter a mounting that is wrong by 45 degrees, or a wrong reference frame, shows only as rejected samples. So the
motion is registered with the reference in the body, in ENU and in NED, each with free mounting.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import FLU, FRD, IMU_ENU, IMU_NED, Parameters, rpy_text
from ..numerics.frames import ENU_FROM_NED, FLU_FROM_FRD, Array, rotation_from_rpy, rpy_from_rotation, turn_between
from ..numerics.robust import FEWEST_OF_MOTION
from ..numerics.samples import VelocityFrame
from ..numerics.tests import Z_ONE_TEST, Z_REPEATED_TEST
from ..streams.interpolation import GAP_S, attitude_at
from .gauss_newton import ARM, FULL_ROWS, QUICK_ROWS, REFERENCE, SCALE, TURN, Fitted, MotionFit, N
from .motion_streams import MotionStreams
from .registration import INDEPENDENT_S, LOG_GAIN, Registration
from .unregistrable_clocks import MOVING_MPS

# Detection of velocities in an earth frame: their direction rotates with the heading.
# In its own axes a vehicle moves in much the same direction on every heading. DVL velocities that a driver rotated
# into the earth frame agree with an earth-frame reference without residual, so only the heading reveals them.

# Mean resultant length: directions agree above, and headings differ below (25° about their mean).
RESULTANT_LIMIT = 0.9
# Largest ratio of the spread in the earth frame to the spread in the body frame for earth-frame velocities.
MAX_SPREAD_RATIO = 0.25


class Directions:
    """Sums of horizontal directions as unit complex numbers, in constant memory.

    Directions of travel as given (nominally in the body) and relative to the heading, as if they were in ENU or NED.
    """

    def __init__(self) -> None:
        self._n = 0
        self._body = self._enu = self._ned = self._heading = 0.0 + 0.0j

    def add(self, velocity: Array, rotation_enu_from_body: Array) -> None:
        """Add velocities (N, 3) m/s, nominally in the body frame, and their attitudes (N, 3, 3)."""
        travel = velocity[:, 0] + 1j * velocity[:, 1]
        heading = rotation_enu_from_body[:, 0, 0] + 1j * rotation_enu_from_body[:, 1, 0]
        is_clear = (np.abs(travel) > MOVING_MPS) & (np.abs(heading) > 0.5)
        travel, heading = travel[is_clear] / np.abs(travel[is_clear]), heading[is_clear] / np.abs(heading[is_clear])
        self._n += len(travel)
        self._body += complex(travel.sum())
        self._enu += complex((travel * heading.conj()).sum())
        self._ned += complex((travel * heading).sum())
        self._heading += complex(heading.sum())

    def _length(self, total: complex) -> float:
        """Return the mean resultant length (0..1) from a sum of unit numbers: 1 if all directions are equal."""
        return abs(total) / self._n if self._n >= FEWEST_OF_MOTION else math.nan

    @property
    def turn_with_heading(self) -> bool:
        """True if the velocities are in an earth frame, ENU or NED.

        NED needs several headings: a vehicle that yaws in waves on a straight course looks like NED.
        """
        spread_body, spread_enu, spread_ned = (1.0 - self._length(mean) for mean in (self._body, self._enu, self._ned))
        max_spread = 1.0 - RESULTANT_LIMIT
        if spread_enu < max_spread and spread_enu < MAX_SPREAD_RATIO * spread_body:
            return True
        return self._headings_are_several and spread_ned < max_spread and spread_ned < MAX_SPREAD_RATIO * spread_body

    @property
    def stay_in_the_body(self) -> bool:
        """True if the velocity direction is constant in the body over several headings."""
        return self._headings_are_several and self._length(self._body) > RESULTANT_LIMIT

    @property
    def _headings_are_several(self) -> bool:
        return self._length(self._heading) < RESULTANT_LIMIT


# Largest misfit of a reported configuration, as a share of the speed and of the misfit of the configured one.
FITS_BELOW, BETTER_BY = math.sqrt(0.05), 0.5
# Rotations nearer than this are the same but for a misalignment, rad.
SAME_WITHIN = math.radians(12.0)
# Step of mounting angles in drawings, rad; a fitted mounting near a multiple is reported as the multiple.
DRAWN = math.pi / 4.0
# Signs of the DVL axes, that of the axis ahead first: as configured, one or both others mirrored. Next to a mounting
# that does not fit also the axis ahead mirrored, and all axes; the axis ahead and one other are a mounting.
SIGNS: Sequence[Array] = [np.array([1.0, one, other]) for one in (1.0, -1.0) for other in (1.0, -1.0)]
SIGNS_OF_AHEAD: Sequence[Array] = [*SIGNS, np.array([-1.0, 1.0, 1.0]), -np.ones(3)]
# Largest residual of an explanation by signs, as a multiple of the registered one, whose clocks are free. In long
# recordings it is smaller: a residual less by that factor is then enough for a delay (`LOG_GAIN`). With few rows
# (QUICK_ROWS) it is larger.
MAX_SIGN_RATIO, MAX_QUICK_RATIO = 1.1, 1.5
# Smallest excess factor of one axis, above any error of the speed of sound.
SCALED_ALONE = 0.2
# Largest misalignment (rad) and scale error of a right configuration; a misfit (share of the speed) as large is wrong.
MISALIGNED, SCALED = math.radians(10.0), 0.1
WRONG_FROM = math.sin(MISALIGNED)
# Initial DVL delays, s: the range of a calibration, in steps that are short compared to waves.
DELAYS_S = (0.0, -1.2, 1.2, -2.4, 2.4)
# A fit that hardly improves is given up above this multiple of the largest useful residual.
FAR_ABOVE = 2.0
# Constraints of alternative configurations: synchronised reference, configured lever arm.
WITHOUT_ARM: Sequence[Array] = (REFERENCE, *np.eye(N)[ARM])
_OTHER_AXES = {FRD: FLU, FLU: FRD}
_FRAMES = (VelocityFrame.BODY, VelocityFrame.ENU, VelocityFrame.NED)


def fitting_configuration(
    motion: MotionStreams, declared: VelocityFrame, registration: Registration | None, parameters: Parameters
) -> Reason | None:
    """Return the finding of a configuration that fits much better than the configured one, else None.

    Parameters
    ----------
    motion: Streams as configured.
    declared: Configured reference frame.
    registration: Of the motion as configured; None if it failed.
    parameters: With the configured axes, mounting and lever arm.
    """
    if not all(motion.measured):
        return None
    nominal, lever_arm = parameters.rotation_dvl_from_body.T, np.array(parameters.lever_arm)
    if motion.has_attitude:
        directions = Directions()
        rotation, known = attitude_at(motion.imu, motion.dvl.times, GAP_S)
        directions.add((motion.dvl.velocity @ nominal.T)[known], rotation[known])
        if directions.turn_with_heading:
            return finding("DVL_TURNS_WITH_HEADING")
    misfit_as_given = 1.0
    if registration is not None:
        angle = _significant_angle(registration.rotation_body_from_dvl, nominal, registration.turn_std)
        misfit_as_given = _misfit_with(registration.residual, registration.scale, angle)
    if misfit_as_given < WRONG_FROM:
        assert registration is not None
        independent = float(np.ptp(motion.reference_times)) / INDEPENDENT_S
        max_ratio = min(MAX_SIGN_RATIO, math.exp(LOG_GAIN / (3.0 * max(independent, 1.0))))
        level = max_ratio * registration.spread
        return wrong_axes(motion, nominal, lever_arm, level, parameters.dvl_axes, SIGNS)
    fits = {}
    for frame in _FRAMES:
        in_frame = _fit_in_frame(
            MotionFit(_as_if(motion, declared, frame), lever_arm, motion.curves, QUICK_ROWS), nominal
        )
        if in_frame is not None:
            fits[frame] = in_frame
    if not fits:
        return None
    # of two similar fits the configured frame is likelier
    best = min(fits, key=lambda frame: fits[frame].fit.residual * (math.sqrt(0.5) if frame is declared else 1.0))
    fit = fits[best].fit
    if fit.residual > min(FITS_BELOW, BETTER_BY * min(misfit_as_given, 1.0)):
        return None
    wrong = wrong_axes(motion, nominal, lever_arm, fit.level, parameters.dvl_axes)
    if wrong is not None and wrong.code == "DVL_LEFT_HANDED":  # a left-handed frame fits better than any rotation
        return wrong
    return _configuration_finding(declared, best, fit.rotation_body_from_dvl, parameters, fits[best].also_turned)


class _FrameFit(NamedTuple):
    """Best fit with the reference in one frame. also_turned: body axes rotated about x by 180° fit as well."""

    fit: Fitted
    also_turned: bool


def _fit_in_frame(fit: MotionFit, nominal: Array) -> _FrameFit | None:
    """Return the best fit of the configured mounting, of it with body or DVL axes rotated, and of a free one.

    nominal: (3, 3) rotation_body_from_dvl as configured.
    """
    body_turned, dvl_turned = FLU_FROM_FRD @ nominal, nominal @ FLU_FROM_FRD
    give_up_above = FAR_ABOVE * FITS_BELOW * fit.speed / math.sqrt(3.0)
    by_mounting = [nearest(fit, start, most=give_up_above) for start in (nominal, body_turned, dvl_turned, None)]
    fitted = [agreement for agreement in by_mounting if agreement is not None]
    if not fitted:
        return None
    turned = by_mounting[1]
    also_turned = turned is not None and misfit(turned, body_turned) < FITS_BELOW
    return _FrameFit(min(fitted, key=lambda fit: fit.level), also_turned)


def nearest(
    fit: MotionFit, rotation_body_from_dvl: Array | None, held: Sequence[Array] = WITHOUT_ARM, most: float = math.inf
) -> Fitted | None:
    """Return the best fit over the DVL delays that a calibration covers, or None.

    held: rows of states held at zero. most: residual (m/s) above which a fit that hardly improves is given up.
    """
    best: Fitted | None = None
    for delay_s in DELAYS_S:
        one = fit(0.0, delay_s, rotation_body_from_dvl, held, most=most if best is None else min(most, best.level))
        if one is not None and np.isfinite(one.x).all() and (best is None or one.level < best.level):
            best = one
    return best


def misfit(fitted: Fitted, nominal: Array, residual: float | None = None) -> float:
    """Return the misfit with a mounting (3, 3) as a share of the speed; a rotation beyond misalignment counts.

    residual: share to use instead of the fit's own.
    """
    angle = _significant_angle(fitted.rotation_body_from_dvl, nominal, fitted.std[TURN])
    return _misfit_with(fitted.residual if residual is None else residual, float(fitted.x[SCALE]), angle)


def _significant_angle(rotation: Array, nominal: Array, std: Array) -> float:
    """Return the significant angle (rad) between two mountings (3, 3). std: (3,) rad per body axis."""
    about = np.abs(turn_between(nominal, rotation))
    return float(np.linalg.norm(np.maximum(about - Z_ONE_TEST * std, 0.0)))


def _misfit_with(residual: float, scale: float, angle: float) -> float:
    """Return the residual share, increased by rotation (rad) and scale if they exceed a misalignment."""
    is_misalignment = angle < MISALIGNED and abs(scale) < SCALED
    return residual if is_misalignment else math.hypot(residual, 2.0 * math.sin(0.5 * angle), scale)


def _as_if(motion: MotionStreams, declared: VelocityFrame, frame: VelocityFrame) -> MotionStreams:
    """Return the motion with its reference declared in one frame, read in another."""
    reference, ned = motion.reference, VelocityFrame.NED
    if (declared is ned) is not (frame is ned):
        reference = reference @ ENU_FROM_NED.T
    return replace(motion, reference=reference, in_earth=frame is not VelocityFrame.BODY)


def wrong_axes(
    motion: MotionStreams,
    nominal: Array,
    lever_arm: Array,
    most: float,
    dvl_axes: str,
    patterns: Sequence[Array] = SIGNS_OF_AHEAD,
) -> Reason | None:
    """Return the finding of DVL axes that are mirrored, turned over, or scaled alone, else None.

    Each sign pattern has its own delay, because in waves a delay of half a period looks like a sign. The axis factors
    of the best pattern decide. most: largest residual, m/s per axis. patterns: signs, that of the axis ahead first.

    nominal: (3, 3) rotation_body_from_dvl as configured. lever_arm: (3,) m.
    """
    ahead = int(np.argmax((motion.dvl.velocity**2).sum(axis=0)))
    others = [axis for axis in range(3) if axis != ahead]
    all_signs = [pattern[np.argsort([ahead, *others])] for pattern in patterns]
    best = _best_signs(motion, nominal, lever_arm, all_signs, FAR_ABOVE * MAX_QUICK_RATIO * most)
    if best is None:
        return None
    signs = best.signs
    fit = MotionFit(_signed(motion, signs), lever_arm, motion.curves.signed(signs), FULL_ROWS)
    fitted = fit(0.0, best.fit.dvl_delay_s, nominal, (REFERENCE,))
    if fitted is None:
        return None
    factors, std, level = fit.axis_factors(fitted, nominal)
    is_shown, is_turned = factors > Z_REPEATED_TEST * std, signs < 0.0
    if (fitted.level if is_turned.any() else level) > most:
        return None
    if is_turned[ahead]:  # a mounting unless all signs are observable
        axis = "each of x, y and z" if is_turned.all() else "xyz"[ahead]
        return finding("DVL_LEFT_HANDED", axis=axis, alike="") if is_shown.all() else None
    if (is_shown & is_turned).any():
        if is_turned.sum() == 1 and (is_shown & ~is_turned)[others].any():
            mirrored, other = sorted(others, key=lambda axis: not is_turned[axis])
            # the same data, read in the opposite axes, have the other axis inverted
            opposite = None if ahead else _OTHER_AXES.get(dvl_axes)
            alike = f" (read as {dvl_axes}; read as {opposite}, {'xyz'[other]} does)" if opposite else ""
            return finding("DVL_LEFT_HANDED", axis="xyz"[mirrored], alike=alike)
        if ahead:
            return _mounting_fits(nominal @ np.diag(np.where(np.arange(3) == ahead, 1.0, -1.0)))
        return _axes_turned(nominal, dvl_axes)
    excess = np.where(is_shown, (factors - Z_REPEATED_TEST * std) / factors[ahead] - SCALED_ALONE, 0.0)
    if not is_turned.any() and excess.max() > 1.0:
        scaled = int(np.argmax(excess))
        factor = float(factors[ahead] / factors[scaled])
        return finding("DVL_AXIS_SCALED", axis="xyz"[scaled], factor=factor, other="xyz"[ahead])
    return None


class _SignFit(NamedTuple):
    """Quick fit of a DVL whose axes have these signs (3,)."""

    signs: Array
    fit: Fitted


def _best_signs(
    motion: MotionStreams, nominal: Array, lever_arm: Array, all_signs: Sequence[Array], most: float
) -> _SignFit | None:
    """Return the signs that fit best near the nominal mounting (3, 3), or None.

    most: residual (m/s) above which a fit that hardly improves is given up.
    """
    best: _SignFit | None = None
    for signs in all_signs:
        quick_rows = MotionFit(_signed(motion, signs), lever_arm, motion.curves.signed(signs), QUICK_ROWS)
        fit = nearest(quick_rows, nominal, (REFERENCE,), most if best is None else min(most, best.fit.level))
        if fit is None:
            continue
        # a fit that rotates the axes back is the configured pattern
        is_near = _significant_angle(fit.rotation_body_from_dvl, nominal, fit.std[TURN]) < MISALIGNED
        if is_near and (best is None or fit.level < best.fit.level):
            best = _SignFit(signs, fit)
    return best


def _signed(motion: MotionStreams, signs: Array) -> MotionStreams:
    return replace(motion, dvl=motion.dvl._replace(velocity=motion.dvl.velocity * signs))


def _configuration_finding(
    declared: VelocityFrame, best: VelocityFrame, rotation: Array, parameters: Parameters, also_turned: bool
) -> Reason | None:
    """Return the finding that names the best configuration. also_turned: rotated body axes fit as well.

    declared, best: configured and best-fitting frame of the reference.
    rotation: (3, 3) best-fitting rotation_body_from_dvl.
    """
    nominal = parameters.rotation_dvl_from_body.T
    same_frame, same_mounting = best is declared, angle_between(rotation, nominal) < SAME_WITHIN
    if same_frame and same_mounting:  # a large misalignment is left to the calibration
        return None
    body = VelocityFrame.BODY
    frame = {"name": "the body frame" if best is body else best.value.upper(), "frame": best.value}
    both_in_earth = body not in (best, declared)
    if same_mounting and both_in_earth and also_turned:
        return finding("REFERENCE_OR_IMU_NED", **frame)
    if same_mounting:  # the frame alone explains the misfit
        return finding("REFERENCE_LOOKS", **frame)
    if not same_frame and both_in_earth and angle_between(rotation, FLU_FROM_FRD @ nominal) < SAME_WITHIN:
        return _imu_turned(parameters)
    if angle_between(rotation, nominal @ FLU_FROM_FRD) < SAME_WITHIN:
        mounting_finding = _axes_turned(nominal, parameters.dvl_axes)
    else:
        mounting_finding = _mounting_fits(_as_drawn(rotation))
    if same_frame:
        return mounting_finding
    return finding("TWO_CONTRADICTIONS", one=finding("REFERENCE_LOOKS", **frame), other=mounting_finding)


def _imu_turned(parameters: Parameters) -> Reason:
    """Return the finding of an IMU in the other axes of world and body than those configured."""
    is_ned = parameters.imu_frame != IMU_NED
    frame, name = (IMU_NED, "NED, forward-right-down") if is_ned else (IMU_ENU, "ENU, forward-left-up")
    rpy = rpy_text(FLU_FROM_FRD @ rotation_from_rpy(parameters.imu_rpy))
    return finding("IMU_LOOKS_NED", name=name, frame=frame, rpy=rpy)


def _axes_turned(nominal: Array, dvl_axes: str) -> Reason:
    """Return the finding of axes turned over; the mounting turns them back if only the messages tell the axes."""
    axes, rpy = _OTHER_AXES.get(dvl_axes), rpy_text(nominal @ FLU_FROM_FRD)
    return finding("DVL_AXES_TURNED", parameter="dvl_axes" if axes else "mounting_rpy", value=axes or rpy)


def _mounting_fits(rotation: Array) -> Reason:
    rpy = (round(float(angle), 4) + 0.0 for angle in rpy_from_rotation(rotation))
    return finding("MOUNTING_FITS", **dict(zip(("roll", "pitch", "yaw"), rpy, strict=True)))


def _as_drawn(rotation: Array) -> Array:
    """Return the nearest mounting (3, 3) in multiples of `DRAWN` if it is the same but for a misalignment."""
    drawn = rotation_from_rpy(np.round(rpy_from_rotation(rotation) / DRAWN) * DRAWN)
    return drawn if angle_between(rotation, drawn) < SAME_WITHIN else rotation


def angle_between(a: Array, b: Array) -> float:
    """Return the angle between two rotations (3, 3), rad."""
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(a.T @ b)) - 1.0))))
