"""Result of discovery: topics, parameters, frames and clock offsets for the calibration, and skipped alternatives.

Finding frames needs velocities of the same time, and finding clock offsets needs the right frames. So clocks are
registered with the discovered frames and, if the residual is large, with the other possible ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.samples import SampleBlock, Stream, Streams, VelocityFrame
from ..calibration.registration.clock_domains import limit_s
from ..calibration.registration.clock_drift_and_jumps import REPORTED_FROM_S
from ..calibration.registration.frame_hypotheses import Agreement, Reading, Readings
from ..calibration.registration.gauss_newton import white_noise
from ..calibration.registration.motion_streams import MotionStreams, in_order, make_motion, motion_of
from ..calibration.registration.registration import OFFSETS, SMALL_DELAY_S, Registration, register
from ..calibration.registration.unregistrable_clocks import UnregistrableClocks, far_clocks
from ..calibration.streams.interpolation import ImuColumns
from ..calibration.streams.screening import unit_quaternions
from ..messages.decode import MessageDecoder
from ..recordings.recording import Recording
from ..recordings.topic_messages import Preview, Survey
from ..recordings.topics import Topics
from ..verdict.reasons import Reason, finding
from .transforms import in_degrees

# A registration is valid below this residual, as a share of the speed (17 degrees of misalignment). Another reading of
# the frames replaces the first one if its residual is below this share of the first's.
REGISTERED, CLEARLY = 0.3, 0.5
# sampling interval of the registered streams, ns
EVERY_NS = {Stream.DVL: 100_000_000, Stream.REFERENCE: 100_000_000, Stream.IMU: 50_000_000}
# parameters for a drift or step of the DVL's clock
MOVING = frozenset({"dvl_clock_drift", "dvl_time_jump", "dvl_time_jump_at"})
# number of DVL samples compared to find frames; more do not improve the result
COMPARED = 1500


@dataclass(frozen=True)
class FoundClocks:
    """Clock offsets of the streams.

    offsets: by parameter, value to subtract, s, in addition to the configured one.
    far: clocks with offsets too large to be registered.
    parameters: the frames used.
    """

    registration: Registration
    offsets: Mapping[str, float]
    parameters: Parameters
    far: UnregistrableClocks | None = None

    @property
    def doubt(self) -> Reason | None:
        """Reason why no calibration is possible with these clocks."""
        if self.far is not None:
            return self.far.reason
        moves = self.registration.unsteady
        is_left = moves is not None and not MOVING & self.offsets.keys()
        drift = self.parameters.dvl_clock_drift
        return moves.reason(drift) if moves is not None and is_left else self.registration.ambiguity

    def says(self) -> Iterator[str]:
        """Yield one sentence per clock with an offset: its delay, and the treatment."""
        registration, apart = self.registration, self.registration.apart
        if registration.unsteady is not None and not self.doubt:
            values = ", ".join(f"{name} {self.offsets[name]:.13g}" for name in sorted(MOVING & self.offsets.keys()))
            yield f"{registration.unsteady.reason(0.0).says}: subtracted ({values})"
        for name, delay_s in registration.offsets.items():
            if name in self.offsets:
                treatment = f"subtracted ({name} {delay_s:.2f})"
            elif name == "dvl_time_offset" and abs(delay_s) < SMALL_DELAY_S:
                treatment = "left to the calibration, which estimates it"
            else:
                treatment = "not subtracted"
            is_ambiguous = name == "reference_time_offset" and not registration.is_turned
            alternative = ", or the DVL's as much early" if is_ambiguous else ""
            yield f"{registration.clock_reason(name).says}{alternative}: {treatment}"
        if apart.is_shown and not (registration.offsets or self.doubt):
            yield (
                f"stamps of DVL and reference differ by {abs(apart.delay_s):.2f} ± {apart.std:.2f} s; it is "
                f"unknown whose clock is wrong: drive turns at two speeds"
            )


def find_clocks(
    recording: Recording, topics: Topics, parameters: Parameters, *, knows_mounting: bool, given: frozenset[str]
) -> FoundClocks | None:
    """Find the clock offsets; None if they are not observable, or differ between recordings.

    knows_mounting: whether mounting_rpy is more than a guess. given: parameters that the user set, which are kept.
    """
    if topics.gnss not in recording.columns or topics.dvl not in recording.columns:
        return None
    found = [_find_in_recording(part, topics, parameters, knows_mounting, given) for part in recording.each]
    first = found[0]
    if len(found) > 1 and any(clocks is not None and clocks.offsets.keys() & MOVING for clocks in found):
        return None  # drift or step differ between recordings
    if first is None or any(clocks is None for clocks in found):
        return None
    for other in found[1:]:
        assert other is not None
        names = {*first.offsets, *other.offsets}
        if any(abs(first.offsets.get(name, 0.0) - other.offsets.get(name, 0.0)) > REPORTED_FROM_S for name in names):
            return None
    return first


def _find_in_recording(
    recording: Recording, topics: Topics, parameters: Parameters, knows_mounting: bool, given: frozenset[str]
) -> FoundClocks | None:
    """Estimate the clock offsets under each frame hypothesis; None if none fits better than noise permits."""
    best: tuple[Registration, Parameters] | None = None
    epoch_ns, residual = 0, math.inf
    for hypothesis in _hypotheses(parameters, given):
        motion = _streams_to_register(recording, topics, hypothesis)
        if motion is None:
            continue
        rotation = hypothesis.rotation_dvl_from_body
        is_first = hypothesis is parameters
        if is_first and (far := far_clocks(motion, rotation)) is not None:
            as_configured = register(motion, rotation.T, np.array(hypothesis.lever_arm))
            return None if as_configured is None else FoundClocks(as_configured, {}, parameters, far)
        mounting = rotation.T if knows_mounting or is_first else None
        found = register(motion, mounting, np.array(hypothesis.lever_arm))
        if found is not None and (best is None or found.residual < CLEARLY * best[0].residual):
            best, epoch_ns, residual = (found, hypothesis), motion.epoch_ns, _residual_without_noise(found, motion)
        if is_first and found is not None and _residual_without_noise(found, motion) < REGISTERED:
            recording.register_as(found, topics, parameters)
            break
    if best is None or residual >= REGISTERED:
        return None
    registration, hypothesis = best
    offsets = {} if given.intersection(OFFSETS) else registration.corrections
    if registration.unsteady is not None and not given & MOVING:
        offsets |= registration.unsteady.corrections(epoch_ns)
    return FoundClocks(registration, offsets, hypothesis)


def _residual_without_noise(registration: Registration, motion: MotionStreams) -> float:
    """Return the residual of a registration without the reference's noise, as a share of the speed."""
    noise = 3.0 * white_noise(motion.reference) / max(registration.speed, 1e-9) ** 2
    return math.sqrt(max(registration.residual**2 - noise, 0.0))


def _hypotheses(parameters: Parameters, given: frozenset[str]) -> Iterator[Parameters]:
    """Yield the discovered frames, then the alternatives to those that the user did not set."""
    yield parameters
    frames = (parameters.gnss_frame,) if "gnss_frame" in given else ("enu", "ned", "body")
    imus = [(parameters.imu_rpy, parameters.imu_frame)]
    if not given.intersection({"imu_rpy", "imu_frame"}):
        imus += [((0.0, 0.0, 0.0), "enu"), ((np.pi, 0.0, 0.0), "ned")]
    for frame, (rpy, world) in product(frames, imus):
        yield parameters.replace(gnss_frame=frame, imu_rpy=rpy, imu_frame=world)


def _streams_to_register(recording: Recording, topics: Topics, parameters: Parameters) -> MotionStreams | None:
    """Return the streams to register, thinned so that memory does not grow with their rates."""
    parameters_used = recording.of_types(topics, parameters)
    named = {topics.imu: Stream.IMU, topics.gnss: Stream.REFERENCE, topics.dvl: Stream.DVL}
    parts = [
        Streams(*(_one_per_interval(block) for block in stretch.streams))
        for stretch in recording.stretches(named, MessageDecoder(parameters_used))
    ]
    if not parts:
        return None
    return motion_of(Streams(*(one.joined(*others) for one, *others in zip(*parts, strict=True))), parameters_used)


def _one_per_interval(block: SampleBlock) -> SampleBlock:
    """Return one sample per interval of `EVERY_NS`."""
    bins = block.stamps_ns // EVERY_NS[block.stream]
    return block.part(np.flatnonzero(np.diff(bins, prepend=-1)))


def on_imu_clock(recording: Recording, topics: Topics, registration: Registration) -> Survey:
    """Return the previewed streams with their stamps corrected to the IMU's clock by a registration."""
    survey = recording.whole(topics)
    delays_s = {topics.dvl: registration.dvl.delay_s, topics.gnss: registration.reference.delay_s}
    if not registration.is_turned:  # without turns only the delay between DVL and reference is observable
        delays_s = {topics.dvl: registration.apart.delay_s}
    previews = {
        name: replace(preview, stamps_s=preview.stamps_s - delays_s.get(name, 0.0), ahead_s=0.0)
        for name, preview in survey.previews.items()
    }
    if topics.dvl in previews:
        previews[topics.dvl] = _thinned(previews[topics.dvl])
    return replace(survey, previews=previews)


def _thinned(preview: Preview) -> Preview:
    step = -(-len(preview.stamps_s) // COMPARED)
    rates, pose = (None if column is None else column[::step] for column in (preview.rates, preview.pose))
    return replace(preview, stamps_s=preview.stamps_s[::step], values=preview.values[::step], rates=rates, pose=pose)


def difference_of(dvl: Preview, reference: Preview) -> float | None:
    """Return the residual of two velocities after the best rotation, both taken in the body frame."""
    motion = compared_motion(dvl, reference, None)
    if motion is None:
        return None
    found = Readings(motion, np.zeros(3)).agreements([Reading(VelocityFrame.BODY.value, None, False)], None)
    return found[0].best_residual if found else None


def compared_motion(dvl: Preview, reference: Preview, imu: Preview | None) -> MotionStreams | None:
    """Return the previewed samples as motion streams, in the messages' own axes; None if there are too few."""
    columns = ImuColumns(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 3)))
    if imu is not None and imu.has_orientation:
        columns = imu_columns_of(imu)
    measured = True, True, bool(reference.values[:, 2].any())
    dvl_motion, reference_motion = (in_order(preview.stamps_s, preview.values) for preview in (dvl, reference))
    return make_motion(dvl_motion, reference_motion, False, measured, columns)


def imu_columns_of(imu: Preview) -> ImuColumns:
    """Return orientation and angular velocity of an IMU's topic as columns."""
    times, values = in_order(imu.stamps_s, imu.values)
    return ImuColumns(times, unit_quaternions(values[:, :4]), values[:, 4:7])


@dataclass(frozen=True)
class Given:
    """Topics (None: not named) and names of parameters that the user set, which are not discovered."""

    dvl_topic: str | None = None
    gnss_topic: str | None = None
    imu_topic: str | None = None
    parameters: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Discovery:
    """Discovered configuration.

    found: findings with their sources, in sentences.
    notes: skipped alternatives.
    contradictions: contradictions between the recording's data and its declarations.
    values: discovered parameters, which are included in `parameters`.
    agreement: of DVL and reference, None if it could not be computed.
    reference_frame: assumed frame of the reference.
    knows_imu: whether the IMU's axes are known.
    mounting_because: reason for a mounting guessed from the data; else ''.
    clocks_given: clock parameters before the offsets in `parameters` were added.
    """

    topics: Topics
    parameters: Parameters
    found: tuple[str, ...] = ()
    notes: tuple[Reason, ...] = ()
    contradictions: tuple[Reason, ...] = ()
    values: Mapping[str, Any] = field(default_factory=dict)
    agreement: Agreement | None = None
    reference_frame: VelocityFrame | None = None
    knows_imu: bool = False
    clocks: FoundClocks | None = None
    mounting_because: str = ""
    clocks_given: Mapping[str, float] = field(default_factory=dict)

    @property
    def diagnosed(self) -> Parameters:
        """The parameters with the original clocks: a diagnosis names the offsets that a calibration subtracts."""
        return self.parameters.replace(**self.clocks_given)

    def with_mounting(self, rpy: Sequence[float]) -> Discovery:
        """Replace a guessed mounting by the better one (rad) that a calibration found."""
        before, roll_pitch_yaw = self.parameters.mounting_rpy, tuple(map(float, rpy))
        if not self.mounting_because or roll_pitch_yaw == before:
            return self
        again = mounting_guessed(roll_pitch_yaw, self.mounting_because)
        return replace(
            self,
            parameters=self.parameters.replace(mounting_rpy=roll_pitch_yaw),
            values={**self.values, "mounting_rpy": roll_pitch_yaw},
            notes=tuple(again if note.code == again.code else note for note in self.notes),
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings for the user."""
        return tuple(reason.sentence for reason in (*self.contradictions, *self.notes))

    def document(self) -> dict[str, Any]:
        """Return plain data for JSON: topics, findings, warnings."""
        return {
            "topics": dict(vars(self.topics)),
            "found": list(self.found),
            "doubts": list(self.doubts),
            "contradictions": [contradiction.as_dict() for contradiction in self.contradictions],
            "notes": [note.as_dict() for note in self.notes],
        }


def mounting_guessed(rpy: Sequence[float], why: str) -> Reason:
    """Return the reason for a mounting (rad) guessed from the data."""
    # on a level vehicle, a heading with another zero looks the same
    also = "; or the heading counts from north" if abs(rpy[2]) > 0.99 * math.pi / 2.0 else ""
    return finding("MOUNTING_GUESSED", mounting=in_degrees(rpy), why=why, option=as_option(rpy), also=also)


def as_option(rpy: Iterable[float]) -> str:
    """Return roll, pitch, yaw (rad) as the value of a parameter."""
    return "[" + ",".join(f"{math.degrees(angle):.4g}deg" for angle in rpy) + "]"


def clocks_of_recording(recording: Recording, found: Discovery, given: Given) -> FoundClocks | None:
    """Return the clock offsets of a recording; None where they cannot be found."""
    knows_mounting = "mounting_rpy" in {*found.values, *given.parameters}
    return find_clocks(recording, found.topics, found.parameters, knows_mounting=knows_mounting, given=given.parameters)


def in_time_of(dvl: Preview, other: Preview | None, parameters: Parameters) -> Preview | None:
    """Shift stamps to the DVL's clock if the offset exceeds any delay that is estimated.

    Velocities of different times agree only in wrong frames. The replay reports the clock offset.
    """
    ahead_s = 0.0 if other is None else other.ahead_s - dvl.ahead_s
    if other is None or abs(ahead_s) <= limit_s(parameters):
        return other
    return replace(other, stamps_s=other.stamps_s - ahead_s)
