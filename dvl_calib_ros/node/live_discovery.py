"""Discovery of topics while the node runs, by the same rules as in recordings.

If the DVL's topic has no publisher and another topic may be a DVL's, all candidate topics are recorded for a while and
examined like a recording. The modules that read recordings are imported only then: a ROS machine need not have them.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

from ..calibration.models.parameters import Parameters
from ..discovery.topic_choice import may_be_dvl
from ..errors import InputError
from .services import AnsweringNode

if TYPE_CHECKING:
    from ..discovery.discovery import Discovery
    from .topic_recorder import TopicRecorder

# Length of a recording, s. It is extended up to MOST_S while a published topic has fewer than ENOUGH messages: a USBL
# gives a position every 5 to 10 s.
LISTEN_S, MOST_S, ENOUGH = 20.0, 60.0, 3


class _Running(NamedTuple):
    """A recording in progress. ends: closes it. began: monotonic time, s."""

    folder: TemporaryDirectory[str]
    recorder: TopicRecorder
    ends: ExitStack
    began: float


class FoundTopics(NamedTuple):
    """Discovered topics. parameters: the given ones, with the types of the messages and the recording's findings."""

    discovery: Discovery
    parameters: Parameters


class Discovering:
    """Repeated search, one step per call, until topics are found.

    named: topic that the user named by role (dvl, gnss, imu), None for the node's own. given: names of parameters that
    the user set. worker: examines the recordings.
    """

    def __init__(
        self,
        node: AnsweringNode,
        named: dict[str, str | None],
        parameters: Parameters,
        given: Collection[str],
        worker: ThreadPoolExecutor,
    ) -> None:
        self._node, self._parameters, self._worker = node, parameters, worker
        self._named, self._given = named, frozenset(given)
        self._recording: _Running | None = None
        self._looked_through: Future[FoundTopics] | None = None
        self._said = ""

    def step(self) -> FoundTopics | None:
        """Start to record, subscribe to new topics, or examine the recording. Return a result once.

        Raises InputError if recording or reading fails.
        """
        if self._looked_through is not None:
            return self._outcome(self._looked_through)
        if self._recording is None:
            if any(self._may_be_dvl()):
                self._begin()
            return None
        folder, recorder, ends, began = self._recording
        if recorder.failed is not None:
            raise recorder.failed
        if recorder.look() and time.monotonic() < began + LISTEN_S:
            began = time.monotonic()  # a topic that appears late is recorded as long as the others
            self._recording = self._recording._replace(began=began)
        waits_for = LISTEN_S if all(recorder.counts[topic] >= ENOUGH for topic in recorder.topics) else MOST_S
        if time.monotonic() < began + waits_for:
            return None
        self._recording = None
        ends.close()
        path = Path(folder.name) / "live"
        self._looked_through = self._worker.submit(self._look_through, folder, path)
        return None

    def _may_be_dvl(self) -> list[str]:
        own_prefix = f"{self._node.get_fully_qualified_name()}/"
        return [
            topic
            for topic, kinds in self._node.get_topic_names_and_types()
            if not topic.startswith(own_prefix) and any(may_be_dvl(topic, kind) for kind in kinds)
            and self._node.count_publishers(topic)
        ]  # fmt: skip

    def _begin(self) -> None:
        topics = ", ".join(self._may_be_dvl())
        self._node.info(f"the DVL's topic has no publisher; examining the others ({topics}) ...")
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

    def _outcome(self, looked_through: Future[FoundTopics]) -> FoundTopics | None:
        if not looked_through.done():
            return None
        self._looked_through = None
        try:
            return looked_through.result()
        except InputError as error:
            if str(error) != self._said:  # the search repeats, the message does not
                self._said = str(error)
                self._node.warn(self._said)
            return None

    def close(self) -> None:
        """Stop recording."""
        if self._recording is not None:
            folder, _, ends, _ = self._recording
            self._recording = None
            ends.close()
            folder.cleanup()

    def _look_through(self, folder: TemporaryDirectory[str], path: Path) -> FoundTopics:
        from ..discovery.discover import discover
        from ..discovery.discovery import Given
        from ..recordings.recording import open_recording

        given = Given(self._named["dvl"], self._named["gnss"], self._named["imu"], self._given)
        with folder:
            try:
                recording = open_recording([path], parameters=self._parameters)
                found = discover(recording, self._parameters, given)
            except InputError as error:
                raise InputError(str(error).replace(str(path), "the topics there are")) from error
        # the node itself subtracts clock offsets once two estimates agree
        return FoundTopics(found, recording.of_types(found.topics, self._parameters.replace(**found.values)))
