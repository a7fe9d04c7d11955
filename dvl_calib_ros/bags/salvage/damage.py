"""What reading a damaged recording gives: its whole messages, then what is lost, in words."""

from __future__ import annotations

from typing import NamedTuple

# Nothing in a recording may take more memory than this, whatever it claims: the chunks and messages that recorders
# write are of a few MB.
LARGEST_RECORD = 1 << 28


class Salvaged(NamedTuple):
    """One whole message. definition is the embedded one, '' if there is none; encoding ros2msg or ros2idl."""

    topic: str
    msgtype: str
    encoding: str
    definition: str
    log_ns: int
    data: bytes


class DamagedError(Exception):
    """What is damaged, in words, and how many messages are lost. Raised after the last message that is whole."""

    def __init__(self, what: str, lost: int = 0) -> None:
        super().__init__(what + (f", {lost} message{'s' if lost > 1 else ''} lost" if lost else ""))
        self.what = what


class Damage:
    """Takes note of damaged places on the way, so that reading goes on after each.

    skipped: bytes that are not used because of them; of what is compressed within a chunk, unpacked bytes. lost: how
    many messages fewer were found than the recording counts.
    """

    def __init__(self) -> None:
        self._first = ""
        self._places = 0
        self.skipped = 0
        self.lost = 0

    def note(self, what: str, skipped: int) -> None:
        """One more damaged place, and how many bytes are not used because of it."""
        self._first = self._first or what
        self._places += 1
        self.skipped += skipped

    def __bool__(self) -> bool:
        return self._places > 0 or self.lost > 0

    def raise_if_any(self) -> None:
        """Raise DamagedError with all of it in one sentence."""
        if self:
            more = f" (the first of {self._places} damaged places)" if self._places > 1 else ""
            what = f"{self._first}{more}, {self.skipped} bytes skipped" if self._places else "less than it counts"
            raise DamagedError(what, self.lost)
