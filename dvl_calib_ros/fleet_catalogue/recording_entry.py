"""One recording of a fleet: its calibration as by `replay`, and its entry in the catalogue."""

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
# `Estimate.heading_deviation`, in degrees
HEADING_ERRORS = ("heading_sin", "heading_cos", "heading_sin2", "heading_cos2")
# variation between days, which recordings of one day share
_DAY = ("day_std_heading", "day_std_scale")

Row = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """A recording to calibrate, with parameters and named topics."""

    recording: StoredRecording
    parameters: Parameters
    given: Given


@dataclass(frozen=True)
class Entry:
    """Entry of a recording in the catalogue.

    Parameters
    ----------
    rows
        One per parameter, without the vehicle; a single one, with ``error``, if the calibration failed.
    extrinsics
        Plain data for the comparison with others; None without.
    is_final
        Whether repeating it would give the same result; False if a machine failed.
    """

    rows: Sequence[Row]
    extrinsics: Mapping[str, Any] | None = None
    is_final: bool = True


@memory_given_back()
def entry_of(task: Task) -> Entry:
    """Calibrate with a recording. Any exception becomes the entry's error."""
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
    """Return the entry of a recording that could not be calibrated."""
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
    """Return the rows of a replay."""
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
    extrinsics_row = None
    if extrinsics is not None and without_day is not None:
        extrinsics_row = {**_plain(extrinsics), "covariance_of_recording": without_day.covariance.tolist()}
        extrinsics_row |= _cause(replayed)
    rows = (*_quantities(result), *_heading(estimate), *_water(replayed.water))
    return Entry([common | each for each in rows], extrinsics_row)


def _day(stamp_ns: int) -> date | None:
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).date()
    except (ValueError, OverflowError, OSError):  # an invalid time
        return None


def _quantities(result: Result) -> list[Row]:
    """Return rows of mounting, scale and delay, with σ of the filter, of this recording, and of the next."""
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
    """Return rows of the heading deviation, if headings were compared."""
    if estimate.heading_deviation is None:
        return []
    value, std = estimate.heading_deviation.x, np.sqrt(np.diag(estimate.heading_deviation.p))
    return [
        {"parameter": name, "unit": "deg", "value": float(each), "std_recording": float(each_std)}
        for name, each, each_std in zip(HEADING_ERRORS, np.degrees(value), np.degrees(std), strict=True)
    ]


def _water(water: Water | None) -> list[Row]:
    """Return rows of the known water properties; a range is given by its middle and half-width."""
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
    """Return the scale's explanation by the water, under its name in the catalogue."""
    cause = replayed.cause_of_scale
    return {} if cause is None else {"cause_of_scale": cause.sentence}


def _without_day(replayed: Replayed) -> Replayed:
    """Return the replay with σ of this recording only, without the variation between days."""
    parameters = {**replayed.result.parameters, **dict.fromkeys(_DAY, 0.0)}
    return replace(replayed, result=replace(replayed.result, parameters=parameters))


def _plain(extrinsics: Extrinsics) -> dict[str, Any]:
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in asdict(extrinsics).items()
    }
