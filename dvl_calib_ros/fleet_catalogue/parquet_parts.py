"""The catalogue on the disk: a Parquet file a recording, all of one schema, which readers take as one table.

Each is written whole or not at all, under a name that follows from where the recording is: a run that is killed loses
what it was at, and none has a row twice. What a run needs to go on is in the file's own metadata.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..disk.atomic import check_folder_writable, save_bytes
from ..errors import InputError
from .recording_entry import Entry, Row

ROWS, PAGE = "rows", "index.html"
# Version of the schema: part of what says whether a recording is done
SCHEMA = 2
_KEY = b"dvl_calib"


@dataclass(frozen=True)
class CataloguePart:
    """A recording in the catalogue. fingerprint: of recording, program and options; '' is to be done again."""

    recording: str
    vehicle: str
    fingerprint: str
    extrinsics: Mapping[str, Any] | None
    schema: int = SCHEMA


class Catalogue:
    """A folder with ``rows/*.parquet``. Raises InputError where it cannot be written, or without pyarrow."""

    def __init__(self, folder: Path):
        self._arrow = _arrow()
        self.folder = folder
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
        """Put the rows of a recording in the place of those before."""
        self._save(part, [{"vehicle": part.vehicle, **_stamped(row)} for row in entry.rows])

    def rename(self, part: CataloguePart, vehicle: str) -> None:
        """Give the rows of a recording another vehicle."""
        rows = self.rows_of(part.recording)
        own = CataloguePart(part.recording, vehicle, part.fingerprint, part.extrinsics)
        self._save(own, [{**row, "vehicle": vehicle} for row in rows])

    def parts(self) -> Iterator[CataloguePart]:
        """All recordings; what is no part, damaged, or of another schema is passed over, and so done again."""
        from pyarrow import parquet

        for path in sorted(self.rows.glob("*.parquet")):
            try:
                told = json.loads(parquet.read_schema(path).metadata[_KEY])
                part = CataloguePart(**told)
            except (OSError, KeyError, TypeError, ValueError, self._arrow.ArrowException):
                continue
            if part.schema == SCHEMA:
                yield part

    def rows_of(self, recording: str) -> list[Row]:
        """Rows of a recording."""
        from pyarrow import parquet

        found: list[Row] = parquet.read_table(self._path(recording), partitioning=None).to_pylist()
        return found

    def _path(self, recording: str) -> Path:
        name = re.sub(r"[^\w.-]+", "_", recording.rpartition("/")[2])[:60]
        return self.rows / f"{name}-{hashlib.sha256(recording.encode()).hexdigest()[:16]}.parquet"

    def _save(self, part: CataloguePart, rows: list[Row]) -> None:
        from pyarrow import parquet

        told = {_KEY: json.dumps(vars(part))}
        table = self._arrow.Table.from_pylist(rows, schema=self._schema.with_metadata(told))
        sink = self._arrow.BufferOutputStream()
        parquet.write_table(table, sink)
        save_bytes(self._path(part.recording), sink.getvalue().to_pybytes(), keep=lambda _: [])


def _stamped(row: Row) -> Row:
    """With times instead of stamps."""
    own = {name: value for name, value in row.items() if not name.endswith("_ns")}
    return own | {name: row.get(f"{name}_ns") for name in ("first", "last")}


def _arrow() -> Any:
    try:
        import pyarrow
    except ImportError as error:
        raise InputError(f"fleet needs pyarrow ({error}); pip install 'dvl_calib_ros[fleet]'") from error
    return pyarrow
