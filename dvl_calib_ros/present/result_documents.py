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

# layout, and plain data for JSON; those of a fleet are its catalogue
_RESULTS: Mapping[type, tuple[Callable[[Any], Document], Callable[[Any], dict[str, Any]] | None]] = {
    ClosedGap: (unpaired, closed_gap_document),
    Comparison: (comparison, comparison_document),
    CrossCheck: (cross_check, cross_check_document),
    Diagnosis: (diagnosis, diagnosis_document),
    Evaluation: (evaluation, evaluation_document),
    Examination: (examination, Examination.document),
    Fleet: (fleet, None),
    UnpairedComparison: (unpaired, unpaired_document),
}
DOCUMENTS = {kind: layout for kind, (layout, _) in _RESULTS.items()}
PLAIN_DATA = {kind: plain for kind, (_, plain) in _RESULTS.items() if plain is not None}
