"""One recording of a fleet: calibrated as `replay` does it, and what the catalogue keeps of that."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date, datetime, timezone
from typing import Any

import numpy as np

from ..bag_replay.checked_replay import checked_replay
from ..bag_replay.replay import Replayed, extrinsics_of_replay, memory_given_back
from ..calibration.checks.speed_of_sound import Water
from ..calibration.models.parameters import Parameters
from ..calibration.results.extrinsics import Extrinsics
from ..calibration.results.mounting_quantities import quantities
from ..calibration.results.results import Estimate, Result
from ..discovery.discover import discover
from ..discovery.discovery import Given
from ..errors import InputError
from ..recordings.recording import open_recording
from .recording_search import StoredRecording, as_text

_UNITS = {"°": "deg"}
# `Estimate.heading_deviation`, in degrees; the last by the hour
HEADING_ERRORS = ("heading_sin", "heading_cos", "heading_sin2", "heading_cos2", "heading_drift")
# By what a recording differs from day to day, which recordings of one day share
_DAY = ("day_std_heading", "day_std_scale")

Row = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """A recording to calibrate, and with what."""

    recording: StoredRecording
    parameters: Parameters
    given: Given


@dataclass(frozen=True)
class Entry:
    """What the catalogue keeps of a recording.

    Parameters
    ----------
    rows
        One a parameter, without the vehicle; one alone, with ``error``, of a recording that could not be calibrated.
    extrinsics
        For the comparison with others, plain data; None without.
    is_final
        Whether the same recording would give the same again; not so where a machine failed.
    """

    rows: Sequence[Row]
    extrinsics: Mapping[str, Any] | None = None
    is_final: bool = True


@memory_given_back()
def entry_of(task: Task) -> Entry:
    """Calibrate. Whatever goes wrong is the entry's error."""
    where = task.recording.name
    try:
        with task.recording.at_hand() as path:
            try:
                return _calibrated(task, path)
            except InputError as error:
                return failed(where, as_text(str(error).replace(str(path), task.recording.where)))
    except Exception as error:
        return failed(where, as_text(f"{type(error).__name__}: {error}"), is_final=False)


def failed(where: str, why: str, is_final: bool = True) -> Entry:
    """Of a recording that could not be calibrated."""
    return Entry([{"recording": where, "error": why}], None, is_final)


def _calibrated(task: Task, path: Any) -> Entry:
    recording = open_recording([path], None, task.parameters)
    found = discover(recording, task.parameters, task.given)
    replayed = checked_replay(
        recording,
        found.parameters,
        found.topics,
        mounting_is_guessed=bool(found.mounting_because),
        contradictions=found.contradictions,
    )
    return entry_of_replay(replayed, task.recording.name)


def entry_of_replay(replayed: Replayed, where: str) -> Entry:
    """Rows of a replay."""
    result = replayed.result
    estimate, verification = result.estimate, result.verifications[result.selected]
    drift = replayed.navigation
    common: Row = {
        "recording": where,
        "model": result.selected,
        "used": estimate.used,
        "gated": estimate.gated,
        "verdict": verification.verdict.value,
        "codes": [each.code for each in verification.reasons],
        "reason": verification.reasons[0].full_sentence if verification.reasons else "",
        "drift_before": math.nan if drift is None else drift.before.per_km,
        "drift_after": math.nan if drift is None else drift.after.per_km,
    }
    if result.first_ns is not None and result.last_ns is not None:
        common |= {"first_ns": result.first_ns, "last_ns": result.last_ns}
        common["day"] = _day(result.first_ns)
    extrinsics, without_day = (extrinsics_of_replay(each, where) for each in (replayed, _without_day(replayed)))
    told = None
    if extrinsics is not None and without_day is not None:
        told = {**_plain(extrinsics), "covariance_of_recording": without_day.covariance.tolist()}
        told |= _cause(replayed)
    rows = (*_quantities(result), *_heading(estimate), *_water(replayed.water))
    return Entry([common | each for each in rows], told)


def _day(stamp_ns: int) -> date | None:
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).date()
    except (ValueError, OverflowError, OSError):  # a stamp that is no time
        return None


def _quantities(result: Result) -> list[Row]:
    """Rows of mounting, scale and delay, with σ of the filter, of this recording, and of the next."""
    estimate = result.estimate
    claims = (estimate.filter_covariance, estimate.recording_covariance, estimate.covariance)
    by_claim = [
        quantities(
            replace(result, estimates={**result.estimates, result.selected: replace(estimate, covariance=claim)})
        )
        for claim in claims
    ]
    return [
        {
            "parameter": "time_offset" if last.name.startswith("stamps late") else last.name.replace(" ", "_"),
            "unit": _UNITS.get(last.unit, last.unit.strip()),
            "nominal": last.nominal,
            "value": last.value,
            "std_filter": of_filter.std,
            "std_recording": of_recording.std,
            "std_next": last.std,
            "shown": last.shown,
        }
        for of_filter, of_recording, last in zip(*by_claim, strict=True)
    ]


def _heading(estimate: Estimate) -> list[Row]:
    """Rows of how the heading deviates, where headings were compared."""
    if estimate.heading_deviation is None:
        return []
    value, std = estimate.heading_deviation.x, np.sqrt(np.diag(estimate.heading_deviation.p))
    rows = []
    for name, each, own in zip(HEADING_ERRORS, np.degrees(value), np.degrees(std), strict=True):
        factor, unit = (3600.0, "deg/h") if name == "heading_drift" else (1.0, "deg")
        rows.append(
            {"parameter": name, "unit": unit, "value": factor * float(each), "std_recording": factor * float(own)}
        )
    return rows


def _water(water: Water | None) -> list[Row]:
    """Rows of the water, as far as it is known; of a range its middle and half."""
    if water is None:
        return []
    known = [
        ("water_temperature", "degC", water.temperature, water.temperature_error),
        ("water_salinity", "PSU", water.salinity, math.nan),
        ("dvl_speed_of_sound", "m/s", water.used, math.nan),
    ]
    if water.speed is not None:
        least, most = water.speed
        known.append(("water_speed_of_sound", "m/s", 0.5 * (least + most), 0.5 * (most - least)))
    return [
        {"parameter": name, "unit": unit, "value": value, "std_recording": 0.5 * twice}
        for name, unit, value, twice in known
        if not math.isnan(value)
    ]


def _cause(replayed: Replayed) -> dict[str, str]:
    """What the water says of the scale, by the name under which the catalogue keeps it."""
    cause = replayed.cause_of_scale
    return {} if cause is None else {"cause_of_scale": cause.sentence}


def _without_day(replayed: Replayed) -> Replayed:
    """The same with σ of this recording alone, for those of one day, which share what differs from day to day."""
    parameters = {**replayed.result.parameters, **dict.fromkeys(_DAY, 0.0)}
    return replace(replayed, result=replace(replayed.result, parameters=parameters))


def _plain(extrinsics: Extrinsics) -> dict[str, Any]:
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(extrinsics).items()
    }
