"""Fuzz targets of more than one thing at once: parameters with data, and names of files with what is done to them."""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
from drawn import Drawn
from io_fixtures import mcap_bytes, raw, run, write_bag

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.models.parameters import ParameterError, Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, Stream, VelocityFrame
from dvl_calib_ros.diagnosis.diagnose import diagnose
from dvl_calib_ros.disk.atomic import backup_of, check_writable, save_bytes
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.examination.examine import examine
from dvl_calib_ros.files.output_paths import check_outputs
from dvl_calib_ros.files.result_file import result_document
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics

_STEPS_NS = (0, 1, 50_000_000, 200_000_000, 199_000_000, -50_000_000, 10**9, 3 * 10**9, -(10**9), 60 * 10**9, 10**17)
_MOST_ROWS = 60

# ---------------------------------------------------------------------- stamps

_WILD = struct.Struct("<HBi")


@cache
def _messages() -> tuple[tuple[str, int, bytes], ...]:
    """Topic, log time and bytes of a small recording, in which each stream has its rate."""
    samples = [sample for i, sample in enumerate(run(40.0)) if not isinstance(sample, ImuSample) or i % 4 == 0]
    with tempfile.TemporaryDirectory() as folder:
        return tuple(raw(write_bag(Path(folder) / "bag", samples)))


def run_stamps(data: bytes, folder: Path) -> None:
    """Stamps and log times that are wild for one message, or from one on: memory is that of the messages.

    Of each seven bytes two say which message, one what is changed, and four by how many seconds, or to which second.
    """
    messages = list(_messages())
    for place, what, seconds in _WILD.iter_unpack(data[: len(data) // _WILD.size * _WILD.size][: 12 * _WILD.size]):
        first = place % len(messages)
        for at in range(first, len(messages) if what & 8 else first + 1):
            topic, log_ns, content = messages[at]
            if what & 16 and topic != messages[first][0]:
                continue
            order = "little" if content[1] & 1 else "big"
            stamp_s = seconds if what & 4 else int.from_bytes(content[4:8], order, signed=True) + seconds
            if what & 1:
                stamp = max(-(2**31), min(stamp_s, 2**31 - 1)).to_bytes(4, order, signed=True)
                content = content[:4] + stamp + content[8:]
            if what & 2:
                log_ns = max(0, (0 if what & 4 else log_ns) + seconds * 10**9)
            messages[at] = topic, log_ns, content
    path = folder / "stamps.mcap"
    path.write_bytes(mcap_bytes(sorted(messages, key=lambda message: message[1])))
    parameters = Parameters()
    for command in (examine, replay, diagnose):
        recording = open_recording([path], parameters=parameters)
        try:
            command(recording, parameters, *([Topics()] if command is diagnose else []))
        except InputError as error:
            assert str(error)


def stamps_seeds() -> Iterator[bytes]:
    yield _WILD.pack(0, 1 | 4, 5)
    yield _WILD.pack(300, 1 | 4, 2_145_916_800)
    yield _WILD.pack(100, 1 | 2 | 8, 86_400 * 30) + _WILD.pack(200, 1 | 2 | 8, -3600)
    # streams that are known together for seconds: a diagnosis fell over the few bins
    yield _WILD.pack(7, 1 | 8 | 16, 400) + _WILD.pack(900, 2, -86_400 * 8)


# ---------------------------------------------------------------------- parameters and data


def parameters_of(drawn: Drawn) -> Parameters | None:
    """Up to seven parameters are set; None if they are refused, as they are for users, by name."""
    values = dict(drawn.setting() for _ in range(drawn.byte() % 8))
    try:
        return Parameters(**values)
    except ParameterError as error:
        assert any(name in str(error) for name in values)
        return None


def assert_sound(calibrator: Calibrator) -> None:
    """Numbers that may be published and saved, of every model."""
    for name in MODELS:
        state, covariance = calibrator.published(name)
        assert np.isfinite(state).all() and np.isfinite(covariance).all(), name
        assert (covariance.diagonal() >= 0.0).all() and (covariance == covariance.T).all(), name


def run_settings(data: bytes) -> None:
    """Any parameters inside their bounds with any samples: estimates finite, everything counted."""
    drawn = Drawn(data)
    parameters = parameters_of(drawn)
    if parameters is None:
        return
    try:
        calibrator = Calibrator(parameters, block_size=drawn.one_of((64, 1, 64, 7)))
    except (ParameterError, InputError) as error:
        assert str(error)
        return
    received = dict.fromkeys(Stream, 0)
    stamp_ns = 1_700_000_000_000_000_000
    covariance = None
    for _ in range(_MOST_ROWS):
        if not drawn.has_more:
            break
        kind = drawn.byte()
        stamp_ns += drawn.one_of(_STEPS_NS)
        stream = list(Stream)[kind % 3]
        received[stream] += 1
        if kind & 64:
            covariance = np.diag([abs(drawn.number()) if kind & 128 else drawn.number() for _ in range(3)])
        if stream is Stream.IMU:
            orientation = (drawn.near(0.0), drawn.near(0.0), drawn.near(0.0), drawn.near(1.0))
            rates = (drawn.near(0.0), drawn.near(0.0), drawn.near(0.1))
            calibrator.feed_imu(ImuSample(stamp_ns, orientation, rates))
            continue
        velocity = (drawn.near(1.5), drawn.near(0.0), drawn.near(0.0))
        if stream is Stream.DVL:
            calibrator.feed_dvl(DvlSample(stamp_ns, velocity, covariance))
        else:
            frame = list(VelocityFrame)[(kind // 3) % len(VelocityFrame)]
            calibrator.feed_reference(ReferenceSample(stamp_ns, velocity, covariance, frame))
    calibrator.finish()
    for stream, count in received.items():  # a start anew, after stamps that go back for good, counts anew
        assert calibrator.restarts or calibrator.counts[stream.value]["received"] == count
    assert_sound(calibrator)
    if len(data) % 4 == 0:  # what is said about the numbers takes as long as finding them
        assert result_document(calibrator.result(), "dvl_link")


def settings_seeds() -> Iterator[bytes]:
    row = {"dvl": bytes([0, 3, 128, 128, 128]), "reference": bytes([1, 0, 128, 128, 128])}
    imu = bytes([2, 2, 128, 128, 128, 128, 128, 128, 128])
    yield bytes([0, 2]) + (imu + row["reference"] + row["dvl"]) * 8
    for first in range(0, 60, 6):
        yield bytes([2, first, 100, 100, 100, first + 3, 30, 30, 30, 0]) + (row["dvl"] + row["reference"] + imu) * 6


# ---------------------------------------------------------------------- names of files


class Names:
    """What `run_names` works in, made anew for every input: an input, a folder that is read, and links to both."""

    def __init__(self, parent: Path, recording: bytes) -> None:
        self.folder = parent / "names"
        self._recording = recording

    def make(self) -> None:
        """As it was before."""
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.folder / "below" / "bag").mkdir(parents=True)
        for name in ("in.mcap", "below/bag/a.mcap"):
            (self.folder / name).write_bytes(self._recording)
        os.link(self.folder / "in.mcap", self.folder / "hard")
        for name, target in (("soft", "in.mcap"), ("to_bag", "below/bag"), ("dangling", "nowhere"), ("loop", "loop")):
            (self.folder / name).symlink_to(target)

    def place(self, name: str) -> Path | None:
        """Where a name leads, None outside of the folder."""
        path = Path(os.path.join(self.folder, name.lstrip("/")))
        try:
            inside = os.path.realpath(path).startswith(f"{self.folder}{os.sep}")
        except ValueError:  # a null character
            inside = True
        return path if inside else None

    @property
    def inputs_are_untouched(self) -> bool:
        """Whether what is read is still there, byte for byte, and nothing has come into the bag."""
        bag = self.folder / "below" / "bag"
        files = (self.folder / "in.mcap", bag / "a.mcap", self.folder / "hard")
        return all(each.read_bytes() == self._recording for each in files) and os.listdir(bag) == ["a.mcap"]


def run_names(data: bytes, names: Names) -> None:
    """Three names, one a line: two are written unless refused, never over an input; the third is read as a recording.

    What was written is there, whole, under the name that was given.
    """
    texts = [*data.decode("utf-8", "surrogateescape").split("\n"), "", ""][:3]
    names.make()
    places = [names.place(text) for text in texts]
    if None in places[:2]:
        return
    first, second = places[0], places[1]
    assert first is not None and second is not None
    try:
        for path in (first, second):
            check_writable(path)
        inputs = [names.folder / "in.mcap", names.folder / "to_bag"]
        check_outputs({"--json": first, "--report": second}, inputs)
        save_bytes(first, b"one")
        save_bytes(second, b"two")
        save_bytes(first, b"three")
    except InputError as error:
        assert "\n" not in str(error).replace("\n".join(texts), "") or "\n" in str(first)
    else:
        # resolved, as the product does: `missing/../x` is x
        one, other = (Path(os.path.realpath(path)) for path in (first, second))
        assert one.read_bytes() == b"three" and other.read_bytes() == b"two"
        assert backup_of(first).read_bytes() == b"one"
    assert names.inputs_are_untouched
    assert not [name for name in os.listdir(names.folder) if name.startswith(".dvl_calib.")]
    if places[2] is not None:
        _read(places[2])
        assert names.inputs_are_untouched


def _read(path: Path) -> None:
    try:
        with BagReader([path]) as bag:
            assert all(channel.topic in bag.topics for _, channel, _ in bag.raw_messages(bag.topics))
    except InputError as error:
        assert str(error)


def names_seeds() -> Iterator[bytes]:
    yield from (b"a.json\nb.html\nin.mcap", b"soft\nhard\nto_bag", b"in.mcap.bak\n./in.mcap\nbelow//bag/../bag")
    yield from (b"run#1?x%31\nrun\xc2\xb2_1.mcap\nsoft", b"dangling\nloop\nloop", b"below/new\nto_bag/x\nbelow")
    yield from (b"a\na.bak\n.", b"a\x00b\n\xff\xfe\nhard", b"." * 300 + b"\n" + b"x" * 255 + b"\nin.mcap/")
