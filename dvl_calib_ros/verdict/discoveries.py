"""What discovery passed over or had to guess in a recording: topics, frames, the mounting."""

from __future__ import annotations

from functools import partial

from .kinds import Kind, Severity

_Said = partial(Kind, page="troubleshooting.md#what-discovery-notes", severity=Severity.ACCEPT)
DISCOVERIES = (
    _Said(
        "SECOND_DVL",
        "two DVLs: {topic} ({frame}) is calibrated here, not {other} ({other_frame}); calibrate that with --dvl-topic "
        "{other}",
        "Each DVL has a mounting of its own.",
        "",
    ),
    _Said(
        "TOPIC_DOES_NOT_MOVE",
        "{topic} does not move; not taken as a reference",
        "A velocity that is 0 throughout, as of a station.",
        "",
    ),
    _Said(
        "TOPIC_FROM_DVL",
        "{topic} looks as if it was computed from the DVL; not taken as a reference",
        "It agrees with the DVL to the last digits, or is named after it.",
        "",
    ),
    _Said(
        "TOPIC_DERIVED",
        "{topic} may be a filter's output that uses the DVL; not taken as a reference. If it does not use the DVL: "
        "--gnss-topic {topic}",
        "Its name says that it is computed.",
        "",
    ),
    _Said(
        "SEVERAL_REFERENCES",
        "{topic} is taken as the reference, not {others}; --gnss-topic names another",
        "Satellites go first, then a simulator's truth, then an INS.",
        "",
    ),
    _Said(
        "FRAME_NOT_IN_TREE",
        "no transform for the DVL's frame {frame!r}; using frame {other!r} instead",
        "Its name is that of a DVL.",
        "",
    ),
    _Said(
        "REFERENCE_FRAME_NOT_TOLD",
        "{topic}: nothing tells its frame, not even the data without an IMU",
        "A frame fits where the velocities agree under it, which takes an attitude.",
        "",
    ),
    _Said(
        "MOUNTING_GUESSED",
        "mounting {mounting}, {why}: nothing in the bag says how the DVL is mounted (-p mounting_rpy:={option}){also}",
        "Taken from the data, to the next quarter of a turn where that fits.",
        "",
    ),
    _Said(
        "TRANSFORM_NOT_ROTATION",
        "/tf_static: the transform of {frame!r} is not a rotation; not used",
        "Its quaternion has no length of 1.",
        "",
    ),
    _Said("URDF_NOT_READ", "{reason}; not used", "The recording's /robot_description is no URDF.", ""),
)
