"""Choice of the DVL's, the reference's and the IMU's topic, by type, name and content."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from ..errors import InputError
from ..messages.drivers import DVL_TYPES, IMU_TYPE, POSE_TYPES, REFERENCE_TYPES, TWIST_TYPE, WANTED_TYPES
from ..recordings.topics import ORIENTATION, spelled
from ..verdict.reasons import Reason, finding

if TYPE_CHECKING:
    from ..recordings.topic_messages import Preview, Survey

DVL_WORDS = ("dvl", "doppler", "bottom_track", "bottomtrack", "a50", "a125", "wayfinder", "pathfinder", "nucleus")
# Satellites first, then other navigation systems. A simulator's truth is equivalent to either.
GNSS_WORDS = ("gnss", "gps", "navsat", "rtk", "ublox", "septentrio", "novatel", "fix", "nmea")
TRUTH_WORDS = (
    "truth", "pose_gt", "p3d", "mocap", "motion_capture", "qualisys", "optitrack", "vicon", "vrpn", "natnet"
)  # fmt: skip
INS_WORDS = ("ins", "spatial", "sbg", "phins", "xsens", "mti", "vectornav", "microstrain", "navigation", "rovins")
# Velocities derived from the DVL prove nothing about it, and commands are not measured. Navigation systems that use the
# DVL also send poses; only poses with these names are measured.
ACOUSTIC_WORDS = ("usbl", "ssbl", "sbl", "lbl", "acoustic", "hipap", "ugps", "underwater_gps")
DERIVED_WORDS = (
    "filtered", "ekf", "ukf", "fused", "dead_reckoning", "deadreckoning", "calibrated", "dvl_calibration",
    "local_position", "estimate",
)  # fmt: skip
COMMAND_WORDS = ("cmd", "command", "setpoint", "desired", "target", "goal", "joy", "teleop", "thrust", "current")
# a vehicle that never reaches this speed does not move, m/s
MOVES_FROM = 0.02
# two velocities that differ by less than this share of the speed were derived from each other
SAME_SHARE = 1e-4

Difference = Callable[["Preview", "Preview"], "float | None"]
"""DVL and reference -> residual of their difference after the best rotation, as a share of the speed; None: unknown."""


def _has(preview: Preview, words: Iterable[str]) -> bool:
    """Return whether a topic's name or frame has one of these words; short words only as a separate part."""
    return _contains_word(f"{preview.topic} {preview.frame_id}", words)


def _contains_word(text: str, words: Iterable[str]) -> bool:
    text = text.lower()
    parts = set(re.split(r"[^a-z0-9]+", text))
    return any(word in parts or (len(word) > 3 and word in text) for word in words)


def may_be_dvl(topic: str, msgtype: str) -> bool:
    """Return whether a topic's type or name is a DVL's, and its name suggests no derived data."""
    if _contains_word(topic, (*DERIVED_WORDS, *COMMAND_WORDS)):
        return False
    return msgtype in DVL_TYPES and (msgtype not in REFERENCE_TYPES or _contains_word(topic, DVL_WORDS))


def is_derived(preview: Preview) -> bool:
    """Return whether a velocity seems to be derived from the DVL, or commanded."""
    return _has(preview, (*DERIVED_WORDS, *COMMAND_WORDS))


def checked_topic(role: str, name: str, survey: Survey, where: str) -> str:
    """Return a named topic as spelled in the recording. Raises InputError if it is missing or of another type."""
    option, wanted, present = f"--{role}-topic", WANTED_TYPES[role], survey.topics
    spelled_topic = spelled(name, present)
    if spelled_topic is not None and present[spelled_topic] not in wanted:
        expected = " or ".join(wanted)
        fields = f"; set {option}"
        if option == "--dvl-topic" and spelled_topic in survey.field_maps:
            fields = f"; read it with --dvl-fields {survey.field_maps[spelled_topic]}"
        raise InputError(f"{where}: topic {spelled_topic} holds {present[spelled_topic]}, expected {expected}{fields}")
    if spelled_topic is None:
        fitting = sorted(topic for topic, kind in present.items() if kind in wanted)
        near = difflib.get_close_matches(name, fitting, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]}?" if near else f"; set {option}."
        listing = ", ".join(fitting) or "none"
        raise InputError(f"{where}: no topic {name!r}{hint} Of types that fit, the bag has: {listing}")
    return spelled_topic


def choose_dvl(survey: Survey, default: str, where: str) -> str:
    """Return the DVL's topic. Raises InputError if there is none."""
    present = survey.topics
    standard = spelled(default, present)
    if standard is not None and present[standard] in DVL_TYPES:
        return standard
    previews = [preview for preview in survey.previews.values() if preview.msgtype in DVL_TYPES]
    own_type = [preview for preview in previews if preview.msgtype not in REFERENCE_TYPES]
    named = [preview for preview in previews if _has(preview, DVL_WORDS) and not is_derived(preview)]
    found = own_type or named
    if not found:
        no_dvl = (*GNSS_WORDS, *TRUTH_WORDS)
        velocities = [preview for preview in previews if not _has(preview, no_dvl) and not is_derived(preview)]
        if len(velocities) == 1 and len(previews) > 1:
            return velocities[0].topic
        unlisted = [name for name in survey.field_maps if not _contains_word(name, (*DERIVED_WORDS, *COMMAND_WORDS))]
        unlisted.sort(key=lambda name: not _contains_word(f"{name} {present[name]}", DVL_WORDS))
        fields = "".join(f", or read {name} with --dvl-fields {survey.field_maps[name]}" for name in unlisted[:1])
        unread = {name: f", which cannot be decoded: {why}" for name, why in survey.unread.items()}
        held = ", ".join(f"{name} ({kind}{unread.get(name, '')})" for name, kind in sorted(present.items()))
        listing = f"The bag has: {held}" if held else "The bag is empty"
        raise InputError(f"{where}: no topic looks like a DVL's; name it with --dvl-topic{fields}. {listing}")
    order = list(DVL_TYPES)
    # of several forms of one velocity, prefer the plain type, then the raw one
    order.sort(key=lambda name: (name in REFERENCE_TYPES, name != TWIST_TYPE))
    return min(found, key=lambda topic: (order.index(topic.msgtype), not topic.speed, -topic.count, topic.topic)).topic


def is_another_dvl(preview: Preview, dvl: Preview) -> bool:
    """Return whether a topic is a second DVL's, by its type or name, and by its frame."""
    own_frame = any(word in preview.frame_id.lower() for word in DVL_WORDS)
    is_dvl = preview.msgtype in DVL_TYPES and (preview.msgtype not in REFERENCE_TYPES or own_frame)
    moves = preview.speed >= MOVES_FROM and not is_derived(preview)
    return is_dvl and moves and preview.topic != dvl.topic and preview.frame_id not in ("", dvl.frame_id)


def other_dvls(survey: Survey, dvl: str, difference: Difference) -> list[Reason]:
    """Return the notes on DVLs that are not calibrated here."""
    calibrated = survey.previews.get(dvl)
    if calibrated is None:
        return []
    others = [preview for preview in survey.previews.values() if is_another_dvl(preview, calibrated)]
    measured = [other for other in others if (difference(calibrated, other) or 0.0) >= SAME_SHARE]
    return [
        finding("SECOND_DVL", topic=dvl, frame=calibrated.frame_id, other=other.topic, other_frame=other.frame_id)
        for other in sorted(measured, key=lambda other: other.topic)
    ]


def choose_reference(survey: Survey, default: str, dvl: str, difference: Difference) -> tuple[str | None, list[Reason]]:
    """Return the reference's topic, or None; and notes on rejected topics."""
    standard = spelled(default, survey.topics)
    if standard is not None and survey.topics[standard] in REFERENCE_TYPES:
        return standard, []
    dvl_preview = survey.previews.get(dvl)
    ranked: list[tuple[tuple[float, ...], Preview]] = []
    reasons: list[Reason] = []
    for preview in survey.previews.values():
        if preview.topic == dvl or preview.msgtype not in REFERENCE_TYPES or _has(preview, COMMAND_WORDS):
            continue
        if preview.msgtype in POSE_TYPES and not _has(preview, (*ACOUSTIC_WORDS, *TRUTH_WORDS)):
            continue
        if preview.speed < MOVES_FROM:
            reasons.append(finding("TOPIC_DOES_NOT_MOVE", topic=preview.topic))
            continue
        share = None if dvl_preview is None else difference(dvl_preview, preview)
        if _has(preview, DVL_WORDS) or (share is not None and share < SAME_SHARE):
            if (
                dvl_preview is None
                or not is_another_dvl(preview, dvl_preview)
                or (share is not None and share < SAME_SHARE)
            ):
                reasons.append(finding("TOPIC_FROM_DVL", topic=preview.topic))
            continue
        if is_derived(preview):
            reasons.append(finding("TOPIC_DERIVED", topic=preview.topic))
            continue
        kind = next((i for i, words in enumerate((GNSS_WORDS, TRUTH_WORDS, INS_WORDS)) if _has(preview, words)), 3)
        fits = 0.0 if share is None or share < 0.5 else 1.0
        is_position = REFERENCE_TYPES[preview.msgtype].position is not None
        # of several forms of one velocity, first the one with a covariance, last positions
        form = 2.0 if is_position else 0.0 if preview.msgtype == TWIST_TYPE else 1.0
        ranked.append(((fits, kind, form, -preview.rate_hz), preview))
    if not ranked:
        return None, reasons
    chosen, *others = [topic for _, topic in sorted((order, preview.topic) for order, preview in ranked)]
    if others:
        reasons.append(finding("SEVERAL_REFERENCES", topic=chosen, others=", ".join(others)))
    return chosen, reasons


def choose_imu(survey: Survey, default: str, reference: str = "") -> str | None:
    """Return the IMU's topic, or None. reference: its topic, whose poses may have orientations."""
    standard = spelled(default, survey.topics)
    of_poses = reference + ORIENTATION
    if standard is not None and survey.topics[standard] == IMU_TYPE and of_poses not in survey.topics:
        return standard
    previews = [preview for preview in survey.previews.values() if preview.msgtype == IMU_TYPE]
    if not previews:
        return None

    def order(preview: Preview) -> tuple[object, ...]:
        name = preview.topic.lower()
        last = ("raw" in name, "filtered" in name, -preview.count, name)
        return (not preview.has_orientation, preview.topic != of_poses, _has(preview, DVL_WORDS), *last)

    return min(previews, key=order).topic
