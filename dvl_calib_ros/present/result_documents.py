"""Document and plain data of a result, by the result's type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from ..calibration.comparison.mounting_change import Comparison, comparison_document
from ..diagnosis.answer.results import Diagnosis, diagnosis_document
from ..evaluation.cross_check import CrossCheck, cross_check_document
from ..evaluation.documents import evaluation_document
from ..evaluation.results import Evaluation
from ..examination.examine import Examination
from ..fleet_catalogue.update import Fleet
from ..unpaired.results import UnpairedComparison, unpaired_document
from ..unpaired.simulator_rounds import ClosedGap, closed_gap_document
from .comparison import comparison, fleet
from .diagnosis import diagnosis, unpaired
from .document import Document
from .evaluation import cross_check, evaluation
from .examination import examination

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
# for JSON; the plain data of a fleet are its catalogue
PLAIN_DATA: Mapping[type, Callable[[Any], dict[str, Any]]] = {
    ClosedGap: closed_gap_document,
    Comparison: comparison_document,
    CrossCheck: cross_check_document,
    Diagnosis: diagnosis_document,
    Evaluation: evaluation_document,
    Examination: Examination.document,
    UnpairedComparison: unpaired_document,
}
