"""Calibration of every recording below some places into a growing catalogue."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ..calibration.models.parameters import Parameters
from ..discovery.discovery import Given
from ..errors import InputError
from ..files.output_paths import check_outputs
from ..parallel import Lost, Workers, outcomes_as_done
from ..verdict.answering import Answering
from ..version import __version__
from .parquet_parts import PAGE, SCHEMA, Catalogue, CataloguePart
from .recording_entry import Task, entry_of, failed
from .recording_search import StoredRecording, as_text, recordings_in, vehicle_pattern
from .vehicle_history import Catalogued, NeedsPerson, VehicleHistory, distinct, histories, need_person

# answers of a comparison, the worst first
WORDS = ("moved", "suspicious", "same")


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
        words = [each.compared.word for each in self.vehicles if each.compared is not None]
        return next((word for word in WORDS if word in words), "not compared")


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

    places: folders, files, URLs. given: named parameters and topics. vehicle_from: a regular expression; by default the
    first folder below a place. Raises InputError for an invalid place, a catalogue that cannot be written, and
    unavailable workers; finished recordings are kept.
    """
    if parameters.initial_calibration:
        raise InputError("initial_calibration: recordings of a fleet are each calibrated by themselves; leave it out")
    pattern = vehicle_pattern(vehicle_from)
    recordings, notes = recordings_in(places)
    check_outputs({}, [Path(each.where) for each in recordings if not each.is_remote], {"--out": out})
    catalogue = Catalogue(out)
    options = _options(parameters, given)
    known = {part.recording: part for part in catalogue.parts()}
    left = []
    for each in recordings:
        vehicle, part = each.vehicle(pattern), known.get(each.name)
        if part is None or part.fingerprint != _fingerprint(each, options):
            left.append(each)
        elif part.vehicle != vehicle:
            catalogue.rename(part, vehicle)
    _check_reach(left, workers)
    tasks = [Task(each, parameters, given) for each in left]
    for number, (index, entry) in enumerate(outcomes_as_done(entry_of, tasks, workers), start=1):
        each = left[index]
        if isinstance(entry, Lost):
            entry = failed(each.name, entry.why, is_final=False)
        fingerprint = _fingerprint(each, options) if entry.is_final else ""
        catalogue.write(CataloguePart(each.name, each.vehicle(pattern), fingerprint, entry.extrinsics), entry)
        on_progress(number / len(tasks))
    return _read(catalogue, len(left), len(recordings) - len(left), notes)


def _read(catalogue: Catalogue, calibrated: int, unchanged: int, notes: Sequence[str]) -> Fleet:
    entries = [
        Catalogued.of(part.recording, part.vehicle, catalogue.rows_of(part.recording), part.extrinsics)
        for part in sorted(catalogue.parts(), key=lambda part: part.recording)
    ]
    left, doubled = distinct(entries)
    return Fleet(
        out=catalogue.folder,
        recordings=len(entries),
        calibrated=calibrated,
        unchanged=unchanged,
        vehicles=tuple(histories(left)),
        persons=(*doubled, *need_person(left)),
        notes=(*notes, *catalogue.notes),
    )


def _check_reach(left: Sequence[StoredRecording], workers: Workers) -> None:
    """Raise InputError for files that other processes cannot read."""
    for each in left:
        if each.where.startswith("memory://") and (workers.dask or workers.jobs != 1):
            raise InputError(f"{each.where}: is in the memory of this process alone; read it with --jobs 1")


def _options(parameters: Parameters, given: Given) -> str:
    named = {**asdict(given), "parameters": sorted(given.parameters)}
    return json.dumps([__version__, SCHEMA, parameters.as_dict(), named], sort_keys=True, default=str)


def _fingerprint(recording: StoredRecording, options: str) -> str:
    """Return a text that changes with the recording, the program or the options."""
    files = [(as_text(each.where), each.size, each.stamp) for each in recording.files]
    return hashlib.sha256(json.dumps([options, files]).encode()).hexdigest()
