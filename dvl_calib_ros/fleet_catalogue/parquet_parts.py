"""Files of the catalogue: one Parquet file per recording, all with one schema, which readers combine to a table.

Each file is written atomically, under a name derived from the recording's location: a killed run loses only the current
recording, and no row is repeated. The file's metadata have the information to continue a run, and a checksum of the
whole file, which is verified before parsing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..disk.atomic import check_folder_writable, save_bytes
from ..disk.text_files import read_file
from ..errors import InputError, as_cell
from .recording_entry import Entry, Row

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
        own = CataloguePart(part.recording, vehicle, part.fingerprint, part.extrinsics)
        self._save(own, [{**row, "vehicle": vehicle} for row in rows])

    def parts(self) -> Iterator[CataloguePart]:
        """Yield each recording's part, and set faulty files aside; parts of another schema are skipped.

        Raises InputError if a file cannot be set aside.
        """
        for path in sorted(self.rows.glob("*.parquet")):
            try:
                part = self._part(path)
            except InputError as error:
                self._set_aside(path, str(error))
                continue
            if part.schema == SCHEMA:
                yield part

    def rows_of(self, recording: str) -> list[Row]:
        """Return the rows of a recording. Raises InputError if its part is damaged."""
        from pyarrow import parquet

        content = self._whole(self._path(recording))
        found: list[Row] = parquet.read_table(self._arrow.BufferReader(content)).to_pylist()
        return found

    def _part(self, path: Path) -> CataloguePart:
        """Read a file's own description. Raises InputError if it is no part, damaged, or misnamed."""
        from pyarrow import parquet

        content = self._whole(path)
        try:
            told = json.loads(parquet.read_schema(self._arrow.BufferReader(content)).metadata[_KEY])
            part = CataloguePart(**told)
        except (OSError, KeyError, TypeError, ValueError, self._arrow.ArrowException) as error:
            raise InputError(f"{path}: was not written by this version of dvl-calib fleet") from error
        if path != self._path(part.recording):
            raise InputError(f"{path}: belongs to {part.recording}, whose part has another name")
        return part

    def _whole(self, path: Path) -> bytes:
        """Read a file. Raises InputError if any bit has changed."""
        content = read_file(path, "part of a catalogue")
        if _CHECKSUM not in content or _with_checksum(content) != content:
            raise InputError(f"{path}: is damaged, or was not written by this version of dvl-calib fleet")
        return content

    def _set_aside(self, path: Path, why: str) -> None:
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
        from pyarrow import parquet

        rows = [{name: as_cell(value) for name, value in row.items()} for row in rows]
        told = {_KEY: json.dumps(vars(part)), _CHECKSUM_KEY: _CHECKSUM + _ZEROS}
        table = self._arrow.Table.from_pylist(rows, schema=self._schema.with_metadata(told))
        sink = self._arrow.BufferOutputStream()
        parquet.write_table(table, sink, write_page_checksum=True)  # for other readers
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
    own = {name: value for name, value in row.items() if not name.endswith("_ns")}
    return own | {name: row.get(f"{name}_ns") for name in ("first", "last")}


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError as error:
        raise InputError(f"fleet needs pyarrow ({error}); pip install 'dvl_calib_ros[fleet]'") from error
    return pyarrow
