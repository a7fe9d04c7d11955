"""Streams of a recording with their own stamps, and backward steps of the DVL's clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...calibration.checks.imu_rate_consistency import AttitudeRates
from ...calibration.models.parameters import Parameters
from ...calibration.numerics.frames import ENU_FROM_NED, Array, cross, rotation_from_quaternion
from ...calibration.numerics.samples import FRAMES, Covariances, SampleBlock, Stream, Streams, VelocityFrame
from ...calibration.registration.gauss_newton import white_noise
from ...calibration.registration.registration import Registration
from ...calibration.registration.unregistrable_clocks import MOVING_MPS
from ...calibration.streams.clock_correction import SECOND_NS, Clocks
from ...calibration.streams.position_velocities import NOISY_MPS
from ...calibration.streams.screening import NOT_MEASURED_VARIANCE, SMALLEST_VARIANCE, unit_quaternions
from ...calibration.streams.stream_order import strays
from ...effects.base import EffectNeeds, depth_of
from ...errors import InputError
from ...messages.decode import MessageDecoder
from ...messages.drivers import VELOCITY_TYPES
from ...recordings.recording import Recording as Opened
from ...recordings.recording import check_topics, hold_the_same, missing_imu, open_recording
from ...recordings.topic_messages import Recorded
from ...recordings.topics import Topics
from ...verdict.reasons import Reason
from .settings import SETTINGS
from .stream_curve import Curve

# A stream is stamped twice where two steps span less than this many usual steps, at least MIN_IN_A_ROW times in a row
STAMPED_TWICE_STEPS, MIN_IN_A_ROW = 1.25, 4
# Sorted by stamp, such samples alternate between two times: second differences exceed the usual ones by this factor.
# Otherwise the mixture does no harm.
ALTERNATING_FACTOR = 2.0
# At most this number of irregular steps indicates a clock. Irregular: by IRREGULAR_Z times the scatter of steps, within
# these relative bounds
MAX_IRREGULAR, IRREGULAR_BOUNDS, IRREGULAR_Z = 3, (0.03, 0.1), 8.0
# Of two samples closer than this share of the usual step, one is removed: an interpolating curve would ring
MIN_STEP_SHARE = 0.5
# Largest backward steps, s: if the stamps do not show the size, and if they do
MAX_BACK_S, MAX_SHOWN_BACK_S = 2.0, 5.0


class BackwardStep(NamedTuple):
    """Backward clock step between stamps `before` and `after` (s). by: s; upper bound if unknown."""

    before: float
    after: float
    by: float


def backward_steps(time: Array, velocity: Array) -> tuple[tuple[BackwardStep, ...], NDArray[np.bool_]]:
    """Find backward steps of a clock, and the samples (N,) outside doubly stamped times.

    time: (N,) s, sorted stamps. velocity: (N, 3) m/s of these samples. A backward step of two seconds stamps two
    seconds twice. A driver that requires increasing stamps drops two seconds instead: one short step, of which at most
    one sample is kept. A DVL that pings faster for a while has short steps for longer, and a smooth velocity.
    """
    is_unique = np.ones(len(time), dtype=bool)
    if len(time) < 4 * MIN_IN_A_ROW:
        return (), is_unique
    steps = np.diff(time)
    interval = float(np.median(steps))
    crowded = time[2:] - time[:-2] < STAMPED_TWICE_STEPS * interval
    bending = np.linalg.norm(velocity[1:-1] - 0.5 * (velocity[:-2] + velocity[2:]), axis=1)
    events = []
    for first, end in np.flatnonzero(np.diff(np.pad(crowded, 1).astype(int))).reshape(-1, 2).tolist():
        duration = float(time[end + 1] - time[first])
        is_mixed = np.median(bending[first:end]) > ALTERNATING_FACTOR * np.median(bending)
        if end - first >= MIN_IN_A_ROW and duration < MAX_SHOWN_BACK_S and is_mixed:
            is_unique[first : end + 2] = False
            events.append(BackwardStep(float(time[first]), float(time[end + 1]), duration))
    relative = np.abs(steps - interval) / interval
    odd = np.flatnonzero(relative > np.clip(IRREGULAR_Z * np.median(relative), *IRREGULAR_BOUNDS))
    short = odd[steps[odd] < interval]
    if not events and len(short) > 0 and len(odd) <= MAX_IRREGULAR:
        events = [BackwardStep(float(time[index]), float(time[index + 1]), MAX_BACK_S) for index in short.tolist()]
        is_unique[short[steps[short] < MIN_STEP_SHARE * interval] + 1] = False
    return tuple(events), is_unique


# Standard deviation, m/s, from which an axis is unmeasured
UNMEASURED_STD = math.sqrt(NOT_MEASURED_VARIANCE)
# Suffixes of files that are recordings by themselves
SUFFIXES = (".mcap.zstd", ".db3.zstd", ".mcap", ".db3", ".bag")
# Lowest rate of averaged streams, however long a recording is: one sample per shortest bin
SLOWEST_AVERAGE_HZ = 1.0 / SETTINGS.shortest_bin
# Least change of depth, m, of a dive: integrated noise of a vertical velocity at the surface changes it less
LEAST_DIVE_M = 5.0
# Samples of the reference per DVL sample that suffice for the comparison
PER_DVL_SAMPLE = 2.5


@dataclass(frozen=True)
class RecordedStreams:
    """Streams of one recording. Times in s since its first DVL stamp (first_ns).

    name: of the bag.
    dvl: (N, 3) m/s, DVL frame.
    reference: (M, 3) m/s, in the earth (ENU) or the body by `frame`.
    attitude: (A, 4) unit quaternions of ``rotation_enu_from_body``, of continuous sign.
    rates: (G, 3) rad/s, body.
    dvl_std, reference_std: (3,) m/s, RMS of reported standard deviations, the reference's in its frame; None if not
      reported.
    measured: (3,) axes that the reference measures.
    repeats: number of the `received` DVL samples that equal the previous velocity.
    spikes: number of outliers removed.
    registration: initial guess, if known.
    backward_steps: of the DVL's clock.
    """

    name: str
    dvl: Curve
    reference: Curve
    frame: VelocityFrame = VelocityFrame.ENU
    attitude: Curve | None = None
    rates: Curve | None = None
    dvl_std: Array | None = None
    reference_std: Array | None = None
    measured: tuple[bool, bool, bool] = (True, True, True)
    repeats: int = 0
    received: int = 0
    spikes: int = 0
    first_ns: int = 0
    registration: Registration | None = None
    backward_steps: tuple[BackwardStep, ...] = ()

    @property
    def available(self) -> frozenset[EffectNeeds]:
        """Return the inputs of effects that this recording has."""
        has = {
            EffectNeeds.ATTITUDE: self.attitude is not None,
            EffectNeeds.ANGULAR_VELOCITY: self.attitude is not None or self.rates is not None,
            EffectNeeds.DEPTH: self._depth is not None and float(np.ptp(self._depth)) > LEAST_DIVE_M,
        }
        return frozenset(need for need, there in has.items() if there)

    @property
    def seconds(self) -> float:
        """Return the length of the DVL's stream, s."""
        return float(self.dvl.time[-1] - self.dvl.time[0]) if len(self.dvl.time) else 0.0

    def rotation_enu_from_body(self, at: Array) -> Array:
        """Return rotation matrices (M, 3, 3) at times (M,) s."""
        if self.attitude is None:
            raise ValueError(f"{self.name}: no attitude")
        attitude = self.attitude

        def rotation() -> Array:
            q = attitude(at)
            return rotation_from_quaternion(q / np.sqrt((q * q).sum(axis=1))[:, None])

        return np.asarray(attitude.kept.at("rotation", at, rotation))

    @cached_property
    def _depth(self) -> Array | None:
        """Return the depth (M,) m of each sample of the reference below the first, None without vertical velocity."""
        time, values = self.reference.time, self.reference.values
        if not self.measured[2] or (self.frame is VelocityFrame.BODY and self.attitude is None):
            return None
        if self.frame is VelocityFrame.BODY:
            values = np.einsum("nij,nj->ni", self.rotation_enu_from_body(time), values)
        return depth_of(time, values[:, 2])

    def depth(self, at: Array) -> Array | None:
        """Return the depth (M,) m below the start at times (M,) s, None without a vertical velocity."""
        return None if self._depth is None else np.interp(at, self.reference.time, self._depth)

    def angular_velocity(self, at: Array) -> Array:
        """Return the angular velocity (M, 3) rad/s, body axes, at times (M,) s.

        It is that of the gyroscopes, or the derivative of the attitude if the gyroscopes are too slow. Results are
        cached by the times.
        """
        rates, attitude = self.rates, self.attitude
        if rates is not None and (attitude is None or rates.interval * SETTINGS.own_rates_from <= 1.0):
            own = rates.denoised
            return np.asarray(own.kept.at("values", at, lambda: own(at)))
        if attitude is None:
            raise ValueError(f"{self.name}: no angular velocity")
        oriented = attitude.denoised  # 0.01° of noise at 10 Hz is 0.1°/s

        def turning() -> Array:
            """Return the angular velocity (M, 3) rad/s from the attitude's derivative."""
            q = oriented(at)
            dq = oriented.derivative(np.clip(at, oriented.time[0], oriented.time[-1]))
            square = (q * q).sum(axis=1)[:, None]
            # vector part of 2 q* dq/dt, with q = (x, y, z, w)
            xyz = q[:, 3:] * dq[:, :3] - dq[:, 3:] * q[:, :3] - cross(q[:, :3], dq[:, :3])
            return np.asarray(2.0 * xyz / square)

        return np.asarray(oriented.kept.at("angular velocity", at, turning))


def make_recording(
    name: str,
    dvl: tuple[Array, Array],
    reference: tuple[Array, Array],
    *,
    frame: VelocityFrame = VelocityFrame.ENU,
    attitude: tuple[Array, Array] | None = None,
    rates: tuple[Array, Array] | None = None,
    dvl_std: Array | None = None,
    reference_std: Array | None = None,
    axes: str = "auto",
    first_ns: int = 0,
) -> RecordedStreams:
    """Make a recording from stamps (s) and values of each stream; attitude as quaternions (A, 4).

    Parameters
    ----------
    name: Of the recording.
    dvl, reference, attitude, rates: (N,) s and (N, k).
    frame: Of the reference.
    dvl_std, reference_std: Reported standard deviation, m/s, (3,) or per sample (N, 3); None if not reported.
    axes: As gnss_axes.
    first_ns: Stamp of the DVL's first sample.
    """
    events, kept = backward_steps(*dvl)
    if not kept.all():
        dvl, dvl_std = (dvl[0][kept], dvl[1][kept]), dvl_std if dvl_std is None or dvl_std.ndim == 1 else dvl_std[kept]
    time, velocity = dvl
    seconds = float(time[-1] - time[0]) if len(time) > 1 else 0.0
    rate = min(SETTINGS.max_stream_rate, max(SETTINGS.max_points / max(seconds, 1.0), SLOWEST_AVERAGE_HZ))
    repeats = int((velocity[1:] == velocity[:-1]).all(axis=1).sum())

    def clean(stream: tuple[Array, Array] | None, std: Array | None = None) -> Curve | None:
        if stream is None or len(stream[0]) < 2:
            return None
        return _with_reported(stream, std).without_spikes()

    def curve(stream: tuple[Array, Array] | None, std: Array | None = None, rate: float = rate) -> Curve | None:
        found = clean(stream, std)
        return None if found is None else found.averaged(rate)

    if attitude is not None:
        attitude = attitude[0], _continuous_sign(attitude[1])
    without_spikes = clean(dvl, dvl_std)
    spikes = 0 if without_spikes is None else len(time) - len(without_spikes.time)
    dvl_curve = None if without_spikes is None else without_spikes.averaged(rate)
    del without_spikes
    of_dvl = SLOWEST_AVERAGE_HZ if dvl_curve is None else PER_DVL_SAMPLE / dvl_curve.interval
    reference_curve = curve(reference, reference_std, min(rate, max(of_dvl, SLOWEST_AVERAGE_HZ)))
    if dvl_curve is None or reference_curve is None:
        raise InputError(f"{name}: fewer than two samples of DVL or reference")
    return RecordedStreams(
        name, dvl_curve, reference_curve, frame, curve(attitude), curve(rates), _rms(dvl_std), _rms(reference_std),
        _measured_axes(reference[1], _usual(reference_std), axes), repeats, len(time), spikes, first_ns,
        backward_steps=events,
    )  # fmt: skip


def _usual(std: Array | None) -> Array | None:
    """Return the median (3,) of standard deviations (3,) or (N, 3)."""
    return std if std is None or std.ndim == 1 else np.asarray(np.median(std, axis=0))


def _rms(std: Array | None) -> Array | None:
    """Return the RMS (3,) of standard deviations (3,) or (N, 3); unmeasured axes are ignored."""
    median = _usual(std)
    if std is None or median is None or std.ndim == 1:
        return std
    known = std < UNMEASURED_STD
    squares = np.where(known, std, 0.0) ** 2
    rms = np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1))
    return np.where(median < UNMEASURED_STD, rms, median)


def _with_reported(stream: tuple[Array, Array], std: Array | None) -> Curve:
    """Return a curve with reported standard deviations (3,) or (N, 3); missing ones (-1) are the median."""
    median = _usual(std)
    if std is None or median is None or std.ndim == 1:
        return Curve(*stream, std)
    finite = np.where(np.isfinite(median), median, UNMEASURED_STD)
    sample_std = np.where(np.isfinite(std) & (std**2 >= SMALLEST_VARIANCE), std, finite)
    return Curve(*stream, median, sample_std=np.minimum(sample_std, UNMEASURED_STD))


def _continuous_sign(quaternions: Array) -> Array:
    turned = np.sign(np.einsum("ni,ni->n", quaternions[1:], quaternions[:-1]))
    signs = np.cumprod(np.concatenate([[1.0], np.where(turned == 0.0, 1.0, turned)]))
    return quaternions * signs[:, None]


def _measured_axes(velocity: Array, std: Array | None, axes: str) -> tuple[bool, bool, bool]:
    """Return the axes that a reference measures, by `gnss_axes` or by its reported σ."""
    if axes != "auto":
        return True, True, axes == "xyz"
    measured = np.ones(3, dtype=bool) if std is None else std < UNMEASURED_STD
    measured[2] &= bool(velocity[:, 2].any())
    return bool(measured[0]), bool(measured[1]), bool(measured[2])


# ------------------------------------------------------------------ from bags


@dataclass(frozen=True)
class Loaded:
    """Recordings and notes on the data for the user."""

    recordings: tuple[RecordedStreams, ...]
    notes: tuple[str, ...]


def load_recordings(
    source: Opened | Sequence[Path], parameters: Parameters, topics: Topics, *, forget: bool = False
) -> Loaded:
    """Load the recordings of every bag. Raises InputError, also for a bag without a reference velocity.

    forget: free the messages of each after reading (`Recording.forget`).
    """
    paths = source.paths if isinstance(source, Opened) else source
    if len(set(paths)) < len(paths):
        raise InputError(f"{', '.join(map(str, paths))}: a bag is named twice")
    opened = source if isinstance(source, Opened) else open_recording(source, topics, parameters)
    recordings: list[RecordedStreams] = []
    notes: list[str] = []
    known: list[Recorded] = []
    for name, path, one in zip(recording_names(paths), paths, opened.each, strict=True):
        streams, own = _read(path, one, parameters, topics)
        if len(paths) > 1:
            dvl = one.recorded(topics.found_in(one.types).dvl, parameters)
        if forget:
            one.forget()
        blocks = [*streams]
        del streams  # `_recording` frees each as soon as it can
        registration = one.registration(topics, parameters)
        recordings.append(replace(_recording(name, blocks, parameters, own), registration=registration))
        if len(paths) > 1:
            for other, its_path in zip(known, paths, strict=False):
                if hold_the_same(dvl, other):
                    raise InputError(
                        f"{its_path}, {path}: hold the same samples, so neither is held out; name one of them"
                    )
            known.append(dvl)
        notes += own if len(paths) == 1 else [f"{path}: {note}" for note in own]
    return Loaded(tuple(recordings), tuple(notes))


def recording_names(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for each bag, prefixed by its folder's if necessary."""
    full = [path.resolve() for path in paths]
    names = [_without_suffix(path.name) for path in full]
    shared = Counter(names)
    names = [f"{p.parent.name}-{name}" if shared[name] > 1 else name for p, name in zip(full, names, strict=True)]
    shared = Counter(names)
    return [f"{name}-{i + 1}" if shared[name] > 1 else name for i, name in enumerate(names)]


def _without_suffix(name: str) -> str:
    return next((name.removesuffix(end) for end in SUFFIXES if name.endswith(end)), name)


def _read(path: Path, opened: Opened, parameters: Parameters, topics: Topics) -> tuple[Streams, list[str]]:
    """Read all samples of a recording, and notes on the data."""
    found: list[Reason] = []
    chosen = topics.found_in(opened.types)
    check_topics(opened, chosen, found)
    decoder = MessageDecoder(opened.of_types(chosen, parameters))
    streams = opened.streams(chosen, decoder)
    usable = streams.reference.values[streams.reference.refused == 0]
    usable = usable[np.isfinite(usable).all(axis=1)]
    unfit = _unfit_positions(path, opened.types.get(chosen.gnss, ""), chosen.gnss, usable)
    if unfit and not len(usable):
        raise InputError(unfit[0])
    if not len(streams.reference):
        raise InputError(
            f"{path}: no reference velocity to compare the DVL with: no messages on {topics.gnss}; set --gnss-topic"
        )
    found += missing_imu(opened, chosen, decoder.frame_of_reference)
    return streams, [*opened.notes, *unfit, *map(str, found), *map(str, decoder.problems.values())]


def _unfit_positions(path: Path, msgtype: str, topic: str, velocities: Array) -> list[str]:
    """Return advice for positions with velocities (N, 3) m/s too noisy to compare, else nothing."""
    kind = VELOCITY_TYPES.get(msgtype)
    is_noisy = not len(velocities) or math.sqrt(white_noise(velocities)) > NOISY_MPS
    if kind is None or kind.position is None or not is_noisy:
        return []
    return [
        f"{path}: the positions on {topic} are too noisy, or too seldom, for the velocities that a diagnosis compares "
        "with the DVL's; dvl-calib replay calibrates with them (model positions)"
    ]


def _recording(name: str, blocks: list[SampleBlock], parameters: Parameters, notes: list[str]) -> RecordedStreams:
    """Make a recording. blocks: of DVL, reference and IMU; removed from the list to free memory."""
    clocks = Clocks.of(parameters)
    given = blocks.pop(0)
    dvl = _in_order(_valid(given, parameters), parameters, notes)
    if not len(dvl):
        lost = Counter(given.reasons[code - 1] for code in given.refused.tolist() if code)
        listing = ", ".join(f"{count} {reason}" for reason, count in lost.items()) or "all invalid"
        raise InputError(f"{name}: no valid DVL sample of {len(given)}: {listing}")
    first_ns = int(dvl.stamps_ns[0])
    given = blocks.pop(0)
    reference = _in_order(_valid(given, parameters), parameters, notes)
    if not len(reference):
        raise InputError(f"{name}: no valid reference velocity of {len(given)}; see gnss_frame, max_speed")
    code = int(reference.frames[0])
    reference = _part(reference, reference.frames == code)
    dvl = _without_zeros(dvl, reference, notes)
    velocity, std, frame = reference.values, _std(reference.covariances), FRAMES[code]
    if frame is VelocityFrame.NED:
        velocity, std, frame = velocity @ ENU_FROM_NED.T, None if std is None else std[:, [1, 0, 2]], VelocityFrame.ENU
    if frame is VelocityFrame.ENU:
        velocity = velocity - np.array([*parameters.reference_velocity_offset, 0.0])
    given = blocks.pop(0)
    imu = _in_order(_part(given, given.refused == 0), parameters, notes)
    del given
    length = np.linalg.norm(imu.orientation, axis=1)
    oriented = _part(imu, np.asarray((length > 0.5) & (length < 2.0)))
    rated = _part(imu, np.asarray(np.isfinite(imu.angular_velocity).all(axis=1)))
    if frame is VelocityFrame.ENU and len(oriented) < 2:
        raise InputError(
            f"{name}: the reference is in an earth frame and there is no attitude to turn it into the body; "
            "set --imu-topic, or record sensor_msgs/Imu with orientation"
        )
    at = clocks.dvl(dvl.stamps_ns, first_ns)
    imu_ns = clocks.imu_ns
    dvl_stream, dvl_std = _claimed_stream(at, dvl.values, _std(dvl.covariances), first_ns)
    reference_stream, std = _claimed_stream(reference.stamps_ns - clocks.reference_ns, velocity, std, first_ns)
    recording = make_recording(
        name,
        dvl_stream,
        reference_stream,
        frame=frame,
        attitude=_stream(oriented.stamps_ns - imu_ns, oriented.orientation, first_ns) if len(oriented) > 1 else None,
        rates=_stream(rated.stamps_ns - imu_ns, _without_bias(rated), first_ns) if len(rated) > 1 else None,
        dvl_std=dvl_std,
        reference_std=std,
        axes=parameters.gnss_axes,
        first_ns=first_ns,
    )
    if twice := len(dvl_stream[0]) - recording.received:
        when = " and ".join(f"{event.after:.0f} s" for event in recording.backward_steps)
        notes.append(f"dvl: its clock was set back at {when}; {twice} samples of what it stamped twice are left out")
    return recording


def _without_bias(imu: SampleBlock) -> Array:
    """Return the angular velocity (N, 3) rad/s of IMU samples without the bias of the gyroscopes."""
    compared = AttitudeRates()
    compared.add(1e-9 * (imu.stamps_ns - imu.stamps_ns[0]), unit_quaternions(imu.orientation), imu.angular_velocity)
    return imu.angular_velocity - compared.bias


def _stream(stamps_ns: NDArray[np.int64], values: Array, first_ns: int) -> tuple[Array, Array]:
    time = 1e-9 * (stamps_ns - first_ns)
    later = np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0.0])  # corrected steps may cross two
    return (time, values) if later.all() else (time[later], values[later])


def _claimed_stream(
    stamps_ns: NDArray[np.int64], values: Array, std: Array | None, first_ns: int
) -> tuple[tuple[Array, Array], Array | None]:
    """Return `_stream` with the standard deviations (N, 3) of its samples."""
    stream = _stream(stamps_ns, values, first_ns)
    return stream, None if std is None else _stream(stamps_ns, std, first_ns)[1]


def _valid(block: SampleBlock, parameters: Parameters) -> SampleBlock:
    """Return rows that are finite, no faster than max_speed and without a negative variance except -1."""
    speed = np.linalg.norm(block.values, axis=1)
    valid = (block.refused == 0) & np.isfinite(speed) & (speed <= parameters.max_speed)
    if block.stream is Stream.DVL:
        negative = np.array([bool((np.diag(c) < 0.0).any()) for c in block.covariances.distinct] + [False])
        valid &= ~negative[block.covariances.index]
    return _part(block, valid)


def _part(block: SampleBlock, at: NDArray[np.bool_]) -> SampleBlock:
    """Return the rows of a mask (N,), without a copy if these are all."""
    return block if at.all() else block.part(at)


def zeros_while_moving(dvl: SampleBlock, reference: SampleBlock) -> NDArray[np.bool_]:
    """Return (N,) whether a DVL row is exactly zero while the reference, nearest in time, moves: a dropout."""
    zero = (dvl.values == 0.0).all(axis=1)
    if not zero.any() or not len(reference):
        return zero & False
    nearest = np.clip(np.searchsorted(reference.stamps_ns, dvl.stamps_ns), 0, len(reference) - 1)
    return np.asarray(zero & (np.linalg.norm(reference.values[nearest], axis=1) > MOVING_MPS))


def _without_zeros(dvl: SampleBlock, reference: SampleBlock, notes: list[str]) -> SampleBlock:
    """Remove DVL samples of exactly zero while the reference moves, and note their number."""
    lost = zeros_while_moving(dvl, reference)
    if not lost.any() or lost.all():
        return dvl
    notes.append(f"dvl: {np.count_nonzero(lost)} samples are exactly zero while the vehicle moves: taken for dropouts")
    return dvl.part(~lost)


def _in_order(block: SampleBlock, parameters: Parameters, notes: list[str]) -> SampleBlock:
    """Return the rows of the longest part without a restart, in strictly increasing order of stamps."""
    stamps = block.stamps_ns
    jump_ns = round(parameters.max_time_jump * SECOND_NS)
    kept = np.flatnonzero(~strays(stamps, jump_ns))
    parts = np.split(kept, np.flatnonzero(np.diff(stamps[kept]) < -jump_ns) + 1)
    longest = max(parts, key=len)
    if len(parts) > 1:
        notes.append(
            f"{block.stream.value}: stamps went back {len(parts) - 1} times; the longest stretch between is diagnosed"
        )
    if len(longest) == len(stamps) and bool((np.diff(stamps) > 0).all()):
        return block
    order = longest[np.argsort(stamps[longest], kind="stable")]
    fresh = np.concatenate([[True], np.diff(stamps[order]) > 0])[: len(order)]
    return block.part(order[fresh])


def _std(covariances: Covariances) -> Array | None:
    """Return reported standard deviations (N, 3), infinite for a negative variance. Return None if not reported."""
    if not len(covariances.index) or (covariances.index < 0).any():
        return None
    variance = np.diagonal(covariances.distinct, axis1=1, axis2=2)[covariances.index]
    variance = np.where(variance < 0.0, np.inf, variance)
    return None if (np.median(variance, axis=0) < SMALLEST_VARIANCE).any() else np.asarray(np.sqrt(variance))
