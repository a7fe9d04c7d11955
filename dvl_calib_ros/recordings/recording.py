"""Recordings, read once: one pass over the bytes collects everything that any command needs.

Columns are kept for all topics that may be a DVL's, a reference or an IMU's; the first messages of transforms and
descriptions; nothing of other topics.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.columns import Part, windows
from ..bags.reader import BagReader
from ..calibration.checks.speed_of_sound import Water
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import Mask, Stamps, Stream, Streams, VelocityFrame, no_samples
from ..calibration.registration.registration import Registration
from ..errors import InputError
from ..messages.decode import RESTAMP_ALL, MessageDecoder
from ..messages.drivers import (
    DVL_TYPES,
    IMU_TYPE,
    KNOWN_DEFINITIONS,
    POSE_TYPES,
    REFERENCE_TYPES,
    VELOCITY_TYPES,
    WANTED_TYPES,
)
from ..messages.field_map import forget_mapped, mapped_type, may_be_mapped, misfit, recognised, suggested
from ..messages.water_properties import OfWater, WaterCollector, readers, water_of
from ..verdict.reasons import Reason, finding
from .columns import Collector, TopicColumns, is_kept
from .far_stamps import without_far
from .sample_columns import Stretch, stretches
from .topic_messages import Recorded, Survey, preview_of, recorded
from .topics import NONE, ORIENTATION, Topics, spelled

TF_TYPE, STRING_TYPE = "tf2_msgs/msg/TFMessage", "std_msgs/msg/String"
# static transforms and descriptions are few, so the first ones of a recording that repeats them are enough
MOST_STATIC = 200
# number of messages of a water topic that are read per window: water changes slowly
WATER_OF_WINDOW = 20
Span = tuple[int, int]
"""First and last log time, ns."""


@dataclass(frozen=True)
class Recording:
    """One recording, or several as one.

    types: topic -> message type.
    held: topic -> all its types.
    counts: topic -> number of messages.
    file_spans_ns: of each file with a message.
    notes: messages to the user on damage.
    columns: of the topics that are kept, one part per path.
    transforms: of tf_static.
    descriptions: of robot_description.
    parts: the recordings it was joined from, if any.
    registrations: cached results of `register_as`.
    waters: its water properties.
    field_maps: topic of an unlisted type -> field map for its likely velocity.
    """

    paths: tuple[Path, ...]
    types: Mapping[str, str]
    held: Mapping[str, Held]
    counts: Mapping[str, int]
    file_spans_ns: tuple[Span, ...]
    notes: tuple[str, ...]
    columns: dict[str, tuple[TopicColumns, ...]]
    transforms: tuple[Any, ...] = ()
    descriptions: tuple[str, ...] = ()
    parts: tuple[Recording, ...] = field(default=(), repr=False)
    registrations: dict[tuple[Topics, Parameters], Registration] = field(default_factory=dict, repr=False)
    waters: tuple[OfWater, ...] = ()
    field_maps: Mapping[str, str] = field(default_factory=dict)

    def register_as(self, registration: Registration, topics: Topics, parameters: Parameters) -> None:
        """Cache a registration for these topics and parameters."""
        self.registrations[self._registration_key(topics, parameters)] = registration

    def registration(self, topics: Topics, parameters: Parameters) -> Registration | None:
        """Return the cached registration for the same topics and parameters, or None."""
        return self.registrations.get(self._registration_key(topics, parameters))

    def _registration_key(self, topics: Topics, parameters: Parameters) -> tuple[Topics, Parameters]:
        # initial calibration and excluded slow samples do not influence a registration
        return topics.found_in(self.types), parameters.replace(min_speed=0.0, initial_calibration="")

    @property
    def each(self) -> tuple[Recording, ...]:
        """Recordings, one per path."""
        return self.parts or (self,)

    @property
    def where(self) -> str:
        """Paths as text."""
        return ", ".join(map(str, self.paths))

    @property
    def span_ns(self) -> Span:
        """First and last log time; (0, 0) without messages."""
        starts, ends = zip(*(self.file_spans_ns or [(0, 0)]), strict=True)
        return min(starts), max(ends)

    @property
    def path_spans_ns(self) -> tuple[Span | None, ...]:
        """First and last log time at each path; None without messages."""
        return tuple(one.span_ns if one.file_spans_ns else None for one in self.each)

    @property
    def recorded_spans_ns(self) -> list[Span]:
        """First and last log time of each recorded stretch, in order; overlapping ones are joined."""
        spans: list[Span] = []
        for start_ns, end_ns in sorted(self.file_spans_ns):
            if spans and start_ns <= spans[-1][1]:
                spans[-1] = spans[-1][0], max(spans[-1][1], end_ns)
            else:
                spans.append((start_ns, end_ns))
        return spans

    @property
    def between_ns(self) -> list[int]:
        """Log times between one path's recording and the next."""
        between = []
        until_ns: int | None = None
        for start_ns, end_ns in sorted(span for span in self.path_spans_ns if span is not None):
            if until_ns is not None and start_ns > until_ns:
                between.append((until_ns + start_ns) // 2)
            until_ns = end_ns if until_ns is None else max(until_ns, end_ns)
        return between

    @cached_property
    def survey(self) -> Survey:
        """Preview of all topics that are kept."""
        return self._surveyed(self.columns, whole=False)

    def whole(self, topics: Topics) -> Survey:
        """Return the full messages of three topics, to compare streams whose clocks differ widely."""
        named = (topics.dvl, topics.gnss, topics.imu)
        return self._surveyed({name: self.columns[name] for name in named if name in self.columns}, whole=True)

    def _surveyed(self, columns: Mapping[str, tuple[TopicColumns, ...]], *, whole: bool) -> Survey:
        """Return the previews of readable topics; of topics without a readable message the reason."""
        start_ns, spans_ns = self.span_ns[0], self.recorded_spans_ns or [(0, 0)]
        previews = {
            topic: preview_of(self._of_type(topic), self.counts[topic], start_ns, spans_ns, whole=whole)
            for topic in columns
        }  # fmt: skip
        read = {topic: preview for topic, preview in previews.items() if preview is not None}
        unread = {
            topic: reasons[0]
            for topic, parts in columns.items()
            if (reasons := [reason for part in parts for reason in part.unread_reasons])
            and len(reasons) == sum(map(len, parts))
        }  # fmt: skip
        return Survey(self.types, self.counts, read, self.transforms, self.descriptions, unread, self.field_maps)

    def water(self, topics: Topics) -> Water | None:
        """Return the water properties and the speed of sound used by the DVL; None if unknown."""
        return water_of(self.waters, topics.found_in(self.types).dvl)

    def recorded(self, topic: str, parameters: Parameters) -> Recorded:
        """Return all messages of a kept topic, unchanged."""
        return recorded(self._of_type(topic), parameters)

    def _of_type(self, topic: str) -> list[TopicColumns]:
        """Return the parts of a topic that have its type."""
        return [part for part in self.columns[topic] if part.msgtype == self.types[topic]]

    def stretches(self, topics: Mapping[str, Stream], decoder: MessageDecoder, share: float = 1.0) -> Iterator[Stretch]:
        """Yield all messages of some topics as samples, stretch by stretch, in order of arrival.

        share: read only this share of them, in a few windows.
        """
        return stretches({stream: self.columns.get(name, ()) for name, stream in topics.items()}, decoder, share=share)

    def streams(self, topics: Topics, decoder: MessageDecoder) -> Streams:
        """Return all messages of three topics as samples."""
        named = {topics.imu: Stream.IMU, topics.gnss: Stream.REFERENCE, topics.dvl: Stream.DVL}
        return _joined(list(self.stretches(named, decoder)))

    def forget(self) -> None:
        """Free all messages if they are not needed again; hours of them take much memory."""
        for one in (self, *self.parts):
            one.columns.clear()
            vars(one).pop("survey", None)

    def of_types(self, topics: Topics, parameters: Parameters) -> Parameters:
        """Return the parameters with the recording's message types of these topics."""
        types = self.types
        return parameters.replace(
            dvl_type=types.get(topics.dvl, parameters.dvl_type), gnss_type=types.get(topics.gnss, parameters.gnss_type)
        )


@dataclass(frozen=True)
class Held:
    """Types on a topic of a recording, and whether the definition of one is missing."""

    types: frozenset[str]
    lacks_definition: bool


def _joined(stretches: Sequence[Stretch]) -> Streams:
    if not stretches:
        return Streams(*map(no_samples, (Stream.DVL, Stream.REFERENCE, Stream.IMU)))
    return Streams(
        *(one.joined(*others) for one, *others in zip(*(stretch.streams for stretch in stretches), strict=True))
    )


def open_recording(
    paths: Sequence[Path],
    topics: Topics | None = None,
    parameters: Parameters | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Recording:
    """Read recordings once, several as one in order of log time. Raises InputError for a path that is no bag.

    topics: the only ones to keep; by default all useful ones.
    parameters: for messages' own validity rules (max_fom).
    on_progress: receives the share (0..1) read.
    """
    parameters = parameters or Parameters()
    recordings = []
    with ExitStack() as stack:
        # a fault of the last bag is reported before reading the first
        bags = [stack.enter_context(open_bags([path], parameters.dvl_fields)) for path in paths]
        for index, (path, bag) in enumerate(zip(paths, bags, strict=True)):

            def progress(share: float, index: int = index) -> None:
                on_progress((index + share) / len(paths))

            recordings.append(_read(path, bag, topics, parameters, progress))
    return together(recordings)


def together(recordings: Sequence[Recording]) -> Recording:
    """Join several recordings to one; their arrivals are renumbered by log time."""
    if len(recordings) == 1:
        return recordings[0]
    counts: Counter[str] = Counter()
    for recording in recordings:
        counts.update(recording.counts)
    names = dict.fromkeys(name for recording in recordings for name in recording.types)
    held = {name: [recording.held[name] for recording in recordings if name in recording.held] for name in names}
    return Recording(
        tuple(path for recording in recordings for path in recording.paths),
        {name: kind for recording in recordings for name, kind in recording.types.items()},
        {
            name: Held(frozenset().union(*(held.types for held in owns)), any(held.lacks_definition for held in owns))
            for name, owns in held.items()
            if owns
        },
        counts,
        tuple(span for recording in recordings for span in recording.file_spans_ns),
        tuple(note for recording in recordings for note in recording.notes),
        _renumbered(recordings, names),
        tuple(transform for recording in recordings for transform in recording.transforms),
        tuple(dict.fromkeys(text for recording in recordings for text in recording.descriptions)),
        tuple(recordings),
        waters=_joined_waters(recordings),
        field_maps={topic: text for recording in recordings for topic, text in recording.field_maps.items()},
    )


def _joined_waters(recordings: Sequence[Recording]) -> tuple[OfWater, ...]:
    """Join the readings of the same topic."""
    found: dict[tuple[str, str], list[OfWater]] = {}
    for reading in (reading for recording in recordings for reading in recording.waters):
        found.setdefault((reading.topic, reading.kind), []).append(reading)
    return tuple(
        parts[0]._replace(values=np.concatenate([part.values for part in parts]), std=max(part.std for part in parts))
        for parts in found.values()
    )


def _renumbered(recordings: Sequence[Recording], names: Collection[str]) -> dict[str, tuple[TopicColumns, ...]]:
    """Renumber the arrivals in all recordings by log time, and by recording at equal times."""
    arrivals, logs = [], []
    for recording in recordings:
        kept = [part for parts in recording.columns.values() for part in parts]
        arrival, log_ns = (
            np.concatenate([np.zeros(0, dtype=np.int64), *column])
            for column in ((part.arrival for part in kept), (part.log_ns for part in kept))
        )
        order = np.argsort(arrival, kind="stable")
        arrivals.append(arrival[order])
        logs.append(log_ns[order])
    new_arrival = np.empty(sum(map(len, logs)), dtype=np.int64)
    new_arrival[np.argsort(np.concatenate(logs), kind="stable")] = np.arange(len(new_arrival))
    columns: dict[str, list[TopicColumns]] = {
        name: [] for name in names if any(name in recording.columns for recording in recordings)
    }
    begin = 0
    for recording, arrival in zip(recordings, arrivals, strict=True):
        new_arrivals = new_arrival[begin : begin + len(arrival)]
        begin += len(arrival)
        for name, parts in recording.columns.items():
            columns[name] += [
                replace(part, arrival=new_arrivals[np.searchsorted(arrival, part.arrival)]) for part in parts
            ]
    return {name: tuple(parts) for name, parts in columns.items()}


def _read(
    path: Path, bag: BagReader, topics: Topics | None, parameters: Parameters, on_progress: Callable[[float], None]
) -> Recording:
    """Read a bag window by window: columns of moving topics, static transforms, descriptions, water readings."""
    contents = _Contents(bag, topics, parameters)
    start_ns, end_ns = bag.span_ns
    for window in windows(bag, contents.topics, contents.one_by_one):
        for part in window.parts:
            contents.take(part)
        on_progress((window.log_ns - start_ns) / max(end_ns - start_ns, 1))
    columns = {topic: collector.columns() for topic, collector in contents.sensors.items()}
    for topic in _restamped(columns, parameters.restamp, path):
        columns[topic] = replace(columns[topic], stamps_ns=columns[topic].log_ns)
    kept, file_spans_ns, far_findings = without_far(columns, bag.file_spans_ns)
    types, counts = dict(bag.topics), bag.message_counts
    counts.subtract({topic: len(columns[topic]) - len(column) for topic, column in kept.items()})
    held = {topic: Held(frozenset(bag.types_of(topic)), bag.lacks_definition(topic)) for topic in types}
    for column in _poses_as_imus(kept.values()):
        kept[column.topic], counts[column.topic] = column, len(column)
        types[column.topic], held[column.topic] = IMU_TYPE, Held(frozenset({IMU_TYPE}), False)
    return Recording(
        (path,), types, held, counts, file_spans_ns,
        notes=(*bag.notes, *map(str, far_findings)),
        columns={topic: (column,) for topic, column in kept.items()},
        transforms=tuple(contents.transforms), descriptions=tuple(dict.fromkeys(contents.descriptions)),
        waters=tuple(reading for water in contents.waters.values() for reading in water.readings()),
        field_maps=_field_maps(bag),
    )  # fmt: skip


class _Contents:
    """Contents of a bag read so far.

    topics: to be read.
    one_by_one: those of them whose messages do not fit columns.
    sensors, waters: collectors by topic.
    transforms, descriptions: from the static topics.
    """

    def __init__(self, bag: BagReader, topics: Topics | None, parameters: Parameters) -> None:
        """Select what to read. topics: the only ones to read; None for all useful ones."""
        self._types, counts = bag.topics, bag.message_counts
        sensor_topics = {topic for topic, kind in self._types.items() if is_kept(kind)}
        static_topics = {topic for topic, kind in self._types.items() if is_static(topic, kind)}
        if topics is not None:
            named = topics.found_in(self._types)
            sensor_topics, static_topics = sensor_topics & {named.dvl, named.gnss, named.imu}, set()
        self.sensors = {
            topic: Collector(topic, self._types[topic], counts[topic], parameters) for topic in sorted(sensor_topics)
        }
        self.waters = {t: WaterCollector(t, kind) for t, kind in self._types.items() if readers(t, kind)}
        self._still_to_read = dict.fromkeys(static_topics, MOST_STATIC)
        self.transforms: list[Any] = []
        self.descriptions: list[str] = []
        self.topics = sensor_topics | static_topics | self.waters.keys()
        self.one_by_one = {
            topic for topic in self.topics if topic not in sensor_topics or not _is_read_in_columns(self._types[topic])
        }

    def take(self, part: Part) -> None:
        """Add the messages of one topic in a window."""
        topic = part.channel.topic
        if topic in self.waters:
            for message, _ in islice(part.messages(), WATER_OF_WINDOW):
                if message is not None:
                    self.waters[topic].add(message)
        if topic in self.sensors:
            self.sensors[topic].take(part)
        elif topic in self._still_to_read:
            for message, _ in islice(part.messages(), self._still_to_read[topic]):
                self._still_to_read[topic] -= 1
                if message is not None and self._types[topic] == TF_TYPE:
                    self.transforms += list(message.transforms)
                elif message is not None:
                    self.descriptions.append(message.data)


def _restamped(columns: Mapping[str, TopicColumns], restamp: str, path: Path) -> list[str]:
    """Return the topics stamped by log time instead. Raises InputError for a missing topic."""
    if restamp in ("", RESTAMP_ALL):
        return list(columns) if restamp else []
    found = {name.strip(): spelled(name.strip(), columns) for name in restamp.split(",")}
    for name, topic in found.items():
        if topic is None:
            choices = ", ".join((RESTAMP_ALL, *columns))
            raise InputError(f"{path}: restamp: no topic {name!r} with stamps; there are {choices}")
    return [topic for topic in found.values() if topic is not None]


def _field_maps(bag: BagReader) -> dict[str, str]:
    """Return, for each topic of an unlisted type, a field map that may read its velocity."""
    stores = {topic: bag.typestore(topic) for topic, kind in bag.topics.items() if not is_kept(kind)}
    found = {topic: suggested(store, bag.topics[topic]) for topic, store in stores.items() if store is not None}
    return {topic: text for topic, text in found.items() if text}


def _is_read_in_columns(kind: str) -> bool:
    return kind == IMU_TYPE or VELOCITY_TYPES[kind].is_read_in_columns


def is_static(topic: str, kind: str) -> bool:
    """Return whether a topic describes the positions of the sensors."""
    name = topic.rsplit("/", 1)[-1]
    return (kind == TF_TYPE and name == "tf_static") or (kind == STRING_TYPE and name == "robot_description")


def open_bags(paths: Sequence[Path], dvl_fields: str = "") -> BagReader:
    """Open recordings and recognise their message types. Raises InputError if that fails or dvl_fields fits no type.

    dvl_fields: value of the parameter.
    """
    bag = BagReader(paths, KNOWN_DEFINITIONS)
    forget_mapped(dvl_fields)
    if dvl_fields:
        try:
            _map_types(bag, dvl_fields, ", ".join(map(str, paths)))
        except InputError:
            bag.close()
            raise
    for topic, name in bag.topics.items():
        if name not in VELOCITY_TYPES:
            recognised(name, bag.fields_of(topic))
    return bag


def _map_types(bag: BagReader, text: str, where: str) -> None:
    """Register the message types that a field map fits. Raises InputError if there is none."""
    opened = {kind: bag.typestore(topic) for topic, kind in bag.topics.items() if may_be_mapped(kind)}
    stores = {kind: store for kind, store in opened.items() if store is not None}
    misfits = {kind: misfit(text, store, kind) for kind, store in stores.items()}
    for kind, why in misfits.items():
        if not why:
            mapped_type(kind, text)
    if all(misfits.values()):
        # a type with a suggested field map is the most likely one
        nearest = min(misfits, key=lambda kind: not suggested(stores[kind], kind), default="")
        raise InputError(f"{where}: dvl_fields: {misfits.get(nearest) or 'no topic is of a type that is not listed'}")


# Orientations of poses as IMU data, for recordings without an IMU that has an orientation.
#
# A motion capture measures orientation and position of a vehicle; the turn rates are the orientation's derivative.

# Turn rates are means over this time (s), so that noise of 0.1° per pose gives less than 1 °/s.
RATE_WINDOW_S = 0.2
# orientations whose components differ by no more than this are a constant filled in by the driver
LEAST_CHANGE = 1e-4


def _poses_as_imus(columns: Collection[TopicColumns]) -> list[TopicColumns]:
    """Return the orientations of all topics of poses as IMUs; none if a recorded IMU may have an orientation."""
    imus = [column for column in columns if column.msgtype == IMU_TYPE]
    # messages that cannot be read may have an orientation
    if any(column.unread or hold_orientations(column.values) for column in imus):
        return []
    return [imu for imu in map(orientations_of, columns) if imu is not None]


def orientations_of(poses: TopicColumns) -> TopicColumns | None:
    """Return the orientations of a topic of poses as an IMU's; None for another type or without orientations."""
    if poses.msgtype not in POSE_TYPES or len(poses) < 3:
        return None
    values = np.hstack([poses.extra, np.full((len(poses), 3), np.nan)])
    values[~_are_unit(values)] = np.nan
    if not hold_orientations(values):
        return None
    known = np.flatnonzero(np.isfinite(values[:, 0]))
    values[known, 4:] = _turn_rates(poses.stamped_ns[known], values[known, :4])
    return replace(
        poses, topic=poses.topic + ORIENTATION, msgtype=IMU_TYPE, stamps_ns=poses.stamped_ns, values=values,
        frame=np.zeros_like(poses.frame), covariance=np.full_like(poses.covariance, -1),
        broken=np.zeros_like(poses.broken), extra=np.full((len(poses), 3), np.nan), frames=("",), unread=(), world="",
    )  # fmt: skip


def hold_orientations(values: Array) -> bool:
    """Return whether quaternions (N, 4 or more) are orientations that change; nan is ignored."""
    given = values[_are_unit(values), :4]
    return len(given) > 2 and float(np.ptp(given, axis=0).max()) > LEAST_CHANGE


def _are_unit(values: Array) -> Mask:
    return np.asarray(np.abs(np.einsum("ni,ni->n", values[:, :4], values[:, :4]) - 1.0) < 0.02)


def _turn_rates(stamps_ns: Stamps, quaternions: Array) -> Array:
    """Return angular velocities (N, 3), rad/s, in the body, of orientations (N, 4); nan if stamps do not advance."""
    from scipy.spatial.transform import Rotation

    order = np.argsort(stamps_ns, kind="stable")
    time = 1e-9 * (stamps_ns[order] - stamps_ns.min())
    first = np.searchsorted(time, time - 0.5 * RATE_WINDOW_S)
    last = np.searchsorted(time, time + 0.5 * RATE_WINDOW_S, side="right") - 1
    is_single = first == last  # in slow streams, difference to the neighbours
    first = np.where(is_single, first - 1, first).clip(0)
    last = np.where(is_single, last + 1, last).clip(max=len(time) - 1)
    turns = Rotation.from_quat(quaternions[order])
    seconds = (time[last] - time[first])[:, None]
    rates = np.empty((len(time), 3))
    rates[order] = (turns[first].inv() * turns[last]).as_rotvec() / np.where(seconds > 0.0, seconds, np.nan)
    return rates


def check_topics(recording: Recording, topics: Topics, reasons: list[Reason]) -> None:
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
    _check_types(recording, topics, reasons)
    if not recording.counts[topics.dvl]:
        raise InputError(f"{where}: topic {topics.dvl} holds no messages; was the DVL on? Else set --dvl-topic")
    if topics.gnss not in (*present, NONE):
        reasons.append(finding("BAG_NO_GNSS", topic=topics.gnss))


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


def _check_types(recording: Recording, topics: Topics, reasons: list[Reason]) -> None:
    """Raise InputError for a topic of another or of several types; add missing definitions to `found`."""
    for role, wanted in WANTED_TYPES.items():
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
            reasons.append(finding("BAG_NO_DEFINITION", type=types))


def _likely_dvl_topics(topics: Topics, present: Mapping[str, str]) -> list[str]:
    """Return the likely DVL topics: by a type that only DVLs have, else by name, else any fitting one."""
    fitting = sorted(name for name, kind in present.items() if kind in DVL_TYPES and name != topics.gnss)
    only_dvl = [name for name in fitting if present[name] not in REFERENCE_TYPES]
    return only_dvl or [name for name in fitting if "dvl" in name.lower()] or fitting


def hold_the_same(recorded: Recorded, other_recorded: Recorded) -> bool:
    """Return whether half of one recording's DVL velocities are in the other, at the same stamps."""
    (stamps, values), (other_stamps, other_values) = _velocities(recorded), _velocities(other_recorded)
    if not len(stamps) or not len(other_stamps):
        return False
    matching = np.minimum(np.searchsorted(other_stamps, stamps), len(other_stamps) - 1)
    is_same = (other_stamps[matching] == stamps) & (other_values[matching] == values).all(axis=1)
    return bool(2 * np.count_nonzero(is_same) > min(len(stamps), len(other_stamps)))


def _velocities(topic: Recorded) -> tuple[Stamps, Array]:
    """Return stamps (N,) in order and velocities (N, 3), the first of each stamp."""
    kept = np.flatnonzero(np.isfinite(topic.values).all(axis=1))
    stamps = np.where(topic.stamps_ns == 0, topic.log_ns, topic.stamps_ns)[kept]
    order = np.argsort(stamps, kind="stable")
    first = np.concatenate([[True], np.diff(stamps[order]) > 0])[: len(order)]
    return stamps[order][first], topic.values[kept[order][first]]
