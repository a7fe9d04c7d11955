"""Axes of the DVL without a reference velocity: those of the earth, and the signs of its own.

A current c adds c·ahead to the speed ahead and c·left to the sway. So the current by the sway over all headings
predicts how the speed ahead changes in turns. A mirrored y inverts the prediction. Nothing predicts the sign of z.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..calibration.models.parameters import FLU, FRD, Parameters
from ..calibration.numerics.block_covariance import student_factor
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, rotation_from_rpy
from ..calibration.numerics.robust import robust_std
from ..calibration.numerics.tests import Z_ONE_TEST
from ..calibration.registration.configuration_check import Directions, angle_between
from ..calibration.registration.frame_hypotheses import ImuFrame, least_turn, nominal_rpy
from ..calibration.streams.interpolation import ImuColumns, TurnRates, angular_velocity_at, attitude_at
from ..messages.decode import turns_dvl
from ..messages.drivers import VELOCITY_TYPES
from ..recordings.topic_messages import Survey
from ..recordings.topics import Topics
from ..verdict.reasons import Reason, finding
from .discovery import as_option, imu_columns_of, in_time_of
from .frame_choice import SAME_ANSWER

# Interval over which the speed ahead changes in a turn, s: longer than waves, shorter than a change of throttle.
OVER_S = 4.0
# Longest interpolated gap of an IMU, s; smallest change of the heading in a turn, rad.
GAP_S, TURNED_FROM = 1.0, 0.2
# Fewest turns. σ of the sign is corrected for few turns by Student's t.
FEWEST_TURNS = 5
# Scale of the Cauchy weights, in σ (95 % efficiency), and number of reweighted fits.
CAUCHY, PASSES = 2.385, 10
# Largest misalignment of a mounting that a mirrored axis leaves likely, rad.
LIKELY = math.radians(12.0)
# Words for a motion along the body's y and z, against them and along them, forward-left-up.
WAYS = {1: ("to starboard", "to port"), 2: ("down", "up")}


class SwaySign(NamedTuple):
    """Change of the speed ahead in turns, relative to the prediction by the sway: 1 expected, -1 with y mirrored."""

    slope: float
    std: float
    turns: int

    @property
    def sign(self) -> int:
        """1 or -1 if significant, else 0."""
        if self.turns < FEWEST_TURNS:
            return 0
        least = Z_ONE_TEST * float(student_factor(np.array(self.turns - 1.0))) * self.std
        return int(np.sign(self.slope)) if abs(self.slope) > least else 0


def sway_sign(times: Array, velocity: Array, imu: ImuColumns) -> SwaySign | None:
    """Compare sway and speed ahead in turns; None without turns.

    times: (N,) s. velocity: (N, 3) m/s in the body by the nominal mounting.
    """
    rotation, known = attitude_at(imu, times, GAP_S)
    rates = angular_velocity_at(TurnRates.of(imu), times, GAP_S)
    known = known & np.isfinite(rates).all(axis=1) & np.isfinite(velocity).all(axis=1)
    times, velocity, rate, rotation = times[known], velocity[known], rates[known, 2], rotation[known]
    heading = rotation[:, :2, 0]
    heading = heading / np.maximum(np.linalg.norm(heading, axis=1), 1e-9)[:, None]
    after = np.searchsorted(times, times + OVER_S - 1e-6)
    before = np.flatnonzero(after < len(times))
    after = after[before]
    is_turn = (times[after] - times[before] < 1.5 * OVER_S) & (
        np.linalg.norm(heading[after] - heading[before], axis=1) > TURNED_FROM
    )
    before, after = before[is_turn], after[is_turn]
    if len(before) < FEWEST_TURNS:
        return None
    up = float(np.sign(rotation[:, 2, 2].mean()))
    port = np.column_stack([-heading[:, 1], heading[:, 0]])
    # nuisance: misalignment, lever arm, skid
    sway_columns = np.column_stack([port, velocity[:, 0], rate, rate * velocity[:, 0]])
    current = np.linalg.lstsq(sway_columns, up * velocity[:, 1], rcond=None)[0][:2]
    # nuisance: speed lost in turns, lever arm
    columns = np.column_stack([heading @ current, np.abs(rate), rate])
    change_columns, speed_change = columns[after] - columns[before], velocity[after, 0] - velocity[before, 0]
    weight = np.ones(len(speed_change))
    for _ in range(PASSES):
        covariance = np.linalg.pinv((change_columns * weight[:, None]).T @ change_columns)
        residual = speed_change - change_columns @ (slopes := covariance @ (change_columns.T @ (weight * speed_change)))
        weight = 1.0 / (1.0 + (residual / max(CAUCHY * float(robust_std(residual)), 1e-9)) ** 2)
    turn_number = np.cumsum(np.diff(times[before], prepend=times[before[0]]) > 2.0 * OVER_S)
    n_turns = int(turn_number[-1]) + 1
    scores = np.bincount(turn_number, weight * residual * (change_columns @ covariance[0]), n_turns)
    std = math.sqrt(float((scores**2).sum()) * n_turns / max(n_turns - 1, 1))
    return SwaySign(float(slopes[0]), std, n_turns)


def sign_findings(
    recordings: Sequence[Survey], topics: Topics, parameters: Parameters, axes_are_given: bool
) -> Iterator[Reason]:
    """Yield findings on the DVL's axes: velocity in the earth frame, inverted y, or an unobservable sign of y or z.

    axes_are_given: the user has set dvl_axes, which confirms all signs.
    """
    surveyed = [survey.previews for survey in recordings if topics.dvl in survey.previews]
    if not surveyed:
        return
    first = surveyed[0][topics.dvl]
    is_turned = turns_dvl(VELOCITY_TYPES[first.msgtype], first.frame_id, parameters)
    flu_from_dvl = FLU_FROM_FRD if is_turned else np.eye(3)
    body_from_message = parameters.rotation_dvl_from_body.T @ flu_from_dvl
    frame = ImuFrame(rotation_from_rpy(parameters.imu_rpy), parameters.imu_frame, "")
    sway_signs, directions = [], Directions()
    for previews in surveyed:
        dvl = previews[topics.dvl]
        imu = in_time_of(dvl, previews.get(topics.imu), parameters)
        if imu is not None and imu.has_orientation:
            velocity, read = dvl.values @ body_from_message.T, frame.read(imu_columns_of(imu))
            sway_signs.append(sway_sign(dvl.stamps_s, velocity, read))
            rotation, known = attitude_at(read, dvl.stamps_s, GAP_S)
            directions.add(velocity[known], rotation[known])
    if directions.turn_with_heading:
        yield finding("DVL_TURNS_WITH_HEADING")
        return
    velocities = np.concatenate([previews[topics.dvl].values for previews in surveyed])
    mean_velocity = body_from_message @ velocities[np.isfinite(velocities).all(axis=1)].mean(axis=0)
    ahead = np.array([mean_velocity[0], 0.0, 0.0])
    if math.hypot(mean_velocity[1], mean_velocity[2]) >= math.tan(LIKELY) * abs(mean_velocity[0]):
        return  # no vehicle that travels ahead
    signs = [found for found in sway_signs if found is not None and found.sign]
    axes, other = (FRD, FLU) if is_turned != parameters.is_z_down else (FLU, FRD)
    if signs and all(sign.sign < 0 for sign in signs):
        yield finding("DVL_SIDE_INVERTED", slope=signs[0].slope, std=signs[0].std, axes=other)
        return
    if axes_are_given:
        return
    fitted, flips = least_turn(mean_velocity, ahead) @ body_from_message, 1.0 - 2.0 * np.eye(3)
    for row in (2,) if signs else (1, 2):
        # the axis most along this row of the body; negated, the mirrored mounting fits as well
        shares = np.abs(body_from_message[row]).round(6)
        axis = max(range(3), key=lambda column: (shares[column], column == row))
        mirrored = flips[row][:, None] * fitted * flips[axis]
        change, addition = angle_between(fitted, mirrored), ""
        if change < SAME_ANSWER:
            continue
        effect = f"the {('yaw', 'pitch')[row - 1]} changes by {math.degrees(change):.1f}°"
        if angle_between(mirrored, body_from_message) > LIKELY:
            mounting = as_option(nominal_rpy(mirrored @ flu_from_dvl))
            effect, addition = f"mounting_rpy {mounting} fits", f" and try -p mounting_rpy:={mounting}"
        way = WAYS[row][bool(body_from_message[row, axis] > 0.0) != parameters.is_z_down]
        yield finding("DVL_SIGN_OPEN", axis="xyz"[axis], effect=effect, way=way, axes=axes, also=addition)
