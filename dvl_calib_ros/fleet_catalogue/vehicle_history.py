"""History of each vehicle's mounting by day, and recordings that need a person.

Recordings of one day share the variation between days (`day_covariance`): they are averaged by their own σ, and
the day's σ is added once. A mounting that moves within a day splits the day.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from ..calibration.comparison.mounting_change import Comparison, compare, fused
from ..calibration.models import MODELS
from ..calibration.numerics.frames import Array
from ..calibration.results.extrinsics import Extrinsics
from ..errors import InputError
from .recording_entry import HEADING_ERRORS, Row

DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class Catalogued:
    """A recording in the catalogue. covariance_of_recording (8, 8): without the variation between days.

    cause_of_scale: explanation of the scale by the water, in a sentence, or ''.
    """

    recording: str
    vehicle: str
    rows: tuple[Row, ...]
    extrinsics: Extrinsics | None = None
    covariance_of_recording: Array | None = None
    cause_of_scale: str = ""

    @staticmethod
    def of(recording: str, vehicle: str, rows: Sequence[Row], document: Mapping[str, Any] | None) -> Catalogued:
        """Build from a recording's part of the catalogue. document: `Extrinsics` as plain data; None without any."""
        if document is None:
            return Catalogued(recording, vehicle, tuple(rows))
        values = {field.name: document[field.name] for field in fields(Extrinsics) if field.name in document}
        for name in values.keys() & {"value", "covariance", "by_bias"}:
            values[name] = np.array(values[name])
        values["shown"] = np.array(values["shown"], dtype=bool)
        covariance, cause = np.array(document["covariance_of_recording"]), str(document.get("cause_of_scale", ""))
        return Catalogued(recording, vehicle, tuple(rows), Extrinsics(**values), covariance, cause)

    @property
    def error(self) -> str:
        """Why it could not be calibrated, without its own path; '' if it could."""
        return (self.rows[0]["error"] or "").replace(f"{self.recording}: ", "").replace(self.recording, "it")

    @property
    def is_usable(self) -> bool:
        """Return whether the estimated values and σ are valid."""
        return self.extrinsics is not None and not self.extrinsics.rejected


class CompassDeviation(NamedTuple):
    """Heading deviation of a vehicle, degrees.

    value, std: coefficients (4,) of sine and cosine of the yaw and of twice the yaw, and their σ. recordings: their
    number.
    """

    value: Array
    std: Array
    recordings: int


class WaterOfRecording(NamedTuple):
    """Water properties of a recording.

    first_ns: stamp of the recording's first sample.
    used: speed of sound used by the DVL, m/s, nan if unknown.
    cause_of_scale: explanation of the scale by the water, in a sentence.
    """

    first_ns: int
    used: float
    cause_of_scale: str


@dataclass(frozen=True)
class VehicleHistory:
    """A vehicle. days: its calibrations by day. compared: None with fewer than two. heading: None if unknown.

    water: of its newest recording that has it.
    """

    name: str
    recordings: int
    days: tuple[Extrinsics, ...]
    compared: Comparison | None
    heading: CompassDeviation | None
    water: WaterOfRecording | None = None


class NeedsPerson(NamedTuple):
    """A reason why recordings of a vehicle need a person, in the words for the first.

    code: of the reason of a verdict, or SAME_DATA; '' of an error.
    """

    code: str
    why: str
    recordings: tuple[str, ...]
    vehicle: str = ""


def histories(entries: Sequence[Catalogued]) -> list[VehicleHistory]:
    """Return the history of each vehicle, by name. entries: each recording once (`distinct`)."""
    by_vehicle: dict[str, list[Catalogued]] = defaultdict(list)
    for entry in entries:
        by_vehicle[entry.vehicle].append(entry)
    return [_history(name, entries_of) for name, entries_of in sorted(by_vehicle.items())]


def distinct(entries: Sequence[Catalogued]) -> tuple[list[Catalogued], list[NeedsPerson]]:
    """Remove recordings with the same data as another, which would confirm itself; also return those."""
    first: dict[Any, Catalogued] = {}
    unique, doubled = [], []
    for entry in entries:
        fit = entry.extrinsics
        key: Any = entry.recording
        if fit is not None:
            key = fit.model, fit.first_ns, fit.last_ns, fit.used, fit.covariance.tobytes()
        if key in first:
            why = f"the same data as {first[key].recording}: only that is used"
            doubled.append(NeedsPerson("SAME_DATA", why, (entry.recording,), entry.vehicle))
        else:
            first[key] = entry
            unique.append(entry)
    return unique, doubled


def need_person(entries: Sequence[Catalogued]) -> list[NeedsPerson]:
    """Return recordings without a calibration or with a rejected one, by vehicle and reason, most frequent first."""
    groups: dict[tuple[str, str, str], list[Catalogued]] = defaultdict(list)
    for entry in entries:
        row = entry.rows[0]
        if entry.error:
            groups[entry.vehicle, "", entry.error].append(entry)
        elif row["verdict"] == "reject":
            groups[entry.vehicle, row["codes"][0] if row["codes"] else "", ""].append(entry)
    found = [
        NeedsPerson(code, error or members[0].rows[0]["reason"], tuple(member.recording for member in members), vehicle)
        for (vehicle, code, error), members in groups.items()
    ]
    return sorted(found, key=lambda group: -len(group.recordings))


def _history(name: str, entries: Sequence[Catalogued]) -> VehicleHistory:
    """Return the history of a vehicle: days, comparison, heading deviation and water."""
    usable = [entry for entry in entries if entry.is_usable]
    # models without GNSS assume no current, so they are not compared with models with GNSS
    aided = [entry for entry in entries if entry.extrinsics is not None and MODELS[entry.extrinsics.model].aided]
    days = _average_days([entry for entry in aided if entry.is_usable] or usable)
    rejected = [
        replace(entry.extrinsics, name=entry.recording.rpartition("/")[2])
        for entry in aided
        if entry.extrinsics is not None and not entry.is_usable
    ]
    compared = _compare_if_several([*days, *rejected]) if days else None
    return VehicleHistory(name, len(entries), tuple(days), compared, _heading(usable), _water(usable))


def _compare_if_several(several: Sequence[Extrinsics]) -> Comparison | None:
    """Compare calibrations; None for fewer than two, or without a common observable quantity."""
    try:
        return compare(several) if len(several) > 1 else None
    except InputError:  # no quantity is observable in two of them
        return None


def _average_days(entries: Sequence[Catalogued]) -> list[Extrinsics]:
    """Average the recordings of each day, separately before and after a movement of the mounting."""
    by_day: dict[int, list[tuple[Extrinsics, Array]]] = defaultdict(list)
    for entry in entries:
        if entry.extrinsics is not None and entry.covariance_of_recording is not None:
            by_day[entry.extrinsics.first_ns // DAY_NS].append((entry.extrinsics, entry.covariance_of_recording))
    averages = []
    for _, recordings in sorted(by_day.items()):
        recordings.sort(key=lambda recording: recording[0].first_ns)
        averages += [_average_day(part) for part in _split_at_moves(recordings)]
    return averages


def _split_at_moves(recordings: list[tuple[Extrinsics, Array]]) -> list[list[tuple[Extrinsics, Array]]]:
    """Split the recordings of one day where the mounting moved. Each is (calibration, covariance of it alone)."""
    compared = _compare_if_several([calibration for calibration, _ in recordings])
    starts = [] if compared is None else [change.first_after.name for change in compared.moved]
    parts: list[list[tuple[Extrinsics, Array]]] = [[]]
    for calibration, alone in recordings:
        if calibration.name in starts and parts[-1]:
            parts.append([])
        parts[-1].append((calibration, alone))
    return parts


def _average_day(recordings: Sequence[tuple[Extrinsics, Array]]) -> Extrinsics:
    """Average a day's recordings, adding the variation between days once."""
    of_days = [recording.covariance - alone for recording, alone in recordings]
    together = fused([replace(recording, covariance=alone) for recording, alone in recordings])
    covariance = together.covariance + max(of_days, key=np.trace)
    name = recordings[0][0].name.rpartition("/")[2] if len(recordings) == 1 else f"{len(recordings)} recordings"
    return replace(together, name=name, covariance=covariance)


def _water(entries: Sequence[Catalogued]) -> WaterOfRecording | None:
    """Return the water properties of the newest recording that has them."""
    found = []
    for entry in entries:
        if entry.extrinsics is not None and entry.cause_of_scale:
            used = next((row["value"] for row in entry.rows if row["parameter"] == "dvl_speed_of_sound"), math.nan)
            found.append(WaterOfRecording(entry.extrinsics.first_ns, used, entry.cause_of_scale))
    return max(found, default=None)


def _heading(entries: Sequence[Catalogued]) -> CompassDeviation | None:
    """Return the weighted mean over all recordings; None if no heading was compared."""
    values, stds = [], []
    for entry in entries:
        by_parameter = {row["parameter"]: row for row in entry.rows}
        if all(name in by_parameter for name in HEADING_ERRORS):
            values.append([by_parameter[name]["value"] for name in HEADING_ERRORS])
            stds.append([by_parameter[name]["std_recording"] for name in HEADING_ERRORS])
    if not values:
        return None
    weight = 1.0 / np.square(stds)
    return CompassDeviation((weight * values).sum(axis=0) / weight.sum(axis=0), weight.sum(axis=0) ** -0.5, len(values))
