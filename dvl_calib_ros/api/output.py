"""Results as text, as HTML for a notebook, and as data frames."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from ..errors import InputError
from ..present.document import Document

if TYPE_CHECKING:
    import pandas

# Width of printed output in columns, equal to the commands' output into a pipe.
WIDTH = 160


def printed(result: object, as_html: bool) -> str:
    """Format a result with its tables, as text or HTML."""
    from ..present.result_documents import DOCUMENTS

    return text_of(DOCUMENTS[type(result)](result), as_html)


def framed(result: object) -> dict[str, pandas.DataFrame]:
    """Return the tables of a result by their headings. Raises InputError without pandas."""
    from ..present.result_documents import DOCUMENTS

    return frames_of(DOCUMENTS[type(result)](result))


def frames_of(document: Document) -> dict[str, pandas.DataFrame]:
    """Return the tables of a document by their headings. Raises InputError without pandas."""
    try:
        return document.frames()
    except ModuleNotFoundError:
        raise InputError("tables need the Python package pandas; pip install pandas") from None


def text_of(document: Document, as_html: bool) -> str:
    """Render a document as on a terminal, as text or as HTML."""
    if as_html:
        from ..present.page import fragment

        return fragment(document)
    from rich.console import Console

    from ..present.terminal import shown

    # force_jupyter: rich would otherwise also display the text by itself in a notebook
    console = Console(file=io.StringIO(), record=True, width=WIDTH, force_jupyter=False, highlight=False, emoji=False)
    for each in shown(document):
        console.print(each)
    return "\n".join(line.rstrip() for line in console.export_text().splitlines())
