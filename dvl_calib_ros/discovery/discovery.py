"""Result of discovery: topics, parameters and frames for the calibration, and skipped alternatives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.samples import VelocityFrame
from ..calibration.registration.clock_domains import limit_s
from ..calibration.registration.frame_hypotheses import Agreement
from ..recordings.recording import Recording
from ..recordings.topic_messages import Preview
from ..recordings.topics import Topics
from ..verdict.reasons import Reason, finding
from .clock_offsets import FoundClocks, find_clocks
from .transforms import in_degrees


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
