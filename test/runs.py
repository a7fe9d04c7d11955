"""Simulated runs for the tests of the core: matched to the models, so that what comes out is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.error_model import distort
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import (
    FRAME_CODES,
    Covariances,
    DvlSample,
    ImuSample,
    ReferenceSample,
    SampleBlock,
    Stream,
    Streams,
    VelocityFrame,
    sample_block,
)
from dvl_calib_ros.simulation.trajectories import Motion, make_motion

START_NS = 1_700_000_000_123_456_789
SECOND = 1_000_000_000
# Samples of a stretch of a recording, and those that models are updated by at once.
STRETCH = 512
# For what is tried sample by sample: as much time in fewer samples.
ONE_HERTZ = {"dvl_every": 100, "gnss_every": 100, "imu_every": 50}


@dataclass(frozen=True)
class MatchedRun:
    """What to simulate. phi: rad. scale: one number. Rates in Hz."""

    trajectory: str = "box"
    seconds: float = 120.0
    phi: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 0.0
    dvl_std: float = 0.0
    gnss_std: float = 0.0
    mounting_rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    frame: VelocityFrame = VelocityFrame.BODY
    dvl_every: int = 20  # of the motion's 100 Hz
    gnss_every: int = 20
    gnss_phase: int = 0
    imu_every: int = 5
    dvl_late_ns: int = 0
    seed: int = 0


def make_samples(run: MatchedRun) -> list[DvlSample | ReferenceSample | ImuSample]:
    """All samples in order of stamps (of measurement), IMU first, then GNSS, then DVL."""
    return list(_made(run))


@cache
def _made(run: MatchedRun) -> tuple[DvlSample | ReferenceSample | ImuSample, ...]:
    rng = np.random.default_rng(run.seed)
    motion, orientations = _motion(run.trajectory, run.seconds)
    mounting = rotation_from_rpy(run.mounting_rpy).T
    at_dvl = motion.velocity_body + np.cross(motion.angular_velocity, run.lever_arm)
    measured = distort(at_dvl, np.array(run.phi), np.full(3, run.scale), mounting)
    measured = measured + rng.normal(0.0, run.dvl_std, measured.shape)
    reference = motion.velocity_body + rng.normal(0, run.gnss_std, motion.velocity_body.shape)
    if run.frame is not VelocityFrame.BODY:
        reference = np.einsum("nij,nj->ni", motion.rotation_enu_from_body, reference)
    if run.frame is VelocityFrame.NED:
        reference = reference[:, [1, 0, 2]] * [1, 1, -1]
    stamps = [START_NS + round(t * 1e9) for t in motion.time]
    samples: list = []
    for i, stamp in enumerate(stamps):
        if run.imu_every and i % run.imu_every == 0:
            samples.append(ImuSample(stamp, orientations[i], tuple(motion.angular_velocity[i].tolist())))
        if run.gnss_every and (i - run.gnss_phase) % run.gnss_every == 0:
            samples.append(ReferenceSample(stamp, tuple(reference[i].tolist()), None, run.frame))
        if i % run.dvl_every == 0:
            samples.append(DvlSample(stamp + run.dvl_late_ns, tuple(measured[i].tolist())))
    return tuple(samples)


@cache
def _motion(trajectory: str, seconds: float) -> tuple[Motion, list[tuple[float, ...]]]:
    """At 100 Hz, and its orientations: hundreds of runs have the same."""
    motion = make_motion(trajectory, seconds, 100.0)
    return motion, [quaternion_from_rotation(rotation) for rotation in motion.rotation_enu_from_body]


def feed(calibrator: Calibrator, samples) -> Calibrator:
    for sample in samples:
        if isinstance(sample, DvlSample):
            calibrator.feed_dvl(sample)
        elif isinstance(sample, ReferenceSample):
            calibrator.feed_reference(sample)
        else:
            calibrator.feed_imu(sample)
    return calibrator


def streams_of(samples) -> Streams:
    """Samples as a recording's columns, in this order of arrival; test_alignment.py shows that it is the same."""
    of: dict[Stream, list[tuple[int, DvlSample | ReferenceSample | ImuSample]]] = {stream: [] for stream in Stream}
    kinds = {DvlSample: Stream.DVL, ReferenceSample: Stream.REFERENCE, ImuSample: Stream.IMU}
    for arrival, sample in enumerate(samples):
        of[kinds[type(sample)]].append((arrival, sample))
    return Streams(*(_block_of(stream, *zip(*of[stream], strict=True)) for stream in Stream))


def _block_of(stream: Stream, arrival=(), samples=()) -> SampleBlock:
    values = [_row(sample) for sample in samples]
    given = [None if isinstance(sample, ImuSample) else sample.covariance for sample in samples]
    distinct = {id(each): np.asarray(each, dtype=float) for each in given if each is not None}
    places = {key: place for place, key in enumerate(distinct)}
    index = np.array([-1 if each is None else places[id(each)] for each in given], dtype=np.intp)
    frames = [FRAME_CODES[getattr(sample, "frame", VelocityFrame.BODY)] for sample in samples]
    return sample_block(
        stream, np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
        np.array(values, dtype=float).reshape(len(samples), 7 if stream is Stream.IMU else 3),
        covariance=Covariances(np.array([*distinct.values()]).reshape(-1, 3, 3), index),
        frames=np.array(frames, dtype=np.uint8), arrival=np.array(arrival, dtype=np.int64),
    )  # fmt: skip


def _row(sample):
    if not isinstance(sample, ImuSample):
        return sample.velocity
    return (*(sample.orientation or [np.nan] * 4), *(sample.angular_velocity or [np.nan] * 3))


def feed_columns(calibrator: Calibrator, samples) -> Calibrator:
    """As `feed`, a tenth of the work."""
    samples = list(samples)
    for start in range(0, len(samples), STRETCH):
        calibrator.feed(streams_of(samples[start : start + STRETCH]))
    return calibrator


def calibrate(samples, parameters: Parameters | None = None, block_size: int = STRETCH, **options) -> Calibrator:
    """With recorded columns, or one by one, where another block_size than theirs is asked for."""
    feed_all = feed_columns if block_size == STRETCH else feed
    return feed_all(Calibrator(parameters or Parameters(), block_size=block_size, **options), samples)


def only(samples, *kinds):
    return [sample for sample in samples if isinstance(sample, kinds)]


def altered(samples, kinds, **fields):
    """The samples, those of these kinds with other values in these fields, or with what a function makes of each."""
    return [
        sample._replace(**{name: value(sample) if callable(value) else value for name, value in fields.items()})
        if isinstance(sample, kinds)
        else sample
        for sample in samples
    ]


def shifted(samples, nanoseconds: int, kinds=(DvlSample, ReferenceSample, ImuSample)):
    return altered(samples, kinds, stamp_ns=lambda sample: sample.stamp_ns + nanoseconds)


def pushed(samples, kinds, push):
    """The samples, to the velocities of these kinds added what `push` gives of a sample: (3,) m/s."""
    return altered(samples, kinds, velocity=lambda sample: tuple(np.add(sample.velocity, push(sample)).tolist()))


def without(samples, kind, is_lost):
    """The samples but for those of a kind that are lost by their time since the start, s."""
    return [each for each in samples if not (isinstance(each, kind) and is_lost((each.stamp_ns - START_NS) / SECOND))]


def variant(run: MatchedRun, **changes) -> MatchedRun:
    return replace(run, **changes)
