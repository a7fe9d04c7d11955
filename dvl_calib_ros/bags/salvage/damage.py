"""Results of reading a damaged recording: whole messages, then a description of the loss."""

from __future__ import annotations

from typing import NamedTuple

# largest size of any record, whatever it claims; chunks and messages of recorders have a few MB
LARGEST_RECORD = 1 << 28


class Salvaged(NamedTuple):
    """One whole message. definition: embedded one, '' if missing. encoding: ros2msg or ros2idl."""

    topic: str
    msgtype: str
    encoding: str
    definition: str
    log_ns: int
    data: bytes


class DamagedError(Exception):
    """Description of the damage and number of lost messages. Raised after the last whole message."""

    def __init__(self, what: str, lost: int = 0) -> None:
        super().__init__(what + (f", {lost} message{'s' if lost > 1 else ''} lost" if lost else ""))
        self.what = what


class Damage:
    """Collector of damaged places, so that reading continues after each.

    skipped: bytes not used because of damage; within a compressed chunk, unpacked bytes. lost: number of messages
    missing compared with the recording's count.
    """

    def __init__(self) -> None:
        self._first = ""
        self._places = 0
        self.skipped = 0
        self.lost = 0

    def note(self, what: str, skipped: int) -> None:
        """Note one more damaged place and the number of bytes not used because of it."""
        self._first = self._first or what
        self._places += 1
        self.skipped += skipped

    def __bool__(self) -> bool:
        return self._places > 0 or self.lost > 0

    def raise_if_any(self) -> None:
        """Raise DamagedError with one sentence on all damage, if any."""
        if self:
            more = f" (the first of {self._places} damaged places)" if self._places > 1 else ""
            what = f"{self._first}{more}, {self.skipped} bytes skipped" if self._places else "less than it counts"
            raise DamagedError(what, self.lost)
