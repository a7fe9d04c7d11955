"""Tiny recordings for the tests of files and commands."""

from __future__ import annotations

import heapq
import io
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.typesys import Stores, get_typestore

from dvl_calib_ros.bag_replay.replay import Replayed, replay
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Compression, Storage
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, Stream, VelocityFrame
from dvl_calib_ros.calibration.results.results import Result
from dvl_calib_ros.files.result_file import result_document, result_text
from dvl_calib_ros.messages.decode import MessageDecoder
from dvl_calib_ros.messages.drivers import IMU_TYPE, TWIST_TYPE
from dvl_calib_ros.messages.encode import SampleWriter
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

TOPICS = {"dvl/twist": TWIST_TYPE, "gnss/twist": TWIST_TYPE, "imu/data": IMU_TYPE}
Sample = DvlSample | ReferenceSample | ImuSample
JAZZY = get_typestore(Stores.ROS2_JAZZY)


@cache
def run(seconds: float = 40.0, frame: VelocityFrame = VelocityFrame.ENU) -> tuple[Sample, ...]:
    """A simulated run, in order of stamps."""
    errors = DvlErrors((0.02, -0.03, 0.05), (0.004,) * 3, beam_std=0.005)
    samples = simulate(Scenario(seconds=seconds, errors=errors, gnss_frame=frame))
    return tuple(heapq.merge(samples.imu, samples.gnss, samples.dvl, key=lambda sample: sample.stamp_ns))


def write_bag(
    path: Path,
    samples: Iterable[Sample],
    storage: str = "mcap",
    compression: str = "none",
    dvl_frame: str = "dvl_link",
    prefix: str = "",
) -> Path:
    """A bag of samples; of those of `run`, which hundreds of tests write, a copy of the one that was written first."""
    key = (id(samples), path.name, storage, compression, dvl_frame, prefix)
    if key not in _WRITTEN:
        _write_bag(path, samples, storage, compression, dvl_frame, prefix)
        if isinstance(samples, tuple):
            kept = Path(_FOLDER.name) / str(len(_WRITTEN))
            shutil.copytree(path, kept)
            _WRITTEN[key] = kept, samples  # which keeps its id
        return path
    return Path(shutil.copytree(_WRITTEN[key][0], path, copy_function=shutil.copy))


_FOLDER = tempfile.TemporaryDirectory()
_WRITTEN: dict[tuple[Any, ...], tuple[Path, Iterable[Sample]]] = {}


def _write_bag(
    path: Path, samples: Iterable[Sample], storage: str, compression: str, dvl_frame: str, prefix: str
) -> None:
    frame_ids = {VelocityFrame.ENU: "map", VelocityFrame.NED: "ned", VelocityFrame.BODY: "base_link"}
    with BagWriter(path, Storage(storage), Compression(compression)) as bag:
        writer = SampleWriter(bag)
        for sample in samples:
            if isinstance(sample, DvlSample):
                writer.dvl(f"{prefix}dvl/twist", sample, dvl_frame)
            elif isinstance(sample, ReferenceSample):
                writer.reference(f"{prefix}gnss/twist", sample, frame_ids[sample.frame])
            else:
                writer.imu(f"{prefix}imu/data", sample)


def storage_file(bag: Path) -> Path:
    """The one file in a bag that is not metadata.yaml."""
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    return file


def rewrite(path: Path, change: Callable[[str, Any], Any], samples: Iterable[Sample]) -> Path:
    """A bag of these samples with every message changed: change(topic, message) -> message, or None to leave it out."""
    source = write_bag(path.with_name(f"{path.name}_source"), samples)
    with BagReader([source]) as bag:
        messages = [(topic, log_ns, change(topic, message)) for topic, log_ns, message, _ in bag.messages(TOPICS)]
    with BagWriter(path) as bag:
        for topic, log_ns, message in messages:
            if message is not None:
                bag.message(topic, TOPICS[topic], log_ns, message)
    return path


def mcap_bytes(
    messages: Iterable[tuple[str, int, bytes]], definitions: Mapping[str, tuple[str, str]] | None = None, **options: Any
) -> bytes:
    """An MCAP file as the mcap library writes it: with checksums, small chunks, any compression.

    definitions: topic -> type and its definition, for topics of other types than `TOPICS` says.
    """
    output = io.BytesIO()
    writer = McapWriter(output, **{"chunk_size": 2048, "compression": CompressionType.NONE, **options})
    writer.start("ros2")
    channels: dict[str, int] = {}
    for topic, log_ns, data in messages:
        if topic not in channels:
            msgtype, definition = (definitions or {}).get(topic) or _standard(topic)
            schema = writer.register_schema(msgtype, "ros2msg", definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channels[topic], log_ns, data, log_ns)
    writer.finish()
    return output.getvalue()


def _standard(topic: str) -> tuple[str, str]:
    definition, _ = JAZZY.generate_msgdef(TOPICS[topic], ros_version=2)
    return TOPICS[topic], definition


def raw(*paths: Path) -> list[tuple[str, int, bytes]]:
    return raw_and_notes(*paths)[0]


def raw_and_notes(*paths: Path) -> tuple[list[tuple[str, int, bytes]], list[str]]:
    with BagReader(paths) as bag:
        return [(channel.topic, log_ns, data) for log_ns, channel, data in bag.raw_messages(bag.topics)], bag.notes


def replayed(*paths: Path, **parameters: Any) -> Replayed:
    return replay(paths, Parameters(**parameters))


class Numbers(list[float]):
    """Numbers that are equal but for rounding: numpy's sums depend on where in memory an array begins."""

    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, list):
            return NotImplemented
        return len(self) == len(other) and np.allclose(self, other, 1e-9, 1e-12)


def estimates(*paths: Path, **parameters: Any) -> dict[str, Numbers]:
    """Model -> state and covariance, to be compared."""
    result = replayed(*paths, **parameters).result
    return {name: Numbers([*each.state, *np.ravel(each.covariance)]) for name, each in result.estimates.items()}


def selected_alone(result: Result) -> str:
    """A result file of the selected model: to parse the others is most of the time of a command that reads it."""
    document = result_document(result)
    return result_text({**document, "models": {document["model"]: document["models"][document["model"]]}})


def steady_run(count: int, seed: int = 7) -> list[Sample]:
    """DVL and body reference at the same stamps: nothing waits for a partner where such a run is cut."""
    rng = np.random.default_rng(seed)
    samples: list[Sample] = []
    for i in range(count):
        stamp = 1_700_000_000_000_000_000 + i * 200_000_000
        truth = np.array([1.5 + 0.3 * np.sin(i / 9), 0.2 * np.cos(i / 7), 0.0])
        measured = truth + np.cross((0.02, -0.03, 0.05), truth) + rng.normal(0, 0.01, 3)
        samples.append(ReferenceSample(stamp, tuple((truth + rng.normal(0, 0.05, 3)).tolist())))
        samples.append(DvlSample(stamp, tuple(measured.tolist())))
    return samples


def live(bag: Path, parameters: Parameters, topics: Topics | None = None) -> Calibrator:
    """A calibrator as the node has one, after all of a bag."""
    recording, topics = open_recording([bag]), topics or Topics()
    calibrator = Calibrator(parameters, worker=AtOnce())
    named = {topics.imu: Stream.IMU, topics.gnss: Stream.REFERENCE, topics.dvl: Stream.DVL}
    for stretch in recording.stretches(named, MessageDecoder(parameters)):
        calibrator.feed(stretch.streams)
    return calibrator
