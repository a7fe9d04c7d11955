"""Discovery of topics, mounting, lever arm and frames in a recording, so that a calibration needs no options.

Values set by the user are always kept. Discovered values are reported with their source.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.models.parameters import FLU, FRD, FROM_FRAME_ID, FROM_MESSAGE, FROM_REFERENCE, TOLD, Parameters
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, rotation_from_rpy, rpy_from_rotation
from ..calibration.numerics.robust import median
from ..calibration.numerics.samples import VelocityFrame
from ..calibration.registration.configuration_check import BETTER_BY
from ..calibration.registration.frame_hypotheses import (
    MAX_RESIDUAL,
    Agreement,
    ImuFrame,
    Readings,
    best_rotation,
    nominal_rpy,
)
from ..calibration.registration.gauss_newton import white_noise
from ..calibration.streams.screening import NOT_MEASURED_VARIANCE
from ..errors import InputError
from ..messages.decode import DECLARED_FRAMES, EARTH_FRAMES, DeclaredFrame, frame_named, turns_dvl
from ..messages.drivers import VELOCITY_TYPES
from ..recordings.recording import Recording, open_recording
from ..recordings.topic_messages import Preview, Survey
from ..recordings.topics import NONE, ORIENTATION, Topics
from ..verdict.reasons import Reason, finding
from . import topic_choice
from .axis_signs import sign_findings
from .discovery import (
    Discovery,
    Given,
    as_option,
    clocks_of_recording,
    compared_motion,
    difference_of,
    in_time_of,
    mounting_guessed,
    on_imu_clock,
)
from .frame_choice import AXES, FrameChooser, declared_reference
from .gravity import believed_heading, contradictions
from .transforms import FrameTree, Placed, in_degrees, in_metres

# a smaller rotation in the data is a misalignment to calibrate; a larger one is another mounting
OTHER_MOUNTING = math.radians(12.0)
# smallest ratio of mean velocity to speed for a vehicle that drives ahead
STRAIGHT_SHARE = 0.7
# rms of the smaller nine tenths of normal errors on three axes, as a share of the full rms
TRIMMED = 0.85
# Smallest noise (m/s) of any reference, and the factors by which a reference may claim too much or too little, judged
# by its differences between samples; below the rate (Hz) these contain waves.
QUIETEST, CLAIMS_TOO_MUCH, CLAIMS_TOO_LITTLE, WHITE_FROM_HZ = 0.01, 3.0, 2.0, 3.0
# Factor for a reference of velocities: beyond it the agreement would be rejected as implausible
# (verification.IMPLAUSIBLE). A filter that uses the DVL also agrees that well, but its noise between samples is no
# larger; a reference noisier by the second factor is independent.
CLAIMS_FAR_TOO_MUCH, NOISIER = 4.0, 1.5
# a DVL's claimed standard deviation from here on is no information, m/s
SAYS_NOTHING = math.sqrt(NOT_MEASURED_VARIANCE)
# Lowest speed (m/s) that is told from standing: five σ of a DVL at low speed, 0.01 m/s by data sheets.
SLOWEST_MPS = 0.05
# of two fitting readings of the DVL's axes, the other is used if its residual is below this share
BETTER = 0.8


def discover(recording: Recording | Sequence[Path], parameters: Parameters, given: Given | None = None) -> Discovery:
    """Discover everything that is not given. Raises InputError for named topics that do not exist."""
    if not isinstance(recording, Recording):
        recording = open_recording(recording, parameters=parameters)
    if not recording.types:
        raise InputError(f"{recording.where}: the bag is empty, it has no topics; record it again")
    named = given or Given()
    found = _Search(recording.survey, parameters, named, recording.where).run()
    if found.topics.gnss not in recording.types and not found.contradictions:
        surveys = [part.whole(found.topics) for part in recording.each]
        signs = sign_findings(surveys, found.topics, found.parameters, "dvl_axes" in named.parameters)
        return replace(found, contradictions=tuple(signs))
    clocks = clocks_of_recording(recording, found, named)
    if clocks is None:
        return found
    if clocks.registration.offsets:
        # finding frames needs velocities of the same time
        survey = on_imu_clock(recording, found.topics, clocks.registration)
        survey = replace(survey, topics=recording.survey.topics, counts=recording.survey.counts)
        topics = found.topics
        imu = topics.imu if topics.imu in survey.topics else named.imu_topic
        all_named = replace(named, dvl_topic=topics.dvl, gnss_topic=topics.gnss, imu_topic=imu)
        second = _Search(survey, parameters, all_named, recording.where).run()
        if second.values != found.values:
            found, clocks = second, clocks_of_recording(recording, second, named) or clocks
        else:
            found = second
    clocks_given = {name: getattr(parameters, name) for name in clocks.offsets}
    return replace(
        found,
        parameters=found.parameters.replace(**{name: clocks_given[name] + s for name, s in clocks.offsets.items()}),
        found=(*found.found, *clocks.says()),
        contradictions=(*found.contradictions, *([clocks.doubt] if clocks.doubt else [])),
        clocks=clocks,
        clocks_given=clocks_given,
    )


class _Search:
    """One search; the findings are collected in attributes."""

    def __init__(self, survey: Survey, parameters: Parameters, given: Given, where: str) -> None:
        """Read the transforms. given: what the user set. where: name of the recording in messages."""
        self._survey, self._parameters, self._given, self._where = survey, parameters, given, where
        used = parameters.use_transforms
        self._tree = FrameTree.of(survey.transforms if used else (), survey.descriptions if used else ())
        self._values: dict[str, Any] = {}
        self._found: list[str] = []
        self._notes: list[Reason] = list(self._tree.problems)
        self._contradictions: list[Reason] = []
        self._mounting_because = ""
        self._chosen: Agreement | None = None
        self._readings: Readings  # of DVL and reference, set when they are compared

    def run(self) -> Discovery:
        """Choose topics, then the frames of the DVL, if it has data."""
        topics = self._choose_topics()
        previews = self._survey.previews
        dvl, reference, imu = previews.get(topics.dvl), previews.get(topics.gnss), previews.get(topics.imu)
        if dvl is not None:
            self._choose_frames(dvl, *(in_time_of(dvl, preview, self._parameters) for preview in (reference, imu)))
        self._found.insert(0, self._describe_topics(topics))
        return Discovery(
            topics,
            self._parameters.replace(**self._values),
            tuple(self._found),
            tuple(self._notes),
            tuple(self._contradictions),
            dict(self._values),
            self._chosen,
            self._reference_frame(reference),
            self._knows_imu(imu),
            mounting_because=self._mounting_because,
        )

    def _choose_topics(self) -> Topics:
        """Choose the three topics: given ones, otherwise by type, name and motion."""
        given, default = self._given, Topics()
        dvl = self._checked("dvl", given.dvl_topic) or topic_choice.choose_dvl(self._survey, default.dvl, self._where)
        self._notes += topic_choice.other_dvls(self._survey, dvl, difference_of)
        gnss, imu = self._checked("gnss", given.gnss_topic), self._checked("imu", given.imu_topic)
        if gnss is None:
            gnss, notes = topic_choice.choose_reference(self._survey, default.gnss, dvl, difference_of)
            self._notes += notes
        gnss = gnss or default.gnss
        imu = imu or topic_choice.choose_imu(self._survey, default.imu, gnss) or default.imu
        if imu.endswith(ORIENTATION) and imu in self._survey.topics:
            self._found.append(
                f"no IMU gives an attitude; it is the orientation of {imu.removesuffix(ORIENTATION)}, and turn rates "
                "are its derivative"
            )
        return Topics(dvl, gnss, imu)

    def _checked(self, role: str, name: str | None) -> str | None:
        """Return a named topic if the recording has it with a usable type, or NONE. Raises InputError."""
        if name is None or (name == NONE and role != "dvl"):
            return name
        return topic_choice.checked_topic(role, name, self._survey, self._where)

    def _describe_topics(self, topics: Topics) -> str:
        """Describe the chosen topics with type, frame and rate, for the first line of the output."""
        parts = []
        for role, name in (("DVL", topics.dvl), ("reference", topics.gnss), ("IMU", topics.imu)):
            kind = self._survey.topics.get(name)
            if kind is None:
                parts.append(f"no {role}")
                continue
            preview = self._survey.previews.get(name)
            rate = f", {preview.rate_hz:.3g} Hz" if preview is not None and preview.rate_hz else ""
            frame = ""
            if role == "reference" and preview is not None:
                chosen = self._values.get("gnss_frame") or self._parameters.gnss_frame
                declared = self._declared_reference(preview)
                if chosen == FROM_FRAME_ID:
                    chosen = "" if declared is None else declared.name
                frame = f", {chosen}" if chosen else ""
            parts.append(f"{role} {name} ({kind.split('/')[-1]}{frame}{rate})")
        return "; ".join(parts)

    def _is_given(self, name: str) -> bool:
        return name in self._given.parameters

    def _choose_frames(self, dvl: Preview, reference: Preview | None, imu: Preview | None) -> None:
        """Choose mounting, axes and frames from transforms, motion and gravity; note what was found."""
        placed = self._place_dvl(dvl)
        mounting = self._parameters.rotation_dvl_from_body.T if self._is_given("mounting_rpy") else None
        if mounting is None and placed is not None:
            mounting = placed.rotation
        imu_placed = None if imu is None else self._tree.placed(imu.frame_id, self._parameters.base_frame)
        if placed is None and imu_placed is not None:
            self._use_base(imu_placed.base)
        base = self._values.get("base_frame", self._parameters.base_frame)
        frames = FrameChooser(self._parameters, self._given.parameters, base, dvl, placed, imu, imu_placed)
        chosen = None
        if dvl.claimed_std >= SAYS_NOTHING and not self._is_given("use_message_covariance"):
            self._values["use_message_covariance"] = False
            self._found.append(
                f"the DVL claims {dvl.claimed_std:.2g} m/s in every message, which is no information and not used "
                "(-p use_message_covariance:=false)"
            )
        self._lower_min_speed(dvl)
        if reference is not None and (motion := compared_motion(dvl, reference, imu)) is not None:
            position = np.zeros(3) if placed is None else placed.position - self._reference_position(reference)
            self._readings = Readings(motion, position)
            is_known = _is_located(placed) and self._known_reference_position(reference) is not None
            chosen = frames.choose(self._readings, reference, None if mounting is None else mounting.T, is_known)
        imu_choice = frames.imu if chosen is None else chosen.imu
        self._use_base_axes(imu_choice is not None and imu_choice.z_down)
        is_turned = frames.dvl_is_turned(self._is_z_down)
        if chosen is not None and reference is not None:
            agreement = self._chosen = chosen.agreement
            is_turned = agreement.reading.turned
            self._contradictions += chosen.says
            self._use_reading(agreement, mounting, reference, imu)
            self._measure_noise(agreement, mounting, dvl, reference)
        elif reference is None:
            self._mounting_from_motion(dvl, is_turned, mounting)
        if imu_choice is not None:
            self._use_imu(imu_choice.frame)
        parameters = self._parameters.replace(base_axes=FRD if self._is_z_down else FLU)
        if parameters.dvl_axes == FROM_MESSAGE and is_turned != turns_dvl(
            VELOCITY_TYPES[dvl.msgtype], dvl.frame_id, parameters
        ):
            axes = self._values["dvl_axes"] = FRD if is_turned != self._is_z_down else FLU
            self._found.append(f"the DVL's data are used as {AXES[axes]} (dvl_axes {axes})")
        if mounting is not None and not self._is_given("mounting_rpy"):
            self._values["mounting_rpy"] = tuple(rpy_from_rotation(mounting).tolist())
        if placed is not None and placed.source:
            self._place_lever_arm(placed, reference)
        if reference is not None and not (_is_located(placed) or self._is_given("lever_arm")):
            self._found.append(
                f"lever arm {in_metres(self._parameters.lever_arm)} m: no transform of {dvl.frame_id!r} has the "
                "position of the DVL; half a metre changes the yaw by tenths of a degree (-p lever_arm:=[x,y,z])"
            )
        self._set_position(placed, reference)
        if imu is not None:
            self._use_claimed_heading(imu)
            parameters = self._parameters.replace(**self._values)
            self._contradictions += contradictions(imu.topic, imu.values[:, :4], imu.values[:, 7:], parameters)

    def _lower_min_speed(self, dvl: Preview) -> None:
        """Set min_speed of a vehicle that mostly moves more slowly than the default."""
        speed = np.linalg.norm(dvl.values, axis=1)
        moving = speed[speed > SLOWEST_MPS]
        typical = float(median(moving)) if len(moving) else math.inf
        if self._is_given("min_speed") or typical > self._parameters.min_speed:
            return
        self._values["min_speed"] = SLOWEST_MPS
        self._found.append(
            f"the vehicle moves at {typical:.2g} m/s: samples from {SLOWEST_MPS:g} m/s on are used "
            f"(-p min_speed:={SLOWEST_MPS:g})"
        )

    @property
    def _is_z_down(self) -> bool:
        return str(self._values.get("base_axes", self._parameters.base_axes)) == FRD

    def _use_base_axes(self, z_down: bool) -> None:
        """Set base_axes if base_frame is forward-right-down and the user did not set them."""
        if z_down and not self._parameters.is_z_down:
            self._values["base_axes"] = FRD
            base = self._values.get("base_frame", self._parameters.base_frame)
            self._found.append(
                f"{base} is forward-right-down by the IMU's attitude and its transform: mounting and "
                "lever arm are in these axes (base_axes frd)"
            )

    def _use_claimed_heading(self, imu: Preview) -> None:
        """Set the heading accuracy that the IMU claims."""
        std = believed_heading(imu.claimed_std)
        if self._is_given("heading_deviation_std") or std is None:
            return
        self._values["heading_deviation_std"] = std
        self._found.append(
            f"the IMU claims a heading good to ±{math.degrees(imu.claimed_std):.2g}°, which is used "
            f"(-p heading_deviation_std:={std:.2g})"
        )

    def _set_position(self, placed: Placed | None, reference: Preview | None) -> None:
        """Set the knowledge about the DVL's position in the body, which needs more than the lever arm."""
        if self._is_given("dvl_position"):
            return
        is_known = _is_located(placed) and not self._is_given("lever_arm")
        reference_position = None if reference is None else self._known_reference_position(reference)
        if self._is_given("reference_position"):
            reference_position = np.array(self._parameters.reference_position)
        if reference_position is not None and reference is not None:
            self._values["dvl_position"] = FROM_REFERENCE
            if reference_position.any() and not self._is_given("reference_position"):
                self._values["reference_position"] = tuple((reference_position + 0.0).tolist())
        elif is_known:
            self._values["dvl_position"] = TOLD

    def _known_reference_position(self, reference: Preview) -> Array | None:
        """Return the position of the reference point in the body; None if unknown."""
        placed = self._tree.placed(reference.frame_id, self._parameters.base_frame)
        if placed is not None and _is_located(placed):
            return placed.position
        base = self._parameters.base_frame
        named = frame_named(reference.frame_id, (base, self._values.get("base_frame", base)))
        in_body = self._reference_frame(reference) is VelocityFrame.BODY
        says_body = named is not None and named.frame is VelocityFrame.BODY
        return np.zeros(3) if in_body and says_body else None

    def _place_dvl(self, dvl: Preview) -> Placed | None:
        """Return the DVL's mounting by transforms; with an unknown frame, by a frame whose name indicates a DVL."""
        base_frame = self._parameters.base_frame
        frame = self._parameters.dvl_frame or dvl.frame_id
        if self._is_body_or_earth(dvl.frame_id) and not self._parameters.dvl_frame:
            self._values["dvl_frame"] = dvl.frame_id
            self._contradictions.append(finding("DVL_FRAME_NOT_OWN", topic=dvl.topic, frame=dvl.frame_id))
        placed = self._tree.placed(frame, base_frame)
        if placed is None and not self._is_body_or_earth(frame):
            likely_frame = self._tree.only_named_like(topic_choice.DVL_WORDS)
            placed = None if likely_frame is None else self._tree.placed(likely_frame, base_frame)
            if placed is not None:
                self._notes.append(finding("FRAME_NOT_IN_TREE", frame=frame, other=placed.frame))
        if placed is not None:
            self._use_base(placed.base)
        return placed

    def _use_base(self, base: str) -> None:
        if base != self._parameters.base_frame.strip("/") and not self._is_given("base_frame"):
            self._values["base_frame"] = base

    def _is_body_or_earth(self, frame_id: str) -> bool:
        name = frame_id.strip("/")
        return name == self._parameters.base_frame.strip("/") or name.lower() in EARTH_FRAMES

    def _declared_reference(self, reference: Preview) -> DeclaredFrame | None:
        base = self._values.get("base_frame", self._parameters.base_frame)
        return declared_reference(reference, self._parameters, base)

    def _reference_frame(self, reference: Preview | None) -> VelocityFrame | None:
        """Return the assumed frame of the reference; None without one, or if unknown."""
        if reference is None:
            return None
        chosen_name = self._values.get("gnss_frame")
        declared = self._declared_reference(reference) if chosen_name is None else DECLARED_FRAMES[chosen_name]
        return None if declared is None else declared.frame

    def _knows_imu(self, imu: Preview | None) -> bool:
        """Return whether the IMU's orientation in the body is known: by a transform, or DVL and reference agree."""
        if imu is None:
            return False
        placed = self._tree.placed(imu.frame_id, self._parameters.base_frame)
        if placed is not None and placed.source:
            return True
        fit = self._chosen  # a reference in the body frame agrees regardless of the IMU
        return fit is not None and not fit.reading.in_body and fit.best_residual < MAX_RESIDUAL

    def _use_reading(self, chosen: Agreement, mounting: Array | None, reference: Preview, imu: Preview | None) -> None:
        """Write the frames and mounting of a reading into the parameters.

        mounting: rotation_body_from_dvl (3, 3) from transforms or parameters, None if unknown.
        """
        reading, parameters = chosen.reading, self._parameters
        declared = self._declared_reference(reference)
        if declared is not None:
            declared = declared.in_base(FRD if self._is_z_down else FLU)
        chosen_frame = DECLARED_FRAMES[reading.reference]
        # without an attitude only the body frame could be tried
        if imu is None and declared is None and chosen.best_residual >= MAX_RESIDUAL:
            self._notes.append(finding("REFERENCE_FRAME_NOT_TOLD", topic=reference.topic))
        elif chosen_frame != declared:
            name = self._values["gnss_frame"] = chosen_frame.name
            if declared is None:
                self._found.append(
                    f"the reference is used as {name}, which fits best; its frame {reference.frame_id!r} does not "
                    f"define it (-p gnss_frame:={name})"
                )
            else:
                frame = {"frame": reference.frame_id, "declared": declared.name, "taken": name}
                self._contradictions.append(finding("REFERENCE_FRAME_OTHER", topic=reference.topic, **frame))
        elif declared is not None and parameters.gnss_frame == FROM_FRAME_ID and "base_frame" in self._values:
            self._values["gnss_frame"] = declared.name
        if mounting is None and chosen.angle > OTHER_MOUNTING and chosen.best_residual < MAX_RESIDUAL:
            residual = self._readings.registered(reading, np.eye(3)).residual
            turned_residual, rotation, *_ = self._readings.registered(reading, None)
            if self._readings.without_noise(turned_residual) < BETTER_BY * self._readings.without_noise(residual):
                why = "where DVL and reference agree best"
                rotation = self._readings.without_roll(chosen, rotation)
                rpy = nominal_rpy(rotation.T)
                # a roll that is hardly observable on a level vehicle is set to zero, unless the data need it
                level = (0.0, *rpy[1:])
                level_residual, *_ = self._readings.registered(reading, rotation_from_rpy(level).T)
                self._mounting_found(level if BETTER * level_residual <= turned_residual else rpy, why)

    def _measure_noise(self, chosen: Agreement, mounting: Array | None, dvl: Preview, reference: Preview) -> None:
        """Set the noise of a reference that claims none, far too little, or more than its velocities show.

        mounting: rotation_body_from_dvl (3, 3) from transforms or parameters, None if unknown.
        """
        if self._is_given("gnss_aided_std") or self._is_given("use_message_covariance"):
            return
        says_nothing = "use_message_covariance" in self._values
        if self._readings.without_noise(chosen.best_residual) > MAX_RESIDUAL:
            return
        is_position = VELOCITY_TYPES[reference.msgtype].position is not None
        measured_std = math.sqrt(white_noise(reference.values)) if reference.rate_hz > WHITE_FROM_HZ else 0.0
        too_little = not is_position and measured_std > CLAIMS_TOO_LITTLE * reference.claimed_std
        # part of it is due to lever arm and delay, which are estimated later
        least = 0.5 * chosen.best_residual
        per_axis = dvl.speed / (math.sqrt(3.0) * TRIMMED)
        claims = [reference.claimed_std] if is_position else [reference.claimed_std, dvl.claimed_std]
        claimed = math.hypot(*np.nan_to_num(claims))  # both are part of the predicted residual
        most = claimed / (CLAIMS_TOO_MUCH if is_position else CLAIMS_FAR_TOO_MUCH)
        may_claim_less = is_position or says_nothing or measured_std > NOISIER * math.sqrt(white_noise(dvl.values))
        claims_none = math.isnan(reference.claimed_std)
        if not (
            too_little or claims_none or says_nothing or (may_claim_less and most > max(least * per_axis, QUIETEST))
        ):
            return
        best, *_ = self._readings.registered(chosen.reading, None if mounting is None else mounting.T)
        noise = max(max(min(best, chosen.best_residual), least) * per_axis, QUIETEST)
        too_much = may_claim_less and most > noise
        if not (too_much or too_little or claims_none or says_nothing):
            return
        if too_much or too_little:
            self._values["use_message_covariance"] = False
        self._values["gnss_aided_std"] = float(f"{noise:.2g}")
        whose = "DVL and reference claim" if too_much and not is_position else "the reference claims"
        size = "no noise" if claims_none or not claimed else f"{claimed if too_much else reference.claimed_std:.2g} m/s"
        self._found.append(
            f"{whose} {size}; against the DVL it shows {noise:.2g} m/s per axis, which is used "
            f"(-p gnss_aided_std:={noise:.2g})"
        )

    def _use_imu(self, frame: ImuFrame) -> None:
        """Set the IMU's orientation and world frame as chosen, unless given or default."""
        if self._is_given("imu_rpy") or self._is_given("imu_frame"):
            return
        rpy = tuple((rpy_from_rotation(frame.rotation_body_from_imu) + 0.0).tolist())
        if np.allclose(rpy, 0.0, atol=1e-9) and frame.world == "enu":
            return
        self._values |= {"imu_rpy": rpy, "imu_frame": frame.world}
        self._found.append(f"the IMU's data are used {frame.says}: imu_rpy {in_degrees(rpy)}, imu_frame {frame.world}")

    def _mounting_found(self, rpy: tuple[float, float, float], why: str) -> None:
        """Use a mounting (rad) found from the data, and note its source; nothing if it is zero."""
        if not any(rpy):
            return
        self._values["mounting_rpy"] = rpy
        self._mounting_because = why
        self._notes.append(mounting_guessed(rpy, why))

    def _mounting_from_motion(self, dvl: Preview, turned: bool, mounting: Array | None) -> None:
        """Guess the mounting without a reference, assuming a vehicle that drives ahead, as the models without GNSS do.

        mounting: rotation_body_from_dvl (3, 3), None if unknown.
        """
        velocity = dvl.values @ FLU_FROM_FRD if turned else dvl.values
        if not len(velocity):
            return
        mean = velocity.mean(axis=0)
        if np.linalg.norm(mean) < STRAIGHT_SHARE * dvl.speed or dvl.speed < topic_choice.MOVES_FROM:
            return
        ahead = np.tile([np.linalg.norm(mean), 0.0, 0.0], (2, 1))
        rotation_dvl_from_body = best_rotation(np.tile(mean, (2, 1)), ahead, np.eye(3))
        yaw = math.atan2(rotation_dvl_from_body[0, 1], rotation_dvl_from_body[0, 0])
        if mounting is not None:
            ahead_in_body = mounting @ mean
            is_sideways = abs(ahead_in_body[1]) > abs(ahead_in_body[0])
            if (is_sideways or ahead_in_body[0] < 0.0) and not self._is_given("mounting_rpy"):
                configured, fits = rpy_from_rotation(mounting) + 0.0, nominal_rpy(rotation_from_rpy((0.0, 0.0, yaw)))
                fields = {"given": in_degrees(configured), "found": in_degrees(fits), "option": as_option(fits)}
                code = "TRAVELS_SIDEWAYS" if is_sideways else "TRAVELS_ASTERN"
                self._contradictions.append(finding(code, also=_other_axes(mounting, mean), **fields))
        elif abs(yaw) > OTHER_MOUNTING:
            self._mounting_found(nominal_rpy(rotation_from_rpy((0.0, 0.0, yaw))), "by the direction of travel")

    def _reference_position(self, reference: Preview) -> Array:
        """Return the position in the body of the point whose velocity the reference measures."""
        placed = self._tree.placed(reference.frame_id, self._parameters.base_frame)
        return np.zeros(3) if placed is None else placed.position

    def _place_lever_arm(self, placed: Placed, reference: Preview | None) -> None:
        """Set the lever arm by the transforms, from the reference's position; note the source."""
        given_mounting = self._is_given("mounting_rpy")
        parts = [] if given_mounting else [f"mounting {in_degrees(rpy_from_rotation(placed.rotation))}"]
        if placed.is_located and not self._is_given("lever_arm"):
            position = placed.position
            if reference is not None:
                position = position - self._reference_position(reference)
            if np.abs(position).max() <= 100.0:  # the parameter's range; a larger value is a transform in another unit
                self._values["lever_arm"] = tuple((position + 0.0).tolist())
                parts.append(f"lever arm {in_metres(position)} m")
        if parts:
            self._found.append(f"{', '.join(parts)}: {placed.frame} in {placed.base}, from {placed.source}")


def _other_axes(rotation_body_from_dvl: Array, mean: Array) -> str:
    """Return the part of a remedy for axes with which a mounting (3, 3) makes a mean velocity (3,) point ahead."""
    min_ahead = math.cos(OTHER_MOUNTING) * float(np.linalg.norm(mean))
    changes = {f"negate {axis}": mean * sign for axis, sign in zip("xyz", 1.0 - 2.0 * np.eye(3), strict=True)}
    changes["swap x and y"] = mean[[1, 0, 2]]
    fitting = [change for change, changed in changes.items() if rotation_body_from_dvl[0] @ changed > min_ahead]
    return f", or, if that mounting is right, {' or '.join(fitting)} in the DVL's driver" if fitting else ""


def _is_located(placed: Placed | None) -> bool:
    """Return whether transforms define the position of a frame in the body."""
    return placed is not None and bool(placed.source) and placed.is_located
