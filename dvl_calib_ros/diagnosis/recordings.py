"""What a diagnosis looks at: recordings as aligned arrays on the DVL's stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from ..calibration.clocks import SECOND_NS
from ..calibration.frames import Array, rotation_from_quaternion
from ..calibration.models import Needs as Partners
from ..calibration.observe import Observer
from ..calibration.parameters import Parameters
from ..calibration.samples import AlignedBlock, VelocityFrame
from ..effects.base import Needs
from ..errors import InputError
from ..replay.replay import Topics, replay

# Samples are thinned to the first and averaged to the second to test hypotheses: what the effects do lies below 1 Hz,
# and five hours must fit. Traces are computed at the third at least, so that delays and lags are exact.
MAX_RATE_HZ = 10.0
MAX_TEST_RATE_HZ = 5.0
# Samples of one recording that hypotheses are tested on: 40 minutes at the rate above; longer ones are averaged more
MAX_TEST_SAMPLES = 12_000
MIN_TRACE_RATE_HZ = 8.0
# Share of the DVL's samples that must have attitude and angular velocity for them to be used at all
MIN_ORIENTED_SHARE = 0.5


@dataclass(frozen=True)
class Recording:
    """One recording, N samples in order of time, which are averaged to M before hypotheses are tested.

    name: of the bag. time: (N,) s since its first sample. velocity_dvl: (N, 3) m/s, DVL frame, at the reference point.
    reference_body: (N, 3) m/s. bins: (M + 1,) where the groups of samples begin and end that are averaged.
    reported_variance: (N, 3) (m/s)² of the difference, DVL frame, or None where the messages give none.
    rotation_enu_from_body: (N, 3, 3) and angular_velocity: (N, 3) rad/s, body, or None. reference_around: (N, 2) s, as
    in `Observations`. reference_frame: in which the reference was recorded. repeats: of `received` DVL samples, how
    many have the very velocity of the one before.
    """

    name: str
    time: Array
    velocity_dvl: Array
    reference_body: Array
    bins: NDArray[np.intp]
    reported_variance: Array | None = None
    rotation_enu_from_body: Array | None = None
    angular_velocity: Array | None = None
    reference_around: Array | None = None
    reference_frame: VelocityFrame = VelocityFrame.ENU
    repeats: int = 0
    received: int = 0

    @property
    def available(self) -> frozenset[Needs]:
        """What effects may need and this recording has."""
        has = {Needs.ATTITUDE: self.rotation_enu_from_body, Needs.ANGULAR_VELOCITY: self.angular_velocity}
        return frozenset(need for need, values in has.items() if values is not None)

    def averaged(self, values: Array) -> Array:
        """Means (M, ...) of values (N, ...) over the bins."""
        if len(self.bins) == len(values) + 1:
            return values
        return _means(values, self.bins)

    @property
    def every(self) -> int:
        """Number of samples in an ordinary bin."""
        return int(np.median(np.diff(self.bins)))

    @property
    def finer(self) -> int:
        """How many times to compute traces at for each sample."""
        return max(1, int(np.ceil(MIN_TRACE_RATE_HZ * self.interval)))

    @cached_property
    def fine_time(self) -> Array:
        """(F,) s: times with `finer` - 1 more between each two samples."""
        n = len(self.time)
        return np.interp(np.arange((n - 1) * self.finer + 1) / self.finer, np.arange(n), self.time)

    @cached_property
    def fine_rotation_enu_from_body(self) -> Array | None:
        """(F, 3, 3) at the fine times, None without attitude."""
        if self.rotation_enu_from_body is None:
            return None
        rotations: Array = Slerp(self.time, Rotation.from_matrix(self.rotation_enu_from_body))(
            self.fine_time
        ).as_matrix()
        return rotations

    @cached_property
    def fine_angular_velocity(self) -> Array | None:
        """(F, 3) rad/s at the fine times, None without."""
        if self.angular_velocity is None:
            return None
        rates: Array = make_interp_spline(self.time, self.angular_velocity, k=1)(self.fine_time)
        return rates

    @cached_property
    def interval(self) -> float:
        """Median time between samples, s."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @cached_property
    def bin_time(self) -> Array:
        """(M,) s, mean time of each bin."""
        return self.averaged(self.time)

    @property
    def seconds(self) -> float:
        """Length, s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0


def make_recording(
    name: str,
    time: Array,
    velocity_dvl: Array,
    reference_body: Array,
    reported_variance: Array | None = None,
    rotation_enu_from_body: Array | None = None,
    angular_velocity: Array | None = None,
    reference_around: Array | None = None,
    reference_frame: VelocityFrame = VelocityFrame.ENU,
    reference_rate: float = np.inf,
) -> Recording:
    """A recording, thinned by averaging to rates that the diagnosis needs. reference_rate: Hz, of its own samples."""
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    received, repeats = len(time), int((np.diff(velocity_dvl, axis=0) == 0.0).all(axis=1).sum())
    thin = _bins(time, interval, MAX_RATE_HZ)
    if len(thin) < len(time) + 1:
        time, velocity_dvl, reference_body = (_means(each, thin) for each in (time, velocity_dvl, reference_body))
        if reported_variance is not None:
            reported_variance = _means(reported_variance, thin) / np.diff(thin)[:, None]
        if rotation_enu_from_body is not None:
            u, _, vt = np.linalg.svd(_means(rotation_enu_from_body, thin))  # the mean, back on the rotations
            rotation_enu_from_body = u @ vt
        angular_velocity = None if angular_velocity is None else _means(angular_velocity, thin)
        reference_around = None if reference_around is None else _means(reference_around, thin)
        interval = float(np.median(np.diff(time)))
    return Recording(
        name=name,
        time=time,
        velocity_dvl=velocity_dvl,
        reference_body=reference_body,
        bins=_bins(time, interval, _test_rate(time, reference_around, reference_rate)),
        reported_variance=reported_variance,
        rotation_enu_from_body=rotation_enu_from_body,
        angular_velocity=angular_velocity,
        reference_around=reference_around,
        reference_frame=reference_frame,
        repeats=repeats,
        received=received,
    )


def _test_rate(time: Array, reference_around: Array | None, reference_rate: float) -> float:
    """Rate, Hz, of the means that hypotheses are tested on."""
    enough = MAX_TEST_SAMPLES / max(float(time[-1] - time[0]), 1.0)
    return min(MAX_TEST_RATE_HZ, enough, _independent_rate(reference_around, reference_rate))


def _independent_rate(reference_around: Array | None, reference_rate: float) -> float:
    """Rate, Hz, at which means of the reference have noise of their own.

    Between two samples it is a mean of both, so neighbours share their noise, in a way that has next to none at the
    reference's own rate; a whitened residual would then hold little else than what was neglected there.
    """
    interpolated = reference_around is not None and reference_around.any()
    return reference_rate / 2.0 if interpolated else reference_rate


def _means(values: Array, bins: NDArray[np.intp]) -> Array:
    counts = np.diff(bins).reshape(-1, *[1] * (values.ndim - 1))
    mean: Array = np.add.reduceat(values, bins[:-1], axis=0) / counts
    return mean


def _bins(time: Array, interval: float, rate: float) -> NDArray[np.intp]:
    """Where groups begin (and the last ends) whose means come at no more than a rate, or at the samples' own rate."""
    every = int(np.ceil(1.0 / (rate * interval) - 0.05))
    if every <= 1:
        return np.arange(len(time) + 1)
    index = np.floor((time - time[0]) / (every * interval) + 1e-6)
    starts = np.flatnonzero(np.diff(index, prepend=-1.0))
    return np.append(starts, len(time))


class _Collector:
    """Keeps the paired rows that a calibrator aligns."""

    def __init__(self, parameters: Parameters) -> None:
        self._observer = Observer(parameters)
        self._paired: list[tuple[NDArray[Any], ...]] = []

    @property
    def has_paired(self) -> bool:
        """Whether any sample had a reference."""
        return bool(self._paired)

    def forget(self) -> None:
        """The calibration starts anew."""
        self._paired.clear()

    def take(self, block: AlignedBlock) -> None:
        """Aligned rows, in order."""
        block = block.part(block.paired)
        if not len(block):
            return
        seen = self._observer.observe(block, Partners.REFERENCE, np.zeros(2))
        assert seen.reference_body is not None
        variance = np.broadcast_to(np.diagonal(seen.noise, axis1=1, axis2=2), (len(block), 3))
        self._paired.append(
            (
                block.stamps_ns,
                seen.velocity_at_reference,
                seen.reference_body,
                variance,
                block.around_s,
                block.oriented,
                rotation_from_quaternion(block.attitude[:, :4]),
                block.attitude[:, 4:],
            )
        )

    def recording(self, name: str, parameters: Parameters, reference_rate: float, frame: VelocityFrame) -> Recording:
        """What was collected."""
        columns = [np.concatenate(parts) for parts in zip(*self._paired, strict=True)]
        oriented = columns[5]
        has_attitude = np.count_nonzero(oriented) >= MIN_ORIENTED_SHARE * len(oriented)
        if has_attitude:
            columns = [values[oriented] for values in columns]
        stamps, velocity, reference, variance, around, _, rotation, rate = columns
        assumed = np.allclose(variance, parameters.gnss_aided_std**2, rtol=1e-12)
        return make_recording(
            name,
            (stamps - stamps[0]) / SECOND_NS,
            velocity,
            reference,
            None if assumed else variance,
            rotation if has_attitude else None,
            rate if has_attitude else None,
            around,
            frame,
            reference_rate,
        )


@dataclass(frozen=True)
class Loaded:
    """Recordings and what the user should know of the data."""

    recordings: tuple[Recording, ...]
    notes: tuple[str, ...]


def load_recordings(
    paths: Sequence[Path], parameters: Parameters, topics: Topics, on_progress: Callable[[float], None] = lambda _: None
) -> Loaded:
    """Replay every bag and keep its paired samples. Raises InputError, also for a bag without any."""
    if len(set(paths)) < len(paths):
        raise InputError(f"{', '.join(map(str, paths))}: a bag is named twice")
    recordings: list[Recording] = []
    notes: list[str] = []
    for index, path in enumerate(paths):

        def progress(share: float, index: int = index) -> None:
            on_progress((index + share) / len(paths))

        recording, own = _load(path, parameters, topics, progress)
        recordings.append(recording)
        notes += own if len(paths) == 1 else [f"{path}: {note}" for note in own]
    return Loaded(tuple(recordings), tuple(notes))


def _load(
    path: Path, parameters: Parameters, topics: Topics, on_progress: Callable[[float], None]
) -> tuple[Recording, tuple[str, ...]]:
    collector = _Collector(parameters)
    replayed = replay([path], parameters, topics, on_progress, on_rows=collector.take, on_restart=collector.forget)
    result = replayed.result
    received, paired = result.counts["reference"]["received"], result.counts["pairing"]["paired"]
    if not received:
        raise InputError(
            f"{path}: no reference velocity to compare the DVL with: no messages on {topics.gnss}; set --gnss-topic"
        )
    if not paired or not collector.has_paired:
        lost = ", ".join(f"{value} {key}" for key, value in result.counts["reference"].items() if value)
        raise InputError(
            f"{path}: no DVL sample has a reference velocity at its time (reference: {lost}); do the stamps of "
            f"{topics.dvl} and {topics.gnss} overlap, and is attitude on {topics.imu} for a reference in an earth "
            "frame?"
        )
    seconds = 1e-9 * ((result.last_ns or 0) - (result.first_ns or 0))
    rate = received / seconds if seconds else np.inf
    frame = replayed.reference_frame or VelocityFrame.ENU
    return collector.recording(path.name, parameters, rate, frame), replayed.notes
