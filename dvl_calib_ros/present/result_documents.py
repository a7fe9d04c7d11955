"""Document of a result, by the result's type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..calibration.comparison.mounting_change import Comparison
from ..diagnosis.answer.results import Diagnosis
from ..evaluation.cross_check import CrossCheck
from ..evaluation.results import Evaluation
from ..examination.examine import Examination
from ..fleet_catalogue.update import Fleet
from ..unpaired.results import UnpairedComparison
from ..unpaired.simulator_rounds import ClosedGap
from .comparison import comparison
from .diagnosis import diagnosis
from .document import Document
from .evaluation import cross_check, evaluation
from .examination import examination
from .fleet import fleet
from .unpaired import unpaired

DOCUMENTS: Mapping[type, Callable[[Any], Document]] = {
    ClosedGap: unpaired,
    Comparison: comparison,
    CrossCheck: cross_check,
    Diagnosis: diagnosis,
    Evaluation: evaluation,
    Examination: examination,
    Fleet: fleet,
    UnpairedComparison: unpaired,
}
