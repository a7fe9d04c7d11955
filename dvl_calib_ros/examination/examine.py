"""Examination of a recording: content, faults, and what its motion makes observable."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..bag_replay.checked_replay import checked_replay
from ..bag_replay.replay import Replayed
from ..calibration.filters.observability import KM, PredictedDrift
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import FLU_FROM_FRD, Array, rotation_from_rpy
from ..calibration.numerics.samples import Stream, VelocityFrame
from ..calibration.numerics.tests import Z_ONE_TEST
from ..calibration.registration.frame_hypotheses import MAX_RESIDUAL
from ..calibration.results.mounting_quantities import Quantity, missing_for, quantities
from ..calibration.results.results import Estimate
from ..calibration.streams.position_velocities import NOISY_MPS
from ..discovery.discover import discover
from ..discovery.discovery import Discovery, Given
from ..errors import InputError
from ..messages.decode import turns_dvl
from ..messages.drivers import VELOCITY_TYPES
from ..messages.positions import SELDOM_S
from ..recordings.recording import Recording, open_recording
from ..recordings.topic_messages import Preview, Recorded
from ..verdict.answering import Answering
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding, full, is_cause
from . import topic_checks

# a reference below this rate (Hz) interpolates turns by straight lines; 1 Hz receivers are a little slow at times
SLOW_REFERENCE = 0.8
# ratios of speeds outside this range mean different units
UNIT_FACTORS = (0.7, 1.4)
UNITS = {
    1000.0: "mm/s",
    100.0: "cm/s",
    1.0 / 0.514444: "knots",
    3.6: "km/h",
    1.0 / 0.3048: "feet/s",
    0.6: "degrees and minutes, ddmm.mmmm, read as degrees",
}
# a vehicle counts as moving if this share of its samples is faster than min_speed
MOVES_SHARE = 0.05


@dataclass(frozen=True)
class Content:
    """A topic that the calibration needs. role: DVL, reference or IMU. frame_id: of its first message."""

    role: str
    topic: str
    msgtype: str
    messages: int
    rate_hz: float
    frame_id: str
    covariance: str


@dataclass(frozen=True, repr=False)
class Examination(Answering):
    """Result of the doctor.

    judged: verdict of a replay, which decides.
    reasons: of that verdict.
    cannot: why there is no replay, else ''.
    """

    paths: tuple[Path, ...]
    seconds: float
    contents: tuple[Content, ...]
    discovery: Discovery
    findings: tuple[Reason, ...]
    speed_mps: float
    shown: tuple[Shown, ...]
    notes: tuple[str, ...]
    judged: Severity
    reasons: tuple[Reason, ...] = ()
    cannot: str = ""

    @property
    def has_reference(self) -> bool:
        """Return whether there is a reference velocity."""
        return any(content.role == "reference" for content in self.contents)

    @property
    def verdict(self) -> str:
        """Fitness for calibration: yes, partly, or no. A rejecting replay means no; yes needs an accepting one."""
        if self.judged is Severity.REJECT:
            return "no"
        # the angles that rotate and lift a track
        needed = [reason for reason in self.shown if reason.name in ("pitch", "yaw")]
        all_shown = bool(needed) and not any(reason.needs for reason in needed)
        return "yes" if self.judged is Severity.ACCEPT and all_shown else "partly"

    @property
    def against(self) -> tuple[Reason, ...]:
        """Reasons of the replay's verdict against its calibration."""
        return tuple(reason for reason in self.reasons if reason.severity in (Severity.REJECT, Severity.MARGINAL))

    @property
    def why(self) -> str:
        """Sentence on why it cannot calibrate fully; '' if it can or the findings explain it."""
        if self.verdict == "no" and self.against and is_cause(self.against[0]):
            return self.against[0].full_sentence
        errors = [reason for reason in self.findings if reason.severity is Severity.ERROR]
        if errors:
            return full(errors[0].says)
        if not self.has_reference and self.verdict != "no":
            return "There is no reference velocity: roll and scale stay unknown, and nothing can be verified."
        if self.cannot or self.verdict == "no":
            return full(self.cannot or self.against[0].says)
        missing = [reason.name for reason in self.shown if reason.needs]
        listed = " and ".join(filter(None, (", ".join(missing[:-1]), *missing[-1:])))
        return f"Not shown yet: {listed}." if listed else ""

    def document(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "verdict": self.verdict,
            "replay": {"verdict": self.judged.value, "reasons": [reason.as_dict() for reason in self.reasons]},
            "seconds": self.seconds,
            "topics": {
                content.role.lower(): {
                    "topic": content.topic,
                    "type": content.msgtype,
                    "messages": content.messages,
                    "rate_hz": content.rate_hz,
                    "frame_id": content.frame_id,
                    "covariance": content.covariance,
                }
                for content in self.contents
            },
            "discovery": self.discovery.document(),
            "findings": [found.as_dict() for found in self.findings],
            "speed_mps": self.speed_mps,
            "shown": {
                reason.name: {"std": reason.std, "unit": reason.unit, "share": reason.share, "needs": reason.needs}
                for reason in self.shown
            },
            "notes": list(self.notes),
        }


def examine(recording: Recording | Sequence[Path], parameters: Parameters, given: Given | None = None) -> Examination:
    """Examine a recording. Raises InputError if it is no recording or has no DVL."""
    if not isinstance(recording, Recording):
        recording = open_recording(recording, parameters=parameters)
    discovery = discover(recording, parameters, given)
    streams = _streams(recording, discovery)
    previews = {role: recording.survey.previews.get(topic.topic) for role, topic in streams.items()}
    start_ns, end_ns = recording.span_ns
    recorded_s = 1e-9 * (end_ns - start_ns)
    seconds = {
        role: recorded_s * (1.0 if preview is None else preview.clock_rate) for role, preview in previews.items()
    }
    velocity = _body_velocity(streams["dvl"], previews["dvl"], discovery.parameters)
    findings = _findings(streams, discovery, velocity)
    replayed, cannot = _replayed(recording, discovery)
    verification = None if replayed is None else replayed.result.verifications[replayed.result.selected]
    if replayed is not None:
        discovery = discovery.with_mounting(replayed.result.parameters["mounting_rpy"])
    reasons = () if verification is None else tuple(verification.reasons)
    in_verdict = set(map(str, reasons))
    findings = [reason for reason in findings if str(reason.numbers.get("says")) not in in_verdict]
    judged = Severity.REJECT if verification is None else verification.verdict
    if judged is not Severity.REJECT:  # the replay is usable, so no finding prevents a calibration
        findings = [reason.weighed(Severity.WARNING) if _has_error([reason]) else reason for reason in findings]
    return Examination(
        recording.paths,
        seconds["dvl"],
        tuple(
            _content(role, topic, previews[role], recording.counts[topic.topic] / (seconds[role] or math.inf))
            for role, topic in streams.items()
        ),
        discovery,
        tuple(findings),
        float(np.median(np.linalg.norm(velocity, axis=1))) if len(velocity) else 0.0,
        () if replayed is None or "reference" not in streams else _observability(replayed),
        recording.notes,
        judged,
        reasons,
        cannot,
    )


def rejection(recording: Recording, discovery: Discovery) -> Reason | None:
    """Return the reason for which the calibration rejects a recording; None if it is usable."""
    replayed, cannot = _replayed(recording, discovery)
    if replayed is None:
        return finding("CALIBRATION_REJECTS", says=cannot)
    verification = replayed.result.verifications[replayed.result.selected]
    is_rejected = verification.verdict is Severity.REJECT
    return finding("CALIBRATION_REJECTS", says=verification.reasons[0]) if is_rejected else None


def judged_replay(
    recording: Recording,
    discovery: Discovery,
    on_progress: Callable[[float], None] = lambda _: None,
    *,
    merge: bool = False,
    with_history: bool = False,
) -> Replayed:
    """Replay as discovered. A rejection that names no cause begins with the first error of the recording's streams.

    Other arguments: see `checked_replay`. Raises InputError.
    """
    replayed = checked_replay(
        recording,
        discovery.parameters,
        discovery.topics,
        on_progress,
        merge=merge,
        with_history=with_history,
        mounting_is_guessed=bool(discovery.mounting_because),
        contradictions=discovery.contradictions,
    )
    result = replayed.result
    judged = result.verifications.get(result.selected)
    if judged is None or judged.verdict is not Severity.REJECT or is_cause(judged.reasons[0]):
        return replayed
    streams = _streams(recording, discovery)
    look = recording.survey.previews.get(streams["dvl"].topic)
    findings = _findings(streams, discovery, _body_velocity(streams["dvl"], look, discovery.parameters))
    errors = [reason for reason in findings if _has_error([reason])]
    if not errors or errors[0].code == "DOCTOR_NO_IMU_EARTH":  # the replay has its own finding
        return replayed
    judged = judged.with_objections([errors[0].weighed(Severity.REJECT)])
    result = replace(result, verifications={**result.verifications, result.selected: judged})
    return replace(replayed, result=result, findings=(*replayed.findings, errors[0]))


def _streams(recording: Recording, discovery: Discovery) -> dict[str, Recorded]:
    """Return the messages of DVL, reference and IMU, by role, as far as there are any."""
    topics = discovery.topics
    wanted = {"dvl": topics.dvl, "reference": topics.gnss, "imu": topics.imu}
    present = {role: name for role, name in wanted.items() if name in recording.types}
    return {role: recording.recorded(name, discovery.parameters) for role, name in present.items()}


def _replayed(recording: Recording, discovery: Discovery) -> tuple[Replayed | None, str]:
    """Return the replay of `dvl-calib replay`, whose verdict is the doctor's; or the reason why there is none."""
    try:
        return judged_replay(recording, discovery), ""
    except InputError as error:
        return None, str(error).rstrip(".")


def _content(role: str, topic: Recorded, look: Preview | None, rate_hz: float) -> Content:
    """Return name, type, rate and reported σ of a topic, as text."""
    variances = topic.variances[np.isfinite(topic.variances).all(axis=1)]
    if role == "imu":
        covariance = ""
    elif not len(variances):
        covariance = "no covariance"
    else:
        constant = " always" if (variances == variances[0]).all() else ""
        covariance = f"±{_claimed(variances, topic.window_s)}{constant}"
    name = {"dvl": "DVL", "reference": "reference", "imu": "IMU"}[role]
    frame_id = "" if look is None else look.frame_id
    return Content(name, topic.topic, topic.msgtype, len(topic), rate_hz, frame_id, covariance)


def _claimed(variances: Array, window_s: float) -> str:
    """Format the claimed σ per axis, for positions in m. variances: (N, 3), of positions as in `Recorded`."""
    if not window_s:
        return f"{math.sqrt(float(np.median(variances.mean(axis=1)))):.2g} m/s"
    # a velocity comes from two positions; one without height claims a huge vertical variance
    return f"{window_s * math.sqrt(0.5 * float(np.median(variances))):.2g} m"


def _body_velocity(dvl: Recorded, look: Preview | None, parameters: Parameters) -> Array:
    """Return the DVL's usable velocities (N, 3) m/s in the body, by the nominal mounting."""
    values = dvl.values[np.isfinite(dvl.values).all(axis=1) & (dvl.values != 0.0).any(axis=1)]
    values = values[np.linalg.norm(values, axis=1) <= parameters.max_speed]
    is_turned = turns_dvl(VELOCITY_TYPES[dvl.msgtype], "" if look is None else look.frame_id, parameters)
    dvl_velocity = values @ FLU_FROM_FRD if is_turned else values
    return dvl_velocity @ rotation_from_rpy(parameters.mounting_rpy).T


def _findings(streams: dict[str, Recorded], discovery: Discovery, velocity: Array) -> list[Reason]:
    """Return all problems of the streams, errors first; consequences of a reported problem are left out.

    velocity: (N, 3) m/s, of the DVL in the body.
    """
    dvl, reference, imu = streams["dvl"], streams.get("reference"), streams.get("imu")
    over_legs = reference is not None and _is_compared_over_legs(reference)
    found: list[Reason] = []
    for role, topic in streams.items():
        found += topic_checks.stamp_findings(topic, Stream(role), discovery.parameters)
        found += topic_checks.gap_findings(topic)
    found += topic_checks.velocity_findings(dvl, True)
    if reference is not None:
        if not _has_error(found):  # an error would explain it
            found += topic_checks.apart_findings(dvl, reference)
        found += [] if over_legs else topic_checks.velocity_findings(reference, False)
        if (
            not over_legs
            and len(reference) > topic_checks.ENOUGH
            and topic_checks.interval_s(reference) > 1.0 / SLOW_REFERENCE
        ):
            rate_hz = 1.0 / topic_checks.interval_s(reference)
            found.append(finding("DOCTOR_SLOW_REFERENCE", topic=reference.topic, rate_hz=rate_hz))
    if imu is not None and len(imu) and discovery.reference_frame in (VelocityFrame.ENU, VelocityFrame.NED):
        found += topic_checks.orientation_findings(imu)
    if imu is None:
        in_body = reference is None or discovery.reference_frame is VelocityFrame.BODY
        what = "no lever arm is corrected or estimated" if reference is not None else "nothing tells the heading"
        found.append(finding("DOCTOR_NO_IMU", what=what) if in_body else finding("DOCTOR_NO_IMU_EARTH"))
    found += [finding("DOCTOR_FRAMES", says=doubt) for doubt in discovery.contradictions]
    parameters = discovery.parameters
    speed = np.linalg.norm(velocity, axis=1)
    units = [] if reference is None or over_legs else _units(dvl, reference)
    if units:
        found += units
    elif not len(dvl):
        pass  # the reason is already reported
    elif not len(speed) or (speed > parameters.min_speed).mean() < MOVES_SHARE:
        found.append(finding("DOCTOR_NOT_MOVING", topic=dvl.topic, min_speed=parameters.min_speed))
    elif reference is not None and not over_legs:
        found += _disagreement(discovery, topic_checks.shown_noise(reference.values) / float(np.median(speed)))
    return sorted(found, key=lambda each: each.severity is not Severity.ERROR)


def _is_compared_over_legs(reference: Recorded) -> bool:
    """Return whether a reference is positions that are too noisy or too infrequent for velocities."""
    is_position = VELOCITY_TYPES[reference.msgtype].position is not None
    is_noisy = len(reference) > 0 and topic_checks.shown_noise(reference.values) > NOISY_MPS
    return is_position and (is_noisy or topic_checks.interval_s(reference) > SELDOM_S)


def _has_error(reasons: Sequence[Reason]) -> bool:
    return any(reason.severity is Severity.ERROR for reason in reasons)


def _units(dvl: Recorded, reference: Recorded) -> list[Reason]:
    """Report DVL and reference whose speeds, well above their noise, differ by the factor between two units."""
    speeds = []
    for topic in (dvl, reference):
        norms = np.linalg.norm(topic.values, axis=1)
        norms = norms[np.isfinite(norms) & (norms > 0.0)]
        speed = float(np.median(norms)) if len(norms) else 0.0
        speeds.append(speed if speed > Z_ONE_TEST * topic_checks.shown_noise(topic.values) else 0.0)
    if not min(speeds) > 0.0:
        return []
    factor = speeds[0] / speeds[1]
    if UNIT_FACTORS[0] < factor < UNIT_FACTORS[1]:
        return []
    guess = ""
    for of_unit, unit in UNITS.items():
        for which, value in (("the DVL", factor), ("the reference", 1.0 / factor)):
            if abs(value / of_unit - 1.0) < 0.1:
                guess = f" ({which} in {unit}?)"
    return [finding("DOCTOR_UNITS", factor=factor, guess=guess)]


def _disagreement(discovery: Discovery, noise: float) -> list[Reason]:
    """Report DVL and reference that disagree in all frames.

    noise: of the reference per axis, as a share of the speed.
    """
    if discovery.agreement is None or discovery.agreement.best_residual**2 - 3.0 * noise**2 < MAX_RESIDUAL**2:
        return []
    return [finding("DOCTOR_DISAGREE", left=discovery.agreement.best_residual)]


_NAMES = ("roll", "pitch", "yaw", "scale")


@dataclass(frozen=True)
class Shown:
    """Observability of one error in a recording.

    std: standard deviation of the calibration, degrees or per cent.
    share: progress from no knowledge (0) to fine (1).
    needs: the manoeuvre that improves it, '' if it is observable.
    """

    name: str
    unit: str
    std: float
    share: float
    needs: str


def _observability(replayed: Replayed) -> tuple[Shown, ...]:
    """Return the observability of roll, pitch, yaw and scale; nothing if no sample was usable."""
    result = replayed.result
    if not result.estimate.used:
        return ()
    parameters = Parameters.from_mapping(result.parameters)
    return tuple(_one_shown(term, result.estimate, parameters) for term in quantities(result) if term.name in _NAMES)


def _one_shown(quantity: Quantity, estimate: Estimate, parameters: Parameters) -> Shown:
    """Return one quantity with its σ, progress to the goal, and the missing motion."""
    if quantity.name == "scale":
        unit, prior = 100.0, parameters.initial_std_scale
    else:
        unit, prior = math.degrees(1.0), parameters.initial_std_misalignment
    needs = "" if quantity.shown else missing_for(quantity.name, estimate)
    fine = PredictedDrift.goals(parameters).side / KM
    way = math.log(prior * unit / max(quantity.std, 1e-12)) / max(math.log(prior / fine), 1e-9)
    return Shown(quantity.name, quantity.unit.strip(), quantity.std, min(1.0, max(0.0, way)), needs)
