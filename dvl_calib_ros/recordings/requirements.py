"""Checks of the topics and sensors that a command needs, and of duplicate recordings."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Stamps, VelocityFrame
from ..errors import InputError
from ..messages.drivers import DVL_TYPES, IMU_TYPE, REFERENCE_TYPES
from ..verdict.reasons import Reason, finding
from .recording import Recording
from .topic_messages import Recorded
from .topics import NONE, Topics


def check_topics(recording: Recording, topics: Topics, found: list[Reason]) -> None:
    """Raise InputError unless there is a readable DVL; other missing data are added to `found`."""
    present, where = recording.types, recording.where
    if not present:
        raise InputError(f"{where}: the bag is empty, it has no topics; record it again")
    if len({topics.dvl, topics.gnss, topics.imu}) < 3:
        raise InputError("--dvl-topic, --gnss-topic and --imu-topic must be different topics")
    if topics.dvl not in present:
        listing = ", ".join(f"{name} ({kind})" for name, kind in sorted(present.items()))
        option = " or ".join(f"--dvl-topic {name}" for name in _likely_dvl_topics(topics, present)) or "--dvl-topic"
        raise InputError(f"{where}: no topic {topics.dvl!r}; set {option}. The bag has: {listing}")
    _check_types(recording, topics, found)
    if not recording.counts[topics.dvl]:
        raise InputError(f"{where}: topic {topics.dvl} holds no messages; was the DVL on? Else set --dvl-topic")
    if topics.gnss not in (*present, NONE):
        found.append(finding("BAG_NO_GNSS", topic=topics.gnss))


def missing_imu(recording: Recording, topics: Topics, frame: VelocityFrame | None) -> list[Reason]:
    """Return the consequences of a missing IMU. frame: of the reference's messages, None if unknown."""
    if topics.imu in recording.types:
        return []
    if topics.gnss not in recording.types:
        what = "the heading is unknown"
    elif frame is VelocityFrame.BODY:
        what = "no lever arm is corrected or estimated"
    else:
        what = "a reference in the earth's frame cannot be compared with the DVL; no lever arm is estimated"
    return [finding("BAG_NO_IMU", what=what)]


def _check_types(recording: Recording, topics: Topics, found: list[Reason]) -> None:
    for role, wanted in _WANTED.items():
        name = getattr(topics, role)
        held = recording.held.get(name)
        if held is None:
            continue
        types = " and ".join(sorted(held.types))
        if held.types - wanted:
            expected = " or ".join(wanted)
            raise InputError(f"{recording.where}: topic {name} holds {types}, expected {expected}; set --{role}-topic")
        if len(held.types) > 1:
            raise InputError(f"{recording.where}: topic {name} holds {types}; replay bags of one type together")
        if held.lacks_definition:
            found.append(finding("BAG_NO_DEFINITION", type=types))


_WANTED: Mapping[str, Set[str]] = {"dvl": DVL_TYPES.keys(), "gnss": REFERENCE_TYPES.keys(), "imu": {IMU_TYPE}}


def _likely_dvl_topics(topics: Topics, present: Mapping[str, str]) -> list[str]:
    """Return the likely DVL topics: by a type that only DVLs have, else by name, else any fitting one."""
    fitting = sorted(name for name, kind in present.items() if kind in DVL_TYPES and name != topics.gnss)
    only_dvl = [name for name in fitting if present[name] not in REFERENCE_TYPES]
    return only_dvl or [name for name in fitting if "dvl" in name.lower()] or fitting


def hold_the_same(one: Recorded, other: Recorded) -> bool:
    """Return whether half of one recording's DVL velocities are in the other, at the same stamps."""
    (stamps, values), (its_stamps, its_values) = _velocities(one), _velocities(other)
    if not len(stamps) or not len(its_stamps):
        return False
    at = np.minimum(np.searchsorted(its_stamps, stamps), len(its_stamps) - 1)
    same = (its_stamps[at] == stamps) & (its_values[at] == values).all(axis=1)
    return bool(2 * np.count_nonzero(same) > min(len(stamps), len(its_stamps)))


def _velocities(topic: Recorded) -> tuple[Stamps, Array]:
    """Return stamps (N,) in order and velocities (N, 3), the first of each stamp."""
    kept = np.flatnonzero(np.isfinite(topic.values).all(axis=1))
    stamps = np.where(topic.stamps_ns == 0, topic.log_ns, topic.stamps_ns)[kept]
    order = np.argsort(stamps, kind="stable")
    first = np.concatenate([[True], np.diff(stamps[order]) > 0])[: len(order)]
    return stamps[order][first], topic.values[kept[order][first]]
