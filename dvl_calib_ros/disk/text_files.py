"""Size-limited reading of files, and JSON output."""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import Any

from ..errors import InputError
from .atomic import save_text


def as_json(document: Any) -> str:
    """Format as JSON; numbers that are not finite become null."""
    return json.dumps(_finite(document), indent=1, allow_nan=False) + "\n"


def write_json(path: Path, document: Any) -> None:
    """Write JSON atomically. Raises InputError."""
    save_text(path, as_json(document))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# A result file has about 10 kB. A much larger file is not one, and would take minutes to parse.
LARGEST_FILE = 1 << 22


def read_file(path: Path, what: str, largest: int = LARGEST_FILE) -> bytes:
    """Read a file. `what` names its kind in errors.

    Raises InputError if it cannot be read, is too large, or is a pipe or device, which might block forever.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            mode = os.fstat(handle).st_mode
            if not stat.S_ISREG(mode):
                what_it_is = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
                raise InputError(f"{path}: cannot be read as {what}, it is {what_it_is}; name a file")
            with open(handle, "rb", closefd=False) as file:
                content = file.read(largest + 1)
        finally:
            os.close(handle)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such {what}") from None
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise InputError(f"{path}: cannot be read as {what} ({why})") from error
    if len(content) > largest:
        raise InputError(f"{path}: is too large for a {what}, which has {largest >> 20} MB at most; name another")
    return content
