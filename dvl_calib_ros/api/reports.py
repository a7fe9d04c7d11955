"""Results as pages and as JSON files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..calibration.comparison.mounting_change import Comparison
from ..diagnosis.answer.results import Diagnosis
from ..disk.text_files import write_json
from ..errors import InputError
from ..examination.examine import Examination
from .calibrated import Calibration


def write(result: object, path: Path) -> None:
    """Write a result as JSON if the path ends in .json, else as a page. Raises InputError."""
    document = _plain(result)
    if path.suffix.lower() == ".json":
        write_json(path, document())
        return
    if isinstance(result, Calibration):
        result.report(path)
        return
    try:
        from ..present import page
    except ModuleNotFoundError as error:
        raise InputError(
            f"{path}: a page needs matplotlib and jinja2 ({error}); pip install matplotlib jinja2"
        ) from error
    page.write_report(path, result)


def _plain(result: Any) -> Callable[[], Any]:
    """Return the function that makes plain data of a result. Raises InputError for other objects."""
    if isinstance(result, Calibration):
        return result.document
    if isinstance(result, Examination):
        return result.document
    if isinstance(result, Comparison):
        from ..calibration.comparison.mounting_change_reasons import comparison_document

        return lambda: comparison_document(result)
    if isinstance(result, Diagnosis):
        from ..diagnosis.answer.results import diagnosis_document

        return lambda: diagnosis_document(result)
    from ..evaluation.cross_check import CrossCheck, cross_check_document
    from ..evaluation.documents import evaluation_document
    from ..evaluation.results import Evaluation
    from ..unpaired.results import UnpairedComparison, unpaired_document
    from ..unpaired.simulator_rounds import ClosedGap, closed_gap_document

    if isinstance(result, Evaluation):
        return lambda: evaluation_document(result)
    if isinstance(result, CrossCheck):
        return lambda: cross_check_document(result)
    if isinstance(result, UnpairedComparison):
        return lambda: unpaired_document(result)
    if isinstance(result, ClosedGap):
        return lambda: closed_gap_document(result)
    raise InputError(
        f"a {type(result).__name__} is no result; give what replay, compare, doctor, diagnose or evaluate gave"
    )
