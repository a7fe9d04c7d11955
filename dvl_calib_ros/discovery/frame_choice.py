"""Choice of the frames of a recording's data by posterior odds: prior from declarations, likelihood from the fit.

A hypothesis is a `Reading`: axes of base_frame, of the IMU and its world, of the reference, of the DVL. Its prior is
the product of the odds of each contradiction to names, transforms, message types, gravity and an odometry's own pose.
Its likelihood is that of the residual of DVL and reference, see `frame_hypotheses`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..calibration.models.parameters import FLU, FRD, FROM_FRAME_ID, FROM_MESSAGE, IMU_ENU, IMU_NED, NWU, Parameters
from ..calibration.numerics.frames import (
    ENU_FROM_NED,
    FLU_FROM_FRD,
    Array,
    rotation_from_quaternion,
    rotation_from_rpy,
    rpy_from_rotation,
)
from ..calibration.numerics.samples import VelocityFrame
from ..calibration.registration.configuration_check import BETTER_BY, DRAWN, angle_between
from ..calibration.registration.frame_hypotheses import (
    MAX_RESIDUAL,
    NOMINAL_TOL_RAD,
    Agreement,
    ImuFrame,
    Reading,
    Readings,
    Registered,
    are_rates_frd,
    nominal_rpy,
)
from ..calibration.streams.imu_frame import ENU_FROM
from ..calibration.streams.interpolation import GAP_S, TurnRates, angular_velocity_at
from ..calibration.streams.screening import unit_quaternions
from ..messages.decode import DeclaredFrame, declared_frame, frame_named
from ..messages.drivers import VELOCITY_TYPES
from ..recordings.topic_messages import Preview
from ..verdict.reasons import Reason, finding
from .discovery import as_option, imu_columns_of
from .gravity import Gravity
from .transforms import Placed, in_degrees

# Log prior odds of contradictions to declarations. The most common error is an IMU whose driver does not follow its
# transform; the rarest is a whole vehicle that is z down without declaring it.
IMU_IN_NED, IMU_IN_OTHER_WORLD, IMU_OTHERWISE = math.log(1 / 10), math.log(1 / 20), math.log(1 / 50)
DVL_AXES_OTHER = math.log(1 / 20)
# without transforms, marine axes are nearly as common as REP-103's
UNPLACED_IN_NED = math.log(1 / 4)
# a wrong transform or parameter of the mounting; an undeclared mounting that differs from the body's axes; one upside
# down, which is equivalent to other axes
MOUNTING_OTHER, MOUNTING_TURNED, UPSIDE_DOWN = math.log(1 / 50), math.log(1 / 3), math.log(1 / 100)
BASE_Z_DOWN, UNPLACED_BASE_Z_DOWN = math.log(1 / 50), math.log(1 / 500)
REFERENCE_FRAME_OTHER = math.log(1 / 200)
REFERENCE_AXES_OTHER = math.log(1 / 50)
# a twist in the axes of REP-103 though the vehicle is z down
TWIST_IN_ROS_AXES = math.log(1 / 3)
# a reference without a declared frame: ENU, the body, NED; other worlds
UNDECLARED = {"enu": 0.0, "ned": math.log(1 / 3)} | dict.fromkeys(("body", FLU, FRD), math.log(1 / 2))
OTHER_WORLD = math.log(1 / 50)
# axes of a twist that contradict its own turn rates or its pose's world; that contradict the motion of its pose
TWIST_RATES_OTHER, TWIST_POSE_OTHER = math.log(1 / 20), math.log(1 / 1000)
# a vehicle travels ahead or astern, seldom sideways
SIDEWAYS = math.log(1 / 50)
# an accelerometer with the wrong sign; gravity that points down in the body or in the world alone
GRAVITY_INVERTED, GRAVITY_CONTRADICTS = math.log(1 / 100), math.log(1 / 1000)
# readings whose log odds at first are this much worse than the best are not registered; limit of their number
FAR_WORSE, MOST_REGISTERED = 8.0, 6
# two readings within these odds (log) are equally likely; mountings within this angle (rad) are equal
AS_LIKELY, SAME_ANSWER = math.log(2.0), math.radians(1.0)
# accuracy of lever arms in transforms (1 σ, m); largest penalty for a wrong arm (chi-square)
ARM_STD_M, MOST_OF_ARM = 0.1, 12.0
# a mounting whose z points down by this (cosine) is upside down; in between, its roll is not observable
OVER = -0.9
# smallest rotation (rad) of a mounting that differs from the body's axes
TURNED_FROM = math.radians(12.0)
# what a parameter is about, and words for its values, in the question which of two readings is right
ASKED = {"base_axes": "base_link", "dvl_axes": "the DVL", "gnss_frame": "the reference", "imu_frame": "the IMU's world"}
AXES = {FLU: "forward-left-up", FRD: "forward-right-down"}
# interval (s) over which a twist is compared with the motion of its own pose
POSE_STEP_S, POSE_LONGEST_S = 0.5, 1.5


@dataclass(frozen=True)
class FrameChoice:
    """The chosen reading.

    agreement: its fit.
    imu: its hypothesis of the IMU.
    says: doubts, such as another reading that fits equally well with another mounting.
    """

    agreement: Agreement
    imu: ImuHypothesis | None
    says: tuple[Reason, ...]


class ImuHypothesis(NamedTuple):
    """A hypothesis of the IMU. z_down: whether the body is z down under it. prior: log odds."""

    frame: ImuFrame
    z_down: bool
    prior: float


@dataclass(frozen=True, eq=False)
class _Tried:
    """A reading with a mounting: rotation_dvl_from_body (3, 3), None for the best-fitting one. prior: log odds."""

    agreement: Agreement
    mounting: Array | None
    prior: float

    @property
    def reading(self) -> Reading:
        """The reading."""
        return self.agreement.reading

    @property
    def residual(self) -> float:
        """Residual as a share of the speed, without the part that a misalignment explains."""
        of_best, known = self.agreement.rotation_dvl_from_body, self.mounting
        is_misaligned = known is not None and angle_between(of_best, known) < TURNED_FROM
        return self.agreement.best_residual if is_misaligned else self.agreement.residual

    def odds(self, found: Array) -> float:
        """Return the log prior including travel direction and, if no mounting is known, the fitted mounting (3, 3)."""
        prior = self.prior + (0.0 if self.agreement.is_ahead else SIDEWAYS)
        if self.mounting is None and angle_between(found, np.eye(3)) > TURNED_FROM:
            prior += UPSIDE_DOWN if found[2, 2] < OVER else MOUNTING_TURNED
        return prior


class _Hypothesis(NamedTuple):
    """What a reading assumes.

    prior: log odds.
    imu: hypothesis of the IMU, None without one.
    turned_as_declared: whether the axes of the DVL are the declared ones.
    """

    prior: float
    imu: ImuHypothesis | None
    turned_as_declared: bool


class FrameChooser:
    """Chooser of the frames of one recording's streams."""

    def __init__(
        self,
        parameters: Parameters,
        given: frozenset[str],
        base_frame: str,
        dvl: Preview,
        dvl_placed: Placed | None,
        imu: Preview | None,
        imu_placed: Placed | None,
    ) -> None:
        """Collect the hypotheses of the IMU. given: names of parameters that the user set."""
        self._parameters, self._given, self._base_frame = parameters, given, base_frame
        self._dvl, self._dvl_placed = dvl, dvl_placed
        self._imu, self._imu_placed = imu, imu_placed
        self._gravity = None if imu is None else Gravity.of(imu.values[:, :4], imu.values[:, 7:])
        self.imus = self._imu_hypotheses()

    @property
    def imu(self) -> ImuHypothesis | None:
        """Most likely hypothesis of the IMU by its own data alone."""
        return max(self.imus, key=lambda imu: imu.prior, default=None)

    @property
    def _says_z_down(self) -> bool:
        return self._parameters.is_z_down or self._base_frame.lower().endswith(("_frd", "_ned"))

    def _imu_hypotheses(self) -> list[ImuHypothesis]:
        """Return the hypotheses of the IMU: as configured, else each possible frame with its log prior odds."""
        if self._imu is None:
            return []
        if self._given & {"imu_rpy", "imu_frame"}:
            rotation = rotation_from_rpy(self._parameters.imu_rpy)
            frame = ImuFrame(rotation, self._parameters.imu_frame, "as given", self._parameters.heading_offset)
            return [ImuHypothesis(frame, self._parameters.is_z_down, 0.0)]
        hypotheses = []
        for frame, prior in self._imu_frames():
            z_down = self._body_is_z_down(frame)
            if "base_axes" not in self._given or z_down == self._parameters.is_z_down:
                frame = replace(frame, heading_offset=self._parameters.heading_offset)
                hypotheses.append(ImuHypothesis(frame, z_down, self._imu_prior(frame, prior, z_down)))
        return hypotheses

    @property
    def _body_from_imu(self) -> Array:
        """Rotation (3, 3) from the IMU to the body by transforms; identity without any."""
        return np.eye(3) if self._imu_placed is None else self._imu_placed.rotation

    def _imu_frames(self) -> list[tuple[ImuFrame, float]]:
        """Return the possible frames of an IMU that is not configured, with the log odds of their frequency."""
        placed, body_from_imu = self._imu_placed, self._body_from_imu
        placement = f"as {placed.source} has {placed.frame}" if placed is not None and placed.source else "as the body"
        frames = [
            (ImuFrame(body_from_imu, IMU_ENU, placement), 0.0),
            (
                ImuFrame(body_from_imu @ FLU_FROM_FRD, IMU_NED, f"forward-right-down in NED, {placement}"),
                UNPLACED_IN_NED if placed is None else IMU_IN_NED,
            ),
            (ImuFrame(body_from_imu, IMU_NED, f"in NED, {placement}"), IMU_IN_OTHER_WORLD),
            (ImuFrame(body_from_imu, NWU, f"with a heading that counts from north, {placement}"), IMU_OTHERWISE),
        ]
        if not np.allclose(body_from_imu, np.eye(3)):
            note = "as the body, despite its transform"
            frames.append((ImuFrame(np.eye(3), IMU_ENU, note), IMU_IN_OTHER_WORLD))
        if self._gravity is not None:
            frames.append((ImuFrame(body_from_imu @ FLU_FROM_FRD, IMU_ENU, f"turned over, {placement}"), IMU_OTHERWISE))
        return frames

    def _imu_prior(self, frame: ImuFrame, prior: float, z_down: bool) -> float:
        """Return the log odds of an IMU frame, with those of the body's axes under it and of gravity.

        prior: log odds of the frame's frequency. z_down: whether the body is z down under the frame.
        """
        if z_down and frame.world == IMU_NED and np.array_equal(frame.rotation_body_from_imu, self._body_from_imu):
            prior = 0.0  # world of a vehicle that is z down
        elif z_down:
            prior += IMU_IN_OTHER_WORLD
        if z_down != self._says_z_down:
            is_placed = self._imu_placed is not None or self._dvl_placed is not None
            prior += BASE_Z_DOWN if is_placed else UNPLACED_BASE_Z_DOWN
        if self._gravity is not None:
            wrong = self._gravity.contradicts(frame.rotation_body_from_imu, frame.world, z_down)
            prior += (0.0, GRAVITY_CONTRADICTS, GRAVITY_INVERTED)[wrong]
        return prior

    def _body_is_z_down(self, frame: ImuFrame) -> bool:
        """Return whether the body's z points down under a hypothesis of the IMU, by its attitude."""
        if self._mean_rotation is None:
            return self._says_z_down
        up = ENU_FROM[frame.world][2] @ self._mean_rotation
        return bool(up @ frame.rotation_body_from_imu.T[:, 2] < 0.0)

    @cached_property
    def _mean_rotation(self) -> Array | None:
        """Mean (3, 3) of the IMU's rotation matrices, its world from its axes; None without an attitude."""
        assert self._imu is not None
        quaternion = unit_quaternions(self._imu.values[:, :4])
        known = np.isfinite(quaternion).all(axis=1)
        return rotation_from_quaternion(quaternion[known]).mean(axis=0) if known.any() else None

    def dvl_is_turned(self, z_down: bool) -> bool:
        """Return whether frame, transform and type declare DVL axes that must be converted to those of base_frame."""
        parameters, frame_id = self._parameters, self._dvl.frame_id.lower()
        if parameters.dvl_axes != FROM_MESSAGE:
            return (parameters.dvl_axes == FRD) != z_down
        if frame_id.endswith(("_frd", "_flu")):
            return frame_id.endswith("_frd") != z_down
        # a transform with z down describes the driver's own axes instead of REP-103's
        placed = self._dvl_placed
        driver_axes = placed is not None and placed.rotation[2, 2] < 0.0 and "mounting_rpy" not in self._given
        return VELOCITY_TYPES[self._dvl.msgtype].is_turned(self._dvl.frame_id) and not driver_axes and not z_down

    @property
    def _dvl_axes_are_said(self) -> bool:
        return self._parameters.dvl_axes != FROM_MESSAGE or self._dvl.frame_id.lower().endswith(("_frd", "_flu"))

    def _reference_priors(self, reference: Preview, imu: ImuHypothesis | None, rates: Array | None) -> dict[str, float]:
        """Return the log odds of the frames that a reference may be in, by name. rates: see `_points_down`."""
        z_down = self._says_z_down if imu is None else imu.z_down
        own_axes, other_axes = (FRD, FLU) if z_down else (FLU, FRD)
        declared = declared_reference(reference, self._parameters, self._base_frame)
        if declared is not None:
            declared = declared.in_base(own_axes)
            if self._parameters.gnss_frame != FROM_FRAME_ID:
                return {declared.name: 0.0}
        names = ["enu", "body", other_axes, "ned", NWU]
        if declared is None:
            priors = {name: UNDECLARED.get(name, OTHER_WORLD) for name in names}
        else:
            is_in_body = declared.frame is VelocityFrame.BODY
            other_axes_prior = TWIST_IN_ROS_AXES if z_down else REFERENCE_AXES_OTHER
            other = {"body": REFERENCE_AXES_OTHER, other_axes: other_axes_prior} if is_in_body else {}
            priors = {name: other.get(name, REFERENCE_FRAME_OTHER) for name in names} | {declared.name: 0.0}
        observed = twist_axes(reference)
        if observed is not None:
            agreeing = "body" if observed == own_axes else observed
            return {name: prior + TWIST_POSE_OTHER for name, prior in priors.items()} | {agreeing: 0.0}
        if not z_down and (declared is None or declared.frame is not VelocityFrame.BODY):
            is_frd = self._points_down(reference, imu, rates)
            priors["body" if is_frd else FRD] += TWIST_RATES_OTHER
        return priors

    def _points_down(self, reference: Preview, imu: ImuHypothesis | None, imu_rates: Array | None) -> bool:
        """Return whether a twist is forward-right-down, by its turn rates or else by its pose's world.

        imu_rates: (N, 3) rad/s of the IMU at the reference's times, its own axes; None unless both have rates.
        """
        if imu is not None and imu_rates is not None and reference.rates is not None:
            is_frd = are_rates_frd(reference.rates, imu_rates @ imu.frame.rotation_body_from_imu.T)
            if is_frd is not None:
                return is_frd
        world = frame_named(reference.world, ())  # of the pose: by custom a body in NED is forward-right-down
        return reference.world != reference.frame_id and world is not None and world.frame is VelocityFrame.NED

    def choose(
        self, readings: Readings, reference: Preview, mounting: Array | None, arm_is_known: bool
    ) -> FrameChoice | None:
        """Return the most likely reading; None if none can be evaluated.

        mounting: rotation_dvl_from_body (3, 3), None if unknown. arm_is_known: whether transforms define the lever arm.
        """
        hypotheses = self._hypotheses(reference)
        found = readings.agreements(list(hypotheses), mounting)
        declared_frame = declared_reference(reference, self._parameters, self._base_frame)
        in_earth = declared_frame is not None and declared_frame.frame is not VelocityFrame.BODY
        if not found or (in_earth and all(agreement.reading.in_body for agreement in found)):
            return None  # without an attitude the declaration cannot be tested and is kept
        candidates = [_Tried(agreement, mounting, hypotheses[agreement.reading].prior) for agreement in found]
        if mounting is not None:  # or the mounting is wrong, and the DVL's axes are as declared
            declared = [reading for reading, assumed in hypotheses.items() if assumed.turned_as_declared]
            candidates += [
                _Tried(agreement, None, hypotheses[agreement.reading].prior + MOUNTING_OTHER)
                for agreement in readings.agreements(declared, None)
                if angle_between(agreement.rotation_dvl_from_body, mounting) > TURNED_FROM
            ]
        first_odds = {
            tried: tried.odds(tried.agreement.rotation_dvl_from_body) + readings.log_likelihood(tried.residual)
            for tried in candidates
        }
        ranked = sorted(candidates, key=lambda tried: -first_odds[tried])
        reasons: tuple[Reason, ...] = ()
        if in_earth:
            first_best = ranked[0].agreement
            if first_best.reading.in_body and not readings.is_in_body(first_best):
                reasons = (finding("BODY_OR_EARTH"),)
                ranked = [candidate for candidate in ranked if not candidate.reading.in_body] or ranked
        likely = [tried for tried in ranked if first_odds[tried] > first_odds[ranked[0]] - FAR_WORSE][:MOST_REGISTERED]
        most_expected = max(ranked, key=lambda tried: tried.prior)
        if most_expected not in likely:
            likely.append(most_expected)
        if likely == [most_expected] and most_expected.mounting is mounting:
            return FrameChoice(most_expected.agreement, hypotheses[most_expected.reading].imu, reasons)
        fits = {candidate: readings.registered(candidate.reading, candidate.mounting) for candidate in likely}
        odds = {
            tried: tried.odds(fit.rotation_dvl_from_body)
            + (_arm_odds(fit) if arm_is_known else 0.0)
            + readings.log_likelihood_registered(fit.residual)
            for tried, fit in fits.items()
        }
        if math.inf in (fit.residual for fit in fits.values()):  # a failed registration is no evidence
            odds = first_odds
            fits = {
                tried: fit._replace(rotation_dvl_from_body=tried.agreement.rotation_dvl_from_body)
                for tried, fit in fits.items()
            }
        best, *others = sorted(likely, key=lambda tried: -odds[tried])
        imu, best_rotation = hypotheses[best.reading].imu, fits[best].rotation_dvl_from_body
        for rival in (other for other in others if odds[other] > odds[best] - AS_LIKELY):
            best_options = self._options(best.reading, imu)
            rival_options = self._options(rival.reading, hypotheses[rival.reading].imu)
            other_axes = any(best_options[name] != rival_options[name] for name in ("dvl_axes", "base_axes"))
            # in which the IMU's frame affects only the lever arm
            in_body = best.reading.in_body and rival.reading.in_body
            fitted = [best_rotation, fits[rival].rotation_dvl_from_body]
            if other_axes or (not in_body and angle_between(*fitted) > SAME_ANSWER):
                reasons += (_ambiguous(best_options, rival_options, fitted),)
                break
        if (
            mounting is not None
            and best.mounting is None
            and not readings.are_axes_mirrored(best.reading, best_rotation, mounting)
        ):
            rotating_imu = None if best.reading.in_body else imu
            mean = self._dvl.values[np.isfinite(self._dvl.values).all(axis=1)].mean(axis=0)
            travel = FLU_FROM_FRD @ mean if best.reading.turned else mean
            reasons += (_mounting_contradicted(mounting.T, best_rotation.T, rotating_imu, travel),)
        return FrameChoice(best.agreement, imu, reasons)

    def _hypotheses(self, reference: Preview) -> dict[Reading, _Hypothesis]:
        """Return all readings: each frame of the reference, under each hypothesis of the IMU, with either DVL axes."""
        hypotheses: dict[Reading, _Hypothesis] = {}
        imu_rates = None
        if self._imu is not None and reference.rates is not None:
            turns = TurnRates.of(imu_columns_of(self._imu))
            imu_rates = angular_velocity_at(turns, reference.stamps_s, GAP_S)
        for imu in (*self.imus,) or (None,):
            frame, imu_prior = (None, 0.0) if imu is None else (imu.frame, imu.prior)
            declared = self.dvl_is_turned(self._says_z_down if imu is None else imu.z_down)
            for name, prior in self._reference_priors(reference, imu, imu_rates).items():
                for is_turned in {declared} if self._dvl_axes_are_said else {declared, not declared}:
                    axes_prior = 0.0 if is_turned == declared else DVL_AXES_OTHER
                    reading = Reading(name, frame, is_turned)
                    hypotheses[reading] = _Hypothesis(prior + imu_prior + axes_prior, imu, is_turned == declared)
        return hypotheses

    def _options(self, reading: Reading, imu: ImuHypothesis | None) -> dict[str, str]:
        """Return a reading as values of parameters."""
        z_down = self._says_z_down if imu is None else imu.z_down
        return {
            "base_axes": FRD if z_down else FLU,
            "gnss_frame": reading.reference,
            "dvl_axes": FRD if reading.turned != z_down else FLU,
            "imu_frame": IMU_ENU if imu is None else imu.frame.world,
        }


def _ambiguous(taken: dict[str, str], other: dict[str, str], turns: Sequence[Array]) -> Reason:
    """Return the finding of two readings, as values of parameters, with the question that decides between them.

    turns: rotation_dvl_from_body (3, 3) of each, which are named if nothing else differs.
    """
    differing = [name for name in taken if taken[name] != other[name]]
    if not differing:
        differing = ["mounting_rpy"]
        taken, other = ({"mounting_rpy": as_option(nominal_rpy(turn.T))} for turn in turns)
    texts = [" with ".join(f"{name} {these[name]}" for name in differing) for these in (taken, other)]
    parameter, value = differing[0], other[differing[0]]
    asking = {"what": ASKED.get(parameter, "the mounting"), "axes": AXES.get(value, value), "parameter": parameter}
    return finding("FRAMES_AMBIGUOUS", taken=texts[0], other=texts[1], first=taken[parameter], value=value, **asking)


def _mounting_contradicted(given: Array, found: Array, imu: ImuHypothesis | None, travel: Array) -> Reason:
    """Return the finding that another mounting fits; its remedy also names a heading offset or axes that look the same.

    given, found: (3, 3) rotation_body_from_dvl.
    imu: by which the reference is turned into the body, None for none.
    travel: (3,) m/s, mean velocity in the DVL. It is ahead with `given` if the heading is wrong, else with `found`.
    """
    rpy, fitting = rpy_from_rotation(given), nominal_rpy(found)
    first = addition = ""
    about_z = fitting[2] - float(rpy[2])
    is_drawn = abs(math.remainder(about_z, DRAWN)) < NOMINAL_TOL_RAD[2]
    if imu is not None and not is_drawn and np.allclose(fitting[:2], rpy[:2], atol=NOMINAL_TOL_RAD[0]):
        offset = math.degrees(imu.frame.heading_offset + math.remainder(-about_z if imu.z_down else about_z, math.tau))
        declination = f"set the declination of the compass, here -p heading_offset:={offset:.4g}deg"
        if (given @ travel)[0] > (found @ travel)[0]:
            first = f"{declination}; if the heading is right, "
        else:
            addition = f"; if the mounting is right, {declination}"
    same_axes = np.diag(given.T @ found)
    if np.abs(same_axes).min() > math.cos(TURNED_FROM):  # a half turn
        negated = " and ".join(axis for axis, share in zip("xyz", same_axes, strict=True) if share < 0.0)
        addition = f", or, if that mounting is right, negate {negated} in the DVL's driver"
    values = {"given": in_degrees(rpy), "found": in_degrees(fitting), "option": as_option(fitting)}
    return finding("MOUNTING_CONTRADICTED", **values, first=first, also=addition)


def _arm_odds(fit: Registered) -> float:
    """Return the log odds of a fit's lever arm, if transforms define another."""
    variance = ARM_STD_M**2 + fit.arm_std**2
    return -0.5 * min(float((fit.arm**2 / variance).sum()), MOST_OF_ARM)


def declared_reference(reference: Preview, parameters: Parameters, base_frame: str) -> DeclaredFrame | None:
    """Return the frame that a reference declares; None if none."""
    return declared_frame(VELOCITY_TYPES[reference.msgtype], reference.frame_id, parameters, base_frame)


def twist_axes(preview: Preview) -> str | None:
    """Return the frame of an odometry's twist by the motion of its pose, as gnss_frame; None if not observable.

    Its pose p, R moves by the twist v: dp = R v dt if v is in the axes of the pose's body.
    """
    if preview.pose is None or not len(preview.pose):
        return None
    quaternion = unit_quaternions(preview.pose[:, 3:])
    known = np.isfinite(quaternion).all(axis=1) & np.isfinite(preview.values).all(axis=1)
    times, position, velocity = preview.stamps_s[known], preview.pose[known, :3], preview.values[known]
    if len(times) < 2:
        return None
    rotation = rotation_from_quaternion(quaternion[known])
    after = np.searchsorted(times, times + POSE_STEP_S)
    before = np.flatnonzero((after < len(times)) & (times[np.minimum(after, len(times) - 1)] - times < POSE_LONGEST_S))
    after = after[before]
    if not len(before):
        return None
    seconds = (times[after] - times[before])[:, None]
    pose_velocity = (position[after] - position[before]) / seconds
    intervals = np.diff(times, prepend=times[0])[:, None]

    def residual(velocities: Array) -> float:
        path = np.cumsum(0.5 * intervals * (velocities + np.roll(velocities, 1, axis=0)), axis=0)
        return float(np.sqrt((((path[after] - path[before]) / seconds - pose_velocity) ** 2).sum(axis=1).mean()))

    in_body_axes = {name: np.einsum("nij,nj->ni", rotation, velocity @ axes) for name, axes in _BODY_AXES.items()}
    hypotheses = {**in_body_axes, "enu": velocity, "ned": velocity @ ENU_FROM_NED}
    residuals = {name: residual(velocities) for name, velocities in hypotheses.items()}
    best, second = sorted(residuals, key=residuals.__getitem__)[:2]
    if residuals[best] > MAX_RESIDUAL * preview.speed or residuals[best] > BETTER_BY * residuals[second]:
        return None
    world = frame_named(preview.world, ())
    in_ned = world is not None and world.frame is VelocityFrame.NED
    if best in _BODY_AXES:
        body_down = (float(rotation[:, 2, 2].mean()) < 0.0) != in_ned
        return FRD if body_down != (best == FRD) else FLU
    return best if not in_ned else {"enu": "ned", "ned": "enu"}[best]


_BODY_AXES = {FLU: np.eye(3), FRD: FLU_FROM_FRD}
