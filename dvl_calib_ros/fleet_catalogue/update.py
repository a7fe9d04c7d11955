"""Calibration of every recording in the given places into a growing catalogue."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..calibration.comparison.mounting_change import ANSWERS
from ..calibration.models.parameters import Parameters
from ..discovery.discovery import Given
from ..disk.atomic import check_folder_writable, save_bytes
from ..disk.text_files import read_file
from ..errors import InputError, as_cell
from ..files.output_paths import check_outputs
from ..parallel import Lost, Workers, outcomes_as_done
from ..verdict.answering import Answering
from ..version import __version__
from .recording_entry import (
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
from .vehicle_history import Catalogued, NeedsPerson, VehicleHistory, distinct, histories, need_person

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
    _check_reach(to_do, workers)
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


def _check_reach(remaining: Sequence[StoredRecording], workers: Workers) -> None:
    """Raise InputError for files that other processes cannot read."""
    for recording in remaining:
        if recording.where.startswith("memory://") and (workers.dask or workers.jobs != 1):
            raise InputError(f"{recording.where}: is in the memory of this process alone; read it with --jobs 1")


def _options(parameters: Parameters, given: Given) -> str:
    named = {**asdict(given), "parameters": sorted(given.parameters)}
    return json.dumps([__version__, SCHEMA, parameters.as_dict(), named], sort_keys=True, default=str)


def _fingerprint(recording: StoredRecording, options: str) -> str:
    """Return a text that changes with the recording, the program or the options."""
    files = [(as_text(file.where), file.size, file.stamp) for file in recording.files]
    return hashlib.sha256(json.dumps([options, files]).encode()).hexdigest()
