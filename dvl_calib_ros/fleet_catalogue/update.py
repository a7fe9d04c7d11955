"""Calibration of every recording in the given places into a growing catalogue, and the history of each vehicle.

Recordings of one day share the variation between days (`day_covariance`): they are averaged by their own σ, and
the day's σ is added once. A mounting that moves within a day splits the day.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..calibration.comparison.mounting_change import ANSWERS, Comparison, compare, fused
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.results.extrinsics import Extrinsics
from ..discovery.discovery import Given
from ..disk.atomic import check_folder_writable, save_bytes
from ..disk.text_files import read_file
from ..errors import InputError, as_cell
from ..files.output_paths import check_outputs
from ..parallel import Lost, Workers, outcomes_as_done
from ..verdict.answering import Answering
from ..version import __version__
from .recording_entry import (
    HEADING_ERRORS,
    Entry,
    Row,
    StoredRecording,
    Task,
    as_text,
    entry_of,
    failed,
    recordings_in,
    vehicle_pattern,
)

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


# Files of the catalogue: one Parquet file per recording, all with one schema, which readers combine to a table.
#
# Each file is written atomically, under a name derived from the recording's location: a killed run loses only the
# current recording, and no row is repeated. The file's metadata have the information to continue a run, and a
# checksum of the whole file, which is verified before parsing.

# faulty files are moved to their own folder, because readers read every file of rows/
ROWS, PAGE, ASIDE = "rows", "index.html", "set_aside"
# version of the schema; a change makes all recordings due again
SCHEMA = 4
_KEY, _CHECKSUM_KEY = b"dvl_calib", b"dvl_calib checksum"
# precedes the checksum in the file's metadata
_CHECKSUM = b"sha256 of this file with zeros here: "
_ZEROS = b"0" * 64


@dataclass(frozen=True)
class CataloguePart:
    """A recording in the catalogue. fingerprint: of recording, program and options; '' means to be repeated."""

    recording: str
    vehicle: str
    fingerprint: str
    extrinsics: Mapping[str, Any] | None
    schema: int = SCHEMA


class Catalogue:
    """A folder with ``rows/*.parquet``. Raises InputError if it cannot be written, or without pyarrow.

    notes: a sentence for each file that `parts` set aside.
    """

    def __init__(self, folder: Path):
        """Create the folder, and define the columns of its files."""
        self._arrow = _arrow()
        self.folder = folder
        self.notes: list[str] = []
        self.rows = folder / ROWS
        check_folder_writable(folder)
        try:
            self.rows.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.rows}: cannot be made ({error.strerror}); name another folder by --out") from error
        a = self._arrow
        number, text = a.float64(), a.string()
        self._schema = a.schema(
            [
                ("vehicle", text),
                ("day", a.date32()),
                ("recording", text),
                ("first", a.timestamp("ns", tz="UTC")),
                ("last", a.timestamp("ns", tz="UTC")),
                ("model", text),
                ("parameter", text),
                ("unit", text),
                ("nominal", number),
                ("value", number),
                ("std_filter", number),
                ("std_recording", number),
                ("std_next", number),
                ("shown", a.bool_()),
                ("verdict", text),
                ("codes", a.list_(text)),
                ("reason", text),
                ("drift_before", number),
                ("drift_after", number),
                ("used", a.int64()),
                ("gated", a.int64()),
                ("error", text),
            ]
        )

    def write(self, part: CataloguePart, entry: Entry) -> None:
        """Replace the rows of a recording."""
        self._save(part, [{"vehicle": part.vehicle, **_stamped(row)} for row in entry.rows])

    def rename(self, part: CataloguePart, vehicle: str) -> None:
        """Change the vehicle in the rows of a recording."""
        rows = self.rows_of(part.recording)
        renamed = CataloguePart(part.recording, vehicle, part.fingerprint, part.extrinsics)
        self._save(renamed, [{**row, "vehicle": vehicle} for row in rows])

    def parts(self) -> Iterator[CataloguePart]:
        """Yield each recording's part, and set faulty files aside; parts of another schema are skipped.

        Raises InputError if a file cannot be set aside.
        """
        for path in sorted(self.rows.glob("*.parquet")):
            try:
                part = self._read_part(path)
            except InputError as error:
                self._set_aside(path, str(error))
                continue
            if part.schema == SCHEMA:
                yield part

    def rows_of(self, recording: str) -> list[Row]:
        """Return the rows of a recording. Raises InputError if its part is damaged."""
        content = self._read_checked(self._path(recording))
        found: list[Row] = self._arrow.parquet.read_table(self._arrow.BufferReader(content)).to_pylist()
        return found

    def _read_part(self, path: Path) -> CataloguePart:
        """Read a file's own description. Raises InputError if it is no part, damaged, or misnamed."""
        content = self._read_checked(path)
        try:
            metadata = json.loads(self._arrow.parquet.read_schema(self._arrow.BufferReader(content)).metadata[_KEY])
            part = CataloguePart(**metadata)
        except (OSError, KeyError, TypeError, ValueError, self._arrow.ArrowException) as error:
            raise InputError(f"{path}: was not written by this version of dvl-calib fleet") from error
        if path != self._path(part.recording):
            raise InputError(f"{path}: holds {part.recording}, which belongs in a file of another name")
        return part

    def _read_checked(self, path: Path) -> bytes:
        """Read a file. Raises InputError if any bit has changed."""
        content = read_file(path, "part of a catalogue")
        if _CHECKSUM not in content or _with_checksum(content) != content:
            raise InputError(f"{path}: is damaged, or was not written by this version of dvl-calib fleet")
        return content

    def _set_aside(self, path: Path, why: str) -> None:
        """Move a faulty file to the folder `ASIDE`, and note why."""
        aside = self.folder / ASIDE
        place = aside / path.name
        try:
            aside.mkdir(exist_ok=True)
            number = 1
            while os.path.lexists(place):
                number += 1
                place = aside / f"{path.name}.{number}"
            os.rename(path, place)
        except OSError as error:
            raise InputError(f"{why}; it cannot be moved to {place} ({error.strerror}): remove it") from error
        self.notes.append(f"{why}; it is kept as {place}, and its recording, if found, is calibrated again")

    def _path(self, recording: str) -> Path:
        name = re.sub(r"[^\w.-]+", "_", recording.rpartition("/")[2])[:60]
        return self.rows / f"{name}-{hashlib.sha256(recording.encode()).hexdigest()[:16]}.parquet"

    def _save(self, part: CataloguePart, rows: list[Row]) -> None:
        """Write the rows of a recording as a Parquet file with its checksum."""
        rows = [{name: as_cell(value) for name, value in row.items()} for row in rows]
        metadata = {_KEY: json.dumps(vars(part)), _CHECKSUM_KEY: _CHECKSUM + _ZEROS}
        table = self._arrow.Table.from_pylist(rows, schema=self._schema.with_metadata(metadata))
        sink = self._arrow.BufferOutputStream()
        self._arrow.parquet.write_table(table, sink, write_page_checksum=True)  # for other readers
        content = _with_checksum(sink.getvalue().to_pybytes())
        save_bytes(self._path(part.recording), content, keep=lambda _: [])


def _with_checksum(content: bytes) -> bytes:
    """Replace a part's checksum by the right one."""
    # the last occurrence: metadata follow the rows, and the checksum the other metadata
    at = content.rfind(_CHECKSUM) + len(_CHECKSUM)
    before, after = content[:at], content[at + len(_ZEROS) :]
    return before + hashlib.sha256(before + _ZEROS + after).hexdigest().encode() + after


def _stamped(row: Row) -> Row:
    """Convert stamps to times."""
    values = {name: value for name, value in row.items() if not name.endswith("_ns")}
    return values | {name: row.get(f"{name}_ns") for name in ("first", "last")}


def _arrow() -> Any:
    """Return pyarrow. Raises InputError if it is not installed."""
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(f"fleet needs pyarrow ({error}); pip install 'dvl_calib_ros[fleet]'") from error
    return pyarrow


@dataclass(frozen=True, repr=False)
class Fleet(Answering):
    """Content of a catalogue after a run.

    Parameters
    ----------
    out
        Folder of the catalogue: ``rows/*.parquet``, ``index.html``.
    recordings
        Number of recordings in the catalogue.
    calibrated, unchanged
        Number of them that this run calibrated, and that were up to date.
    vehicles
        Vehicles with their calibrations by day, and the moves of the mounting.
    persons
        Recordings that need a person's decision, with the reasons.
    notes
        Unreadable places.
    """

    out: Path
    recordings: int
    calibrated: int
    unchanged: int
    vehicles: tuple[VehicleHistory, ...]
    persons: tuple[NeedsPerson, ...]
    notes: tuple[str, ...]

    @property
    def page(self) -> Path:
        """Path of the page."""
        return self.out / PAGE

    @property
    def verdict(self) -> str:
        """The answer, under the name common to all results."""
        return self.word

    @property
    def word(self) -> str:
        """The answer: whether any mounting moved."""
        words = [vehicle.compared.word for vehicle in self.vehicles if vehicle.compared is not None]
        return next((word for word in reversed(ANSWERS) if word in words), "not compared")


def run_fleet(
    places: Sequence[str],
    out: Path,
    parameters: Parameters,
    given: Given,
    workers: Workers,
    vehicle_from: str | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Fleet:
    """Calibrate new and changed recordings, and read the catalogue. The page is not written.

    places: folders, files, URLs.
    given: named parameters and topics.
    vehicle_from: a regular expression; by default the first folder below a place. Raises InputError for an invalid
      place, a catalogue that cannot be written, and unavailable workers; finished recordings are kept.
    """
    if parameters.initial_calibration:
        raise InputError("initial_calibration: recordings of a fleet are each calibrated by themselves; leave it out")
    pattern = vehicle_pattern(vehicle_from)
    recordings, notes = recordings_in(places)
    check_outputs({}, [Path(recording.where) for recording in recordings if not recording.is_remote], {"--out": out})
    catalogue = Catalogue(out)
    options = _options(parameters, given)
    known = {part.recording: part for part in catalogue.parts()}
    to_do = []
    for recording in recordings:
        vehicle, part = recording.vehicle(pattern), known.get(recording.name)
        if part is None or part.fingerprint != _fingerprint(recording, options):
            to_do.append(recording)
        elif part.vehicle != vehicle:
            catalogue.rename(part, vehicle)
    for recording in to_do:
        if recording.where.startswith("memory://") and (workers.dask or workers.jobs != 1):
            raise InputError(f"{recording.where}: is in the memory of this process alone; read it with --jobs 1")
    tasks = [Task(recording, parameters, given) for recording in to_do]
    for number, (index, entry) in enumerate(outcomes_as_done(entry_of, tasks, workers), start=1):
        each = to_do[index]
        if isinstance(entry, Lost):
            entry = failed(each.name, entry.why, is_final=False)
        fingerprint = _fingerprint(each, options) if entry.is_final else ""
        catalogue.write(CataloguePart(each.name, each.vehicle(pattern), fingerprint, entry.extrinsics), entry)
        on_progress(number / len(tasks))
    return _read_catalogue(catalogue, len(to_do), len(recordings) - len(to_do), notes)


def _read_catalogue(catalogue: Catalogue, calibrated: int, unchanged: int, notes: Sequence[str]) -> Fleet:
    """Read the catalogue and compute the history of each vehicle."""
    entries = [
        Catalogued.of(part.recording, part.vehicle, catalogue.rows_of(part.recording), part.extrinsics)
        for part in sorted(catalogue.parts(), key=lambda part: part.recording)
    ]
    unique, doubled = distinct(entries)
    return Fleet(
        out=catalogue.folder,
        recordings=len(entries),
        calibrated=calibrated,
        unchanged=unchanged,
        vehicles=tuple(histories(unique)),
        persons=(*doubled, *need_person(unique)),
        notes=(*notes, *catalogue.notes),
    )


def _options(parameters: Parameters, given: Given) -> str:
    named = {**asdict(given), "parameters": sorted(given.parameters)}
    return json.dumps([__version__, SCHEMA, parameters.as_dict(), named], sort_keys=True, default=str)


def _fingerprint(recording: StoredRecording, options: str) -> str:
    """Return a text that changes with the recording, the program or the options."""
    files = [(as_text(file.where), file.size, file.stamp) for file in recording.files]
    return hashlib.sha256(json.dumps([options, files]).encode()).hexdigest()
