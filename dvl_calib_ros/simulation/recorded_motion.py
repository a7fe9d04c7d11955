"""Motion of a recorded vehicle for simulated sensors: reference velocity and attitude of a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import ENU_FROM_NED, Array
from ..calibration.numerics.samples import (
    FRAME_CODES,
    Codes,
    Index,
    SampleBlock,
    Stamps,
    Stream,
    VelocityFrame,
    no_samples,
)
from ..calibration.streams.interpolation import linear_at
from ..calibration.streams.screening import are_valid_velocities, unit_quaternions
from ..errors import InputError
from ..messages.decode import MessageDecoder
from ..messages.drivers import IMU_TYPE, REFERENCE_TYPES
from ..recordings.recording import Recording as Opened
from ..recordings.recording import open_recording
from ..recordings.topics import Topics
from .trajectories import Motion

# across longer gaps the motion is unknown
MAX_GAP_S = 2.5
SHORTEST_S = 10.0
# attitude is thinned to this interval, because noise of faster samples would look like angular velocity
ATTITUDE_STEP_S = 0.05


@dataclass(frozen=True)
class MotionSource:
    """Location of a bag's motion.

    gnss_frame: as the parameter. smoothing: s, standard deviation of the window that removes the receiver's noise from
    the velocity (in the body frame, so turns keep their speed).
    """

    path: Path
    gnss_topic: str = "gnss/twist"
    imu_topic: str = "imu/data"
    gnss_frame: str = "from_frame_id"
    smoothing: float = 1.0

    @property
    def topics(self) -> Topics:
        """Topics of reference and IMU."""
        return Topics(gnss=self.gnss_topic, imu=self.imu_topic)

    @cached_property
    def opened(self) -> Opened:
        """The opened recording. Raises InputError."""
        return open_recording([self.path], self.topics)


@dataclass(frozen=True)
class _Samples:
    """Recorded samples.

    Times (N,) s and velocities (N, 3) m/s with their frames (N), indices into `FRAMES`; times (M,) s and quaternions
    (M, 4) xyzw.
    """

    velocity_time: Array
    velocity: Array
    frames: Codes
    attitude_time: Array
    attitude: Array


def recorded_motion(recording: MotionSource, rate_hz: float, seconds: float | None = None) -> Motion:
    """Return the motion of a bag's longest stretch without a gap, sampled at a rate from time 0.

    seconds: use only this long a start of it. Raises InputError if reference velocity and attitude do not overlap for
    long enough.
    """
    samples = _read(recording)
    start, end = _longest_stretch(recording, samples)
    time = np.arange(0.0, min(end - start, seconds or np.inf), 1.0 / rate_hz)
    attitude_time, attitude = _thinned(samples.attitude_time, samples.attitude)
    spline = RotationSpline(attitude_time, Rotation.from_quat(attitude))
    velocity = _in_body(samples, spline)
    at = start + time
    on_grid = linear_at(samples.velocity_time, velocity, at)
    if recording.smoothing > 0.0:
        on_grid = gaussian_filter1d(on_grid, recording.smoothing * rate_hz, axis=0, mode="nearest")
    rotation = spline(at)
    return Motion(time, on_grid, rotation.as_matrix(), spline(at, 1))


def _read(recording: MotionSource) -> _Samples:
    """Read valid reference velocities and attitudes. Raises InputError for less than two."""
    opened = recording.opened
    topics = recording.topics.found_in(opened.types)
    _check_topics(recording, topics, opened.types)
    parameters = Parameters(gnss_frame=recording.gnss_frame, gnss_type=opened.types[topics.gnss])
    decoder = MessageDecoder(parameters)
    references, attitudes = [no_samples(Stream.REFERENCE)], [no_samples(Stream.IMU)]
    for stretch in opened.stretches({topics.gnss: Stream.REFERENCE, topics.imu: Stream.IMU}, decoder):
        _, reference, imu = stretch.streams
        valid = are_valid_velocities(reference.values, parameters.max_speed)
        references.append(reference.part((reference.refused == 0) & valid))
        attitudes.append(imu.part((imu.refused == 0) & ~np.isnan(unit_quaternions(imu.orientation)[:, 0])))
    velocity_ns, at = _last_of_each(references)
    attitude_ns, attitude_at = _last_of_each(attitudes)
    for what, stamps_ns in ((recording.gnss_topic, velocity_ns), (recording.imu_topic, attitude_ns)):
        if len(stamps_ns) < 2:
            raise InputError(
                f"{recording.path}: {what} holds {len(stamps_ns)} usable samples; a motion takes reference velocity "
                f"and attitude. {' '.join(map(str, decoder.problems.values()))}".strip()
            )
    first_ns = min(velocity_ns[0], attitude_ns[0])
    return _Samples(
        1e-9 * (velocity_ns - first_ns),
        np.concatenate([reference.values for reference in references])[at],
        np.concatenate([reference.frames for reference in references])[at],
        1e-9 * (attitude_ns - first_ns),
        unit_quaternions(np.concatenate([attitude.orientation for attitude in attitudes])[attitude_at]),
    )


def _last_of_each(blocks: Sequence[SampleBlock]) -> tuple[Stamps, Index]:
    """Return the unique stamps, in order, and the last row of each, counted over all blocks."""
    stamps_ns = np.concatenate([block.stamps_ns for block in blocks])
    found, from_the_end = np.unique(stamps_ns[::-1], return_index=True)
    return found, len(stamps_ns) - 1 - from_the_end


def _check_topics(recording: MotionSource, topics: Topics, present: Mapping[str, str]) -> None:
    """Raise InputError unless the recording has a reference and an IMU topic."""
    for name, types in ((topics.gnss, tuple(REFERENCE_TYPES)), (topics.imu, (IMU_TYPE,))):
        if present.get(name) not in types:
            listing = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(present.items())) or "none"
            raise InputError(
                f"{recording.path}: no topic {name!r} of {' or '.join(types)}; set --motion-topics. "
                f"The bag has: {listing}"
            )


def _longest_stretch(recording: MotionSource, samples: _Samples) -> tuple[float, float]:
    """Return the longest time (from, to) without a gap in velocity or attitude."""
    common = [
        (max(a, c), min(b, d))
        for a, b in _stretches(samples.velocity_time)
        for c, d in _stretches(samples.attitude_time)
    ]
    start, end = max(common, key=lambda stretch: stretch[1] - stretch[0])
    if end - start < SHORTEST_S:
        raise InputError(
            f"{recording.path}: velocity and attitude come together for {max(end - start, 0.0):.1f} s without a gap "
            f"of {MAX_GAP_S:g} s, a motion takes {SHORTEST_S:g} s; use a longer recording"
        )
    return start, end


def _stretches(time: Array) -> list[tuple[float, float]]:
    gaps = np.flatnonzero(np.diff(time) > MAX_GAP_S)
    bounds = [0, *(gaps + 1).tolist(), len(time)]
    return [(float(time[first]), float(time[last - 1])) for first, last in pairwise(bounds)]


def _thinned(time: Array, values: Array) -> tuple[Array, Array]:
    every = max(1, round(ATTITUDE_STEP_S / float(np.median(np.diff(time)))))
    return time[::every], values[::every]


def _in_body(samples: _Samples, attitude: RotationSpline) -> Array:
    """Return velocities (N, 3) m/s in the body frame."""
    earth = samples.velocity.copy()
    is_ned = samples.frames == FRAME_CODES[VelocityFrame.NED]
    is_body = samples.frames == FRAME_CODES[VelocityFrame.BODY]
    earth[is_ned] = earth[is_ned] @ ENU_FROM_NED.T
    span = np.clip(samples.velocity_time, samples.attitude_time[0], samples.attitude_time[-1])
    rotated = attitude(span).inv().apply(earth)
    return np.where(is_body[:, None], samples.velocity, rotated)
