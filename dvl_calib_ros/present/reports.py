"""Reports that people read: one self-contained HTML file of a result.

Needs matplotlib and jinja2: nobody imports this but when a report is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..calibration.comparison import Comparison
from ..diagnosis.results import Diagnosis
from ..disk.atomic import save_bytes
from ..evaluation.bags import CrossCheck
from ..evaluation.results import Evaluation
from ..examination.examine import Examination
from ..replay.replay import Replayed
from ..unpaired.results import UnpairedComparison
from .comparison import comparison
from .comparison_figures import trend_png
from .cross_check import cross_check
from .diagnosis import diagnosis
from .document import Document
from .evaluation import evaluation
from .examination import examination
from .page import write_document
from .replay import replayed
from .unpaired import unpaired

__all__ = ["write_replay_report", "write_report"]

# What a result says, by its type.
_DOCUMENTS: Mapping[type, Callable[[Any], Document]] = {
    Comparison: comparison,
    CrossCheck: cross_check,
    Diagnosis: diagnosis,
    Evaluation: evaluation,
    Examination: examination,
    UnpairedComparison: unpaired,
}


def write_report(path: Path, result: Any) -> None:
    """Write the report (HTML); of a comparison the picture alone if `path` ends in .png.

    Raises InputError if it cannot be written.
    """
    if isinstance(result, Comparison) and path.suffix.lower() == ".png":
        save_bytes(path, trend_png(result))
    else:
        write_document(path, _DOCUMENTS[type(result)](result))


def write_replay_report(path: Path, run: Replayed, bags: Sequence[Path], models: Sequence[str]) -> None:
    """Write the report of a replay that was run with a history. models: names to show. Raises InputError."""
    write_document(path, replayed(run, bags, models))
