"""Discovery of topics and frames while the node runs, by the same rules as in recordings.

If the DVL's topic has no publisher and another topic may be a DVL's, or if the reference's frame is unknown, all
candidate topics are recorded for a while and examined like a recording. The modules that read recordings are imported
only then: a ROS machine need not have them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array, rotation_from_quaternion
from ..calibration.streams.screening import unit_quaternions
from ..discovery.topic_choice import may_be_dvl
from ..errors import InputError
from .services import AnsweringNode

if TYPE_CHECKING:
    from ..discovery.discovery import Discovery
    from .topic_recorder import TopicRecorder

# Length of a recording, s. It is extended up to MOST_S while a published topic has fewer than ENOUGH messages: a USBL
# gives a position every 5 to 10 s.
LISTEN_S, MOST_S, ENOUGH = 20.0, 60.0, 3
# Length of the mean of unit vectors of the headings, below which the vehicle turned enough (by 90°) to tell a frame of
# the earth from the body's.
ONE_HEADING = 0.9


class _Running(NamedTuple):
    """A recording in progress. ends: closes it. began: monotonic time, s."""

    folder: TemporaryDirectory[str]
    recorder: TopicRecorder
    ends: ExitStack
    began: float


class Discovering:
    """Repeated search, one step per call, until topics and frames are found.

    given: names of parameters that the user set. worker: examines the recordings.
    """

    def __init__(
        self, node: AnsweringNode, parameters: Parameters, given: Collection[str], worker: ThreadPoolExecutor
    ) -> None:
        self._node, self._parameters, self._worker = node, parameters, worker
        self._given = frozenset(given)
        self._recording: _Running | None = None
        self._examination: Future[Discovery] | None = None
        self._said: set[str] = set()

    def step(self, named: Mapping[str, str | None]) -> Discovery | None:
        """Start to record, subscribe to new topics, or examine the recording. Return a result once.

        named: topic by role (dvl, gnss, imu), None where it is searched. With a named DVL the frames are searched,
        until the data decide. Raises InputError if recording or reading fails.
        """
        if self._examination is not None:
            return self._outcome(self._examination)
        if self._recording is None:
            if named["dvl"] is not None or any(self._may_be_dvl()):
                self._begin(named)
            return None
        folder, recorder, ends, began = self._recording
        if recorder.failed is not None:
            raise recorder.failed
        if recorder.look() and time.monotonic() < began + LISTEN_S:
            began = time.monotonic()  # a topic that appears late is recorded as long as the others
            self._recording = self._recording._replace(began=began)
        length_s = LISTEN_S if all(recorder.counts[topic] >= ENOUGH for topic in recorder.topics) else MOST_S
        if time.monotonic() < began + length_s:
            return None
        self._recording = None
        ends.close()
        path = Path(folder.name) / "live"
        self._examination = self._worker.submit(self._examine, folder, path, dict(named))
        return None

    def _may_be_dvl(self) -> list[str]:
        """Return the published topics whose name or type may be a DVL's."""
        own_prefix = f"{self._node.get_fully_qualified_name()}/"
        return [
            topic
            for topic, kinds in self._node.get_topic_names_and_types()
            if not topic.startswith(own_prefix) and any(may_be_dvl(topic, kind) for kind in kinds)
            and self._node.count_publishers(topic)
        ]  # fmt: skip

    def _begin(self, named: Mapping[str, str | None]) -> None:
        """Start to record the topics into a temporary bag. Raises InputError without rosbags."""
        if named["dvl"] is None:
            others = ", ".join(self._may_be_dvl())
            self._say_once(self._node.info, f"the DVL's topic has no publisher; examining the others ({others}) ...")
        else:
            self._say_once(self._node.info, "the frame of the reference is unknown; comparing it with the DVL ...")
        try:
            from ..bags.writer import BagWriter
            from .topic_recorder import TopicRecorder
        except ImportError as error:
            raise InputError(f"discover needs rosbags ({error}); pip install dvl_calib_ros, or remap topics") from error
        folder, ends = TemporaryDirectory(prefix="dvl_calib_"), ExitStack()
        recorder = TopicRecorder(self._node, ends.enter_context(BagWriter(Path(folder.name) / "live")))
        ends.callback(recorder.close)
        recorder.look()
        self._recording = _Running(folder, recorder, ends, time.monotonic())

    def _outcome(self, looked_through: Future[Discovery]) -> Discovery | None:
        """Return the topics found by a finished examination; None while it runs or if it failed."""
        if not looked_through.done():
            return None
        self._examination = None
        try:
            return looked_through.result()
        except InputError as error:
            self._say_once(self._node.warn, str(error))
            return None

    def _say_once(self, say: Callable[[str], None], text: str) -> None:
        if text not in self._said:  # the search repeats, the message does not
            self._said.add(text)
            say(text)

    def close(self) -> None:
        """Stop the search."""
        self._examination = None
        if self._recording is not None:
            folder, _, ends, _ = self._recording
            self._recording = None
            ends.close()
            folder.cleanup()

    def _examine(self, folder: TemporaryDirectory[str], path: Path, named: Mapping[str, str | None]) -> Discovery:
        """Examine the recorded bag for topics, frames, mounting and types of messages. Raises InputError."""
        from ..discovery.discover import discover
        from ..discovery.discovery import Given
        from ..recordings.recording import open_recording

        given = Given(named["dvl"], named["gnss"], named["imu"], self._given)
        with folder:
            try:
                recording = open_recording([path], parameters=self._parameters)
                found = discover(recording, self._parameters, given)
            except InputError as error:
                raise InputError(str(error).replace(str(path), "the topics there are")) from error
        imu = recording.survey.previews.get(found.topics.imu)
        has_turned = imu is not None and _mean_heading_length(imu.values[:, :4]) < ONE_HEADING
        if named["dvl"] is not None and not (has_turned and "gnss_frame" in found.values):
            raise InputError("the frame of the reference is not observable yet: drive a turn, or set gnss_frame")
        # the node itself subtracts clock offsets once two estimates agree
        return replace(found, parameters=recording.of_types(found.topics, self._parameters.replace(**found.values)))


def _mean_heading_length(orientation: Array) -> float:
    """Return the length of the mean unit vector of the headings: 1 on one heading. orientation: (N, 4) x, y, z, w."""
    quaternion = unit_quaternions(orientation)
    ahead = rotation_from_quaternion(quaternion[np.isfinite(quaternion).all(axis=1)])[:, :2, 0]
    return float(np.linalg.norm(ahead.mean(axis=0))) if len(ahead) else 1.0
