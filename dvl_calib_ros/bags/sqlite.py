"""rosbag2 databases, read by SQLite while they are sound."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from itertools import islice, takewhile
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from .batches import MOST_BYTES, MOST_MESSAGES, Batch, times
from .channels import Channel, definition_of
from .definitions import Definition
from .salvage.damage import LARGEST_RECORD, DamagedError


class Database:
    """A recording in SQLite; raises sqlite3.Error or DamagedError where it cannot be read.

    counts: channel -> number of its messages. span_ns: first and last log time. astray: messages of topics that it
    does not name.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with closing(self._connection()) as connection:
            self._channels = _channels(connection)
            rows = _rows(
                connection,
                "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id",
                (int, int, int, int),
            )
        self.counts: dict[Channel, int] = dict.fromkeys(self._channels.values(), 0)
        self.astray = 0
        for number, count, *_ in rows:
            if number in self._channels:
                self.counts[self._channels[number]] += count
            else:
                self.astray += count
        known = [row for row in rows if row[0] in self._channels]
        self.span_ns = (min((row[2] for row in known), default=0), max((row[3] for row in known), default=0))

    def batches(self, topics: Collection[str]) -> Iterator[Batch]:
        """Messages of these topics in order of log time; those before what is raised come before it."""
        numbers = [number for number, channel in self._channels.items() if channel.topic in topics]
        own = f"FROM messages WHERE topic_id IN ({','.join('?' * len(numbers))}) AND length(data) <= {LARGEST_RECORD}"
        query = f"SELECT timestamp, topic_id, data {own} ORDER BY timestamp"
        with closing(self._connection()) as connection:
            # grouped by topic, SQLite would sort the messages themselves
            ((longest,),) = connection.execute(f"SELECT max(length(data)) {own}", numbers)
            at_once = max(1, min(MOST_MESSAGES, MOST_BYTES // max(longest or 1, 1)))
            cursor = connection.execute(query, numbers)
            error: Exception | None = None
            while error is None:
                rows: list[tuple[Any, Any, Any]] = []
                try:
                    rows.extend(islice(cursor, at_once))
                except sqlite3.Error as raised:  # what was read before it is in the list
                    error = raised
                if not rows:
                    break
                log_ns, number, data = zip(*rows, strict=True)
                sound = _sound(log_ns, data)
                if sound:
                    yield self._batch(log_ns[:sound], number[:sound], data[:sound])
                if sound < len(rows):
                    raise DamagedError("a message is none")
            if error is not None:
                raise error

    def _batch(self, log_ns: Sequence[int], number: Sequence[int], data: Sequence[bytes]) -> Batch:
        end = np.cumsum([*map(len, data)], dtype=np.intp)
        start = np.concatenate([[0], end[:-1]]).astype(np.intp)
        return Batch(times(log_ns), np.array(number, dtype=np.intp), start, end, b"".join(data), self._channels)

    def _connection(self) -> sqlite3.Connection:
        # immutable: no journal and no lock is looked for, so that nothing is written beside a recording
        uri = f"file:{quote(str(self._path.absolute()), safe='/')}?immutable=1&mode=ro"
        return sqlite3.connect(uri, uri=True, check_same_thread=False)


def _sound(log_ns: Sequence[Any], data: Sequence[Any]) -> int:
    """How many rows, from the first on, are messages."""
    if set(map(type, log_ns)) == {int} and set(map(type, data)) == {bytes} and min(log_ns) >= 0:
        return len(log_ns)
    are = (type(at) is int and at >= 0 and type(content) is bytes for at, content in zip(log_ns, data, strict=True))
    return sum(1 for _ in takewhile(bool, are))


def _channels(connection: sqlite3.Connection) -> dict[int, Channel]:
    tables = {name for (name,) in _rows(connection, "SELECT name FROM sqlite_master WHERE type = 'table'", (str,))}
    if not {"topics", "messages"} <= tables:
        raise DamagedError("its tables of topics and messages are missing")
    of_topics = {row[1] for row in connection.execute("PRAGMA table_info(topics)")}
    has_hash = "type_description_hash" in of_topics
    hashed = "type_description_hash" if has_hash else "''"
    topics = _rows(connection, f"SELECT id, name, type, {hashed} FROM topics ORDER BY id", (int, str, str, str))
    definitions: dict[tuple[str, str], Definition] = {}
    if "message_definitions" in tables:
        columns = f"topic_type, {hashed}, encoding, encoded_message_definition"
        query = f"SELECT {columns} FROM message_definitions ORDER BY id"
        for msgtype, digest, encoding, text in _rows(connection, query, (str, str, str, str)):
            definition = definition_of(encoding, text)
            definitions.setdefault((msgtype, digest), definition)
            definitions.setdefault((msgtype, ""), definition)  # for topics that do not say which of several
    return {
        number: Channel(name, msgtype, definitions.get((msgtype, digest)) or definitions.get((msgtype, "")))
        for number, name, msgtype, digest in topics
    }


def _rows(connection: sqlite3.Connection, query: str, types: tuple[type, ...]) -> list[Any]:
    """All rows of a query, whose columns are of these types; damaged pages can hold anything."""
    try:
        rows = connection.execute(query).fetchall()
    except UnicodeDecodeError as error:  # what SQLite says of damaged names holds them
        raise DamagedError("its tables are damaged") from error
    if any(type(value) is not expected for row in rows for value, expected in zip(row, types, strict=True)):
        raise DamagedError("a table holds what recordings do not")
    return rows
