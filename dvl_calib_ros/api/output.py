"""Results as text, as HTML of a notebook, and as data frames: what the commands print of them.

Results as pages and as JSON, by what they are.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.comparison.mounting_change import Comparison
from ..diagnosis.answer.results import Diagnosis
from ..disk.text_files import write_json
from ..errors import InputError
from ..examination.examine import Examination
from ..present.document import Document
from .calibrated import Calibration

if TYPE_CHECKING:
    import pandas

# Columns of what is printed, as of the commands into a pipe
WIDTH = 160


def printed(result: object, as_html: bool) -> str:
    """The answer of a result, with its tables."""
    from ..present.result_documents import DOCUMENTS

    return text_of(DOCUMENTS[type(result)](result), as_html)


def framed(result: object) -> dict[str, pandas.DataFrame]:
    """Tables of a result by their headings. Raises InputError without pandas."""
    from ..present.result_documents import DOCUMENTS

    return frames_of(DOCUMENTS[type(result)](result))


def frames_of(document: Document) -> dict[str, pandas.DataFrame]:
    """Tables of a document by their headings. Raises InputError without pandas."""
    try:
        return document.frames()
    except ModuleNotFoundError:
        raise InputError("tables need the Python package pandas; pip install pandas") from None


def text_of(document: Document, as_html: bool) -> str:
    """A document as it would be on a terminal, as text or as HTML."""
    if as_html:
        from ..present.page import fragment

        return fragment(document)
    from rich.console import Console

    from ..present.terminal import shown

    # in a notebook rich would show it by itself, beside what is returned
    console = Console(file=io.StringIO(), record=True, width=WIDTH, force_jupyter=False, highlight=False, emoji=False)
    for each in shown(document):
        console.print(each)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())


def write(result: object, path: Path) -> None:
    """Write a result as JSON where the path ends so, else as a page. Raises InputError."""
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
    """What makes plain data of a result. Raises InputError for what is none."""
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
