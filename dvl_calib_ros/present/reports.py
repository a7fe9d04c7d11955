"""Reports that people read: one self-contained HTML file of a result.

Needs matplotlib and jinja2: nobody imports this but when a report is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..bag_replay.replay import Replayed
from ..calibration.comparison import Comparison
from ..disk.atomic import save_bytes
from .comparison_figures import trend_png
from .documents import DOCUMENTS
from .page import write_document
from .replay import replayed

__all__ = ["write_replay_report", "write_report"]


def write_report(path: Path, result: Any) -> None:
    """Write the report (HTML); of a comparison the picture alone if `path` ends in .png.

    Raises InputError if it cannot be written.
    """
    if isinstance(result, Comparison) and path.suffix.lower() == ".png":
        save_bytes(path, trend_png(result))
    else:
        write_document(path, DOCUMENTS[type(result)](result))


def write_replay_report(path: Path, run: Replayed, bags: Sequence[Path], models: Sequence[str]) -> None:
    """Write the report of a replay that was run with a history. models: names to show. Raises InputError."""
    write_document(path, replayed(run, bags, models))
