"""Reports that people read: one self-contained HTML file of a result.

Needs matplotlib and jinja2: nobody imports this but when a report is asked for.
"""

from __future__ import annotations

from pathlib import Path

from ..calibration.comparison import Comparison
from ..disk.atomic import save_bytes
from .comparison import comparison
from .comparison_figures import trend_png
from .cross_check_report import write_cross_check_report
from .diagnosis_report import write_diagnosis_report
from .evaluation_report import write_evaluation_report
from .page import write_document
from .replay_report import write_replay_report
from .unpaired_report import write_unpaired_report

__all__ = [
    "write_comparison_report",
    "write_cross_check_report",
    "write_diagnosis_report",
    "write_evaluation_report",
    "write_replay_report",
    "write_unpaired_report",
]


def write_comparison_report(path: Path, result: Comparison) -> None:
    """Write the report (HTML), or the picture if `path` ends in .png. Raises InputError if it cannot be written."""
    if path.suffix.lower() == ".png":
        save_bytes(path, trend_png(result))
    else:
        write_document(path, comparison(result))
