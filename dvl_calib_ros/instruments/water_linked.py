"""Configuration of a Water Linked DVL over TCP by its protocol (get_config, set_config)."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Sequence
from typing import Any

from ..errors import InputError
from .settings import Setting

PORT = 16171
ADDRESS = re.compile(r"(?:\[(?P<ipv6>[0-9A-Fa-f:.%\w]+)\]|(?P<host>[^:\[\]]+))(?::(?P<port>\d{1,5}))?", re.ASCII)
# a DVL without an answer within this time, s, is not there; a longer line, bytes, is no report
PATIENCE_S, LONGEST_LINE = 10.0, 1 << 20
# characters shown of the reason for a refusal
LONGEST_REASON = 200
# Resolution of a setting: two decimals. Firmware before 2.2.1 has whole degrees and m/s, and must be set by hand.
AS_SET = 0.0051


def configure(address: str, settings: Sequence[Setting], dry_run: bool = False) -> bool:
    """Send new settings and read them back; send nothing if dry_run. Return whether they were already set.

    address: HOST or HOST:PORT, an IPv6 address in brackets. Raises InputError if there is no answer or a refusal, or if
    another value is read back. Also if the current settings are not the recording's: the calibration is relative to
    these.
    """
    parts = ADDRESS.fullmatch(address)
    port = int(parts["port"] or PORT) if parts is not None else 0
    if parts is None or not 0 < port < 65536:
        raise InputError(f"--send {address}: is not HOST or HOST:PORT (IPv6 in brackets: [::1])")
    is_sent = False
    try:
        with socket.create_connection((parts["ipv6"] or parts["host"], port), timeout=PATIENCE_S) as connection:
            dvl = _Dvl(connection, address)
            before = dvl.ask({"command": "get_config"})
            if all(_is(before, each.name, each.new) for each in settings):
                return True
            for each in settings:
                if each.now is None or not _is(before, each.name, each.now):
                    raise InputError(
                        f"{address}: {each.name} is {_held(before, each.name)}, and was {each.now} when the "
                        "data were recorded (--now), which the calibration is relative to; record again, or set "
                        "it yourself"
                    )
            if dry_run:
                return False
            is_sent = True
            dvl.ask({"command": "set_config", "parameters": {each.name: each.new for each in settings}})
            after = dvl.ask({"command": "get_config"})
    except UnicodeError as error:
        raise InputError(f"--send {address}: is no name that a host can have; give its name or address") from error
    except OSError as error:
        why = error.strerror or "no answer"
        if is_sent:
            raise InputError(
                f"{address}: {why} after set_config was sent, so the DVL may be set or not; repeat the command, "
                "which first reads the current settings"
            ) from error
        raise InputError(f"{address}: {why}; is the DVL on, and the address right?") from error
    for each in settings:
        if not _is(after, each.name, each.new):
            raise InputError(
                f"{address}: {each.name} was set to {each.new:g} and is {_held(after, each.name)}; look at the DVL's "
                "own page"
            )
    return False


def _held(config: Any, name: str) -> float | str:
    """Return the number that a DVL has under a name."""
    held = config.get(name) if isinstance(config, dict) else None
    return held if isinstance(held, float) else "no number"


def _is(config: Any, name: str, value: float) -> bool:
    held = _held(config, name)
    return isinstance(held, float) and abs(held - value) <= AS_SET


class _Dvl:
    """A connection on which reports come between the answers."""

    def __init__(self, connection: socket.socket, address: str) -> None:
        self._connection, self._address, self._pending = connection, address, b""

    def ask(self, command: dict[str, Any]) -> Any:
        """Return the result of a command. Raises InputError if it is refused, OSError if no answer comes."""
        self._connection.sendall(json.dumps(command).encode() + b"\n")
        until = time.monotonic() + PATIENCE_S
        while True:
            line = self._line(until)
            try:
                answer = json.loads(line, parse_int=float)  # as float, because an integer may be too long to parse
            except (ValueError, RecursionError):
                continue
            if not isinstance(answer, dict) or answer.get("response_to") != command["command"]:
                continue
            if answer.get("success") is not True:
                told = answer.get("error_message")
                why = told[:LONGEST_REASON] if told and isinstance(told, str) else "no reason given"
                raise InputError(f"{self._address}: refuses {command['command']} ({why})")
            return answer.get("result")

    def _line(self, until: float) -> bytes:
        while b"\n" not in self._pending:
            left = until - time.monotonic()
            if left <= 0.0 or len(self._pending) > LONGEST_LINE:
                raise TimeoutError("no answer")
            self._connection.settimeout(left)
            got = self._connection.recv(1 << 16)
            if not got:
                raise ConnectionResetError(0, "it closed the connection")
            self._pending += got
        line, _, self._pending = self._pending.partition(b"\n")
        return line
