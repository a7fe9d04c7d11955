"""One recording of a fleet: its calibration as by `replay`, and its entry in the catalogue."""

from __future__ import annotations

import errno
import math
import os
import re
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import date, datetime, timezone
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..bag_replay.checked_replay import checked_replay
from ..bag_replay.replay import Replayed, extrinsics_of_replay, memory_given_back
from ..bags.files import STORAGE_SUFFIXES, storage_suffix
from ..calibration.checks.speed_of_sound import Water
from ..calibration.models.parameters import Parameters
from ..calibration.results.mounting_quantities import LATE, quantities
from ..calibration.results.results import Estimate, Result
from ..discovery.discover import discover
from ..discovery.discovery import Given
from ..errors import InputError
from ..recordings.recording import open_recording

METADATA = "metadata.yaml"
# next to a database whose recorder died
_JOURNALS = ("-wal", "-journal")
# fields by which object stores distinguish versions of a file; the first existing one is used
_VERSIONS = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated", "created")


@dataclass(frozen=True)
class StoredFile:
    """A file of a recording. where: absolute path, or URL. stamp: changes with its content (mtime, etag)."""

    where: str
    size: int
    stamp: str


@dataclass(frozen=True)
class StoredRecording:
    """A recording below a place.

    where: absolute path or URL of the folder or the one file. inside: path below the place.
    """

    where: str
    inside: str
    place: str
    files: tuple[StoredFile, ...]

    @property
    def name(self) -> str:
        """`where` as printable text."""
        return as_text(self.where)

    @property
    def is_remote(self) -> bool:
        """Return whether the recording must be copied before it can be read."""
        return "://" in self.where

    def vehicle(self, pattern: re.Pattern[str] | None) -> str:
        """Return its vehicle: the pattern's match in its path, else the first folder below the place, or the place."""
        if pattern is not None:
            found = pattern.search(self.name)
            if found is None:
                return "unknown"
            return next((group for group in found.groups() if group), found[0])
        folders = PurePosixPath(self.inside).parts
        return as_text(folders[0] if len(folders) > 1 else PurePosixPath(self.place).name or self.place)

    @contextmanager
    def local_copy(self) -> Iterator[Path]:
        """Yield a local path of the recording."""
        if not self.is_remote:
            if not os.path.exists(self.where):  # missing on another worker's machine; the recording itself has no fault
                raise FileNotFoundError(f"{self.where} is not there on {os.uname().nodename}")
            yield Path(self.where)
            return
        with tempfile.TemporaryDirectory(prefix="dvl_calib_fleet_") as folder:
            store = _open_store(self.where)[0]
            target = Path(folder) / PurePosixPath(self.where).name
            is_folder = [file.where for file in self.files] != [self.where]
            if is_folder:
                target.mkdir()
            for file in self.files:
                store.get_file(file.where, str(target / PurePosixPath(file.where).name if is_folder else target))
            yield target


def as_text(name: str) -> str:
    """Return a file name with invalid UTF-8 as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def vehicle_pattern(text: str | None) -> re.Pattern[str] | None:
    """Compile ``--vehicle-from``. Raises InputError for an invalid regular expression."""
    if not text:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise InputError(
            f"--vehicle-from: {text!r} is no regular expression ({error}); such as '/(auv\\d+)/', or leave it out"
        ) from error


def recordings_in(places: Sequence[str]) -> tuple[list[StoredRecording], list[str]]:
    """Return all recordings below places, each once, in order of their paths; and notes on unreadable files.

    places: folders, files or URLs. Raises InputError for an invalid place, and if there is no recording.
    """
    found: dict[str, StoredRecording] = {}
    unread: list[str] = []
    for place in places:
        files = _local_files(place, unread) if "://" not in place or place.startswith("file://") else _in_store(place)
        for recording in _group_into_recordings(*files):
            found.setdefault(recording.where, recording)
    if not found:
        raise InputError(f"{', '.join(places)}: no recording (.mcap, .db3, .bag) there or below; name another place")
    return [found[where] for where in sorted(found)], unread


def _is_of_a_recording(name: str) -> bool:
    plain = next((name.removesuffix(end) for end in _JOURNALS if name.endswith(end)), name)
    return name == METADATA or storage_suffix(Path(plain)) in STORAGE_SUFFIXES


# a place, and its files by their folders
_Files = tuple[str, dict[str, list[StoredFile]]]


def _local_files(place: str, unread: list[str]) -> _Files:
    """Return root and files by folder of a local place; unreadable ones are added to `unread`."""
    root = os.path.abspath(place.removeprefix("file://"))
    if os.path.isfile(root):
        folder, name = os.path.split(root)
        return folder, {folder: [_local_file(root)] if _is_of_a_recording(name) else []}
    if not os.path.isdir(root):
        raise InputError(f"{place}: no such folder or file; name where recordings are")
    files: dict[str, list[StoredFile]] = {}
    seen = set()
    for folder, folders, names in os.walk(
        root,
        followlinks=True,
        onerror=lambda error: unread.append(f"{error.filename}: {error.strerror}; not looked into"),
    ):
        real = os.path.realpath(folder)
        if real in seen:  # a circular link
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        recording_files = [name for name in sorted(names) if _is_of_a_recording(name) and not name.startswith(".")]
        for name in recording_files:
            try:
                files.setdefault(folder, []).append(_local_file(os.path.join(folder, name)))
            except OSError as error:  # a dangling link
                unread.append(f"{os.path.join(folder, name)}: {error.strerror}; not read")
    return root, files


def _local_file(path: str) -> StoredFile:
    """Return a local file with size and time of change. Raises OSError if it is no regular file."""
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "is no file")  # a pipe would block
    return StoredFile(path, status.st_size, str(status.st_mtime_ns))


def _in_store(place: str) -> _Files:
    """Return the root of a place in an object store, and its recordings' files by folder. Raises InputError."""
    store, root = _open_store(place)
    try:
        found: Mapping[str, Mapping[str, Any]] = store.find(root, detail=True)
    except Exception as error:  # each store has its own errors
        raise InputError(
            f"{place}: cannot be listed ({type(error).__name__}: {error}); check address and access rights"
        ) from error
    files: dict[str, list[StoredFile]] = {}
    for path, info in sorted(found.items()):
        where = store.unstrip_protocol(path)
        folder, _, name = where.rpartition("/")
        if _is_of_a_recording(name) and not name.startswith("."):
            stamp = next((str(info[key]) for key in _VERSIONS if info.get(key) is not None), "")
            files.setdefault(folder, []).append(StoredFile(where, int(info.get("size") or 0), stamp))
    is_file = list(found) == [root]
    place = store.unstrip_protocol(root)
    return place.rpartition("/")[0] if is_file else place.rstrip("/"), files


def _open_store(place: str) -> tuple[Any, str]:
    """Return the store of a URL, and the path in it. Raises InputError."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise InputError(f"{place}: object stores need fsspec ({error}); pip install 'dvl_calib_ros[fleet]'") from error
    try:
        store, root = url_to_fs(place)
    except (ImportError, ValueError) as error:  # fsspec's message names the missing package
        raise InputError(f"{place}: {error}") from error
    return store, root


def _group_into_recordings(place: str, folders: Mapping[str, Sequence[StoredFile]]) -> Iterator[StoredRecording]:
    """Yield bags and single files: a folder is one bag if its files are numbered as rosbag2 does."""
    bags: list[str] = []
    for folder, files in sorted(folders.items()):
        if any(folder.startswith(f"{bag}/") for bag in bags[-1:]):
            continue  # a folder inside a bag is part of it
        storage = [file for file in files if storage_suffix(Path(file.where)) in STORAGE_SUFFIXES]
        if not storage:
            continue
        inside = folder[len(place) :].strip("/")
        if _is_bag(folder, files, storage):
            bags.append(folder)
            yield StoredRecording(folder, inside, place, tuple(files))
            continue
        for each in storage:
            name = each.where.rpartition("/")[2]
            parts = [file for file in files if file.where in (each.where, *(each.where + end for end in _JOURNALS))]
            yield StoredRecording(each.where, f"{inside}/{name}".strip("/"), place, tuple(parts))


def _is_bag(folder: str, files: Sequence[StoredFile], storage: Sequence[StoredFile]) -> bool:
    """Return whether a folder has rosbag2's metadata, or only files numbered as rosbag2 does."""
    if any(file.where.endswith(f"/{METADATA}") for file in files):
        return True
    numbered = re.compile(re.escape(folder.rpartition("/")[2]) + r"_\d+\.")  # rosbag2's numbering of files
    return all(numbered.match(file.where.rpartition("/")[2]) for file in storage)


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
        with task.recording.local_copy() as path:
            try:
                return _calibrate(task, path)
            except InputError as error:
                return failed(where, as_text(str(error).replace(str(path), task.recording.where)))
    except Exception as error:
        return failed(where, as_text(f"{type(error).__name__}: {error}"), is_final=False)


def failed(where: str, why: str, is_final: bool = True) -> Entry:
    """Return the entry of a recording that could not be calibrated."""
    return Entry([{"recording": where, "error": why}], None, is_final)


def _calibrate(task: Task, path: Any) -> Entry:
    """Discover topics and frames of a recording and replay it."""
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
        "codes": [reason.code for reason in verification.reasons],
        "reason": verification.reasons[0].full_sentence if verification.reasons else "",
        "drift_before": math.nan if drift is None else drift.before.per_km,
        "drift_after": math.nan if drift is None else drift.after.per_km,
    }
    if result.first_ns is not None and result.last_ns is not None:
        common |= {"first_ns": result.first_ns, "last_ns": result.last_ns}
        common["day"] = _day(result.first_ns)
    extrinsics, without_day = (extrinsics_of_replay(variant, where) for variant in (replayed, _without_day(replayed)))
    extrinsics_row = None
    if extrinsics is not None and without_day is not None:
        values = asdict(extrinsics) | {"covariance_of_recording": without_day.covariance}
        extrinsics_row = {n: each.tolist() if isinstance(each, np.ndarray) else each for n, each in values.items()}
        if replayed.cause_of_scale is not None:
            extrinsics_row["cause_of_scale"] = replayed.cause_of_scale.sentence
    rows = (*_quantities(result), *_heading(estimate), *_water(replayed.water))
    return Entry([common | row for row in rows], extrinsics_row)


def _day(stamp_ns: int) -> date | None:
    """Return the UTC date of a stamp; None for an invalid one."""
    try:
        return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).date()
    except (ValueError, OverflowError, OSError):  # an invalid time
        return None


def _quantities(result: Result) -> list[Row]:
    """Return rows of mounting, scale and delay, with σ of the filter, of this recording, and of the next."""
    estimate = result.estimate
    covariances = (estimate.filter_covariance, estimate.recording_covariance, estimate.covariance)
    by_claim = [
        quantities(
            replace(result, estimates={**result.estimates, result.selected: replace(estimate, covariance=claim)})
        )
        for claim in covariances
    ]
    return [
        {
            "parameter": "time_offset" if last.name.startswith(LATE) else last.name.replace(" ", "_"),
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


def _without_day(replayed: Replayed) -> Replayed:
    """Return the replay with σ of this recording only, without the variation between days."""
    parameters = {**replayed.result.parameters, **dict.fromkeys(_DAY, 0.0)}
    return replace(replayed, result=replace(replayed.result, parameters=parameters))
