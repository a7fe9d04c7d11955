"""JSON files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from .atomic import save_text


def as_json(document: Any) -> str:
    """JSON, in which numbers that are not finite are null."""
    return json.dumps(_finite(document), indent=1, allow_nan=False) + "\n"


def write_json(path: Path, document: Any) -> None:
    """Write JSON, whole or not at all. Raises InputError."""
    save_text(path, as_json(document))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
