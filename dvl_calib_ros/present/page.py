"""HTML pages: the template engine, tables, and writing of a self-contained report.

Texts from bags and folders are escaped by the engine. The page's content security policy allows only its two embedded
scripts, by their hashes, and no network access. Needs matplotlib and jinja2, so it is imported only for a report.
"""

from __future__ import annotations

import base64
import hashlib
import re
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from ..calibration.comparison.mounting_change import Comparison
from ..disk.atomic import save_bytes, save_text
from ..files.output_paths import check_report_name
from ..version import __version__
from .comparison_figures import trend_png
from .document import Document, Section, Warned, Where
from .figure_style import MODEL_STYLES
from .result_documents import DOCUMENTS


def breakable(text: str) -> Markup:
    """Allow line breaks in a text, within topic and file names only between their parts."""
    return Markup(re.sub(r"([/_])(?=\w)", r"\1<wbr>", str(escape(text))))


def whole(text: str) -> Markup:
    """Return a number with its unit in HTML, unbroken and with minus signs."""
    return Markup(str(escape(text)).replace("-", "−").replace(" ", "&nbsp;"))


def plain(value: Any) -> str:
    """Format a parameter."""
    if isinstance(value, list):
        return " ".join(map(plain, value))
    return f"{round(value, 12) + 0.0:.6g}" if isinstance(value, float) else str(value) or "''"


@cache
def _environment() -> jinja2.Environment:
    """Return the template engine with the filters of the pages."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dvl_calib_ros.present"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"breakable": breakable, "plain": plain, "whole": whole}
    return environment


def write_document(path: Path, document: Document) -> None:
    """Write the page of a document. Raises InputError if it cannot be written."""
    sections = [each for each in document.sections if each.where is not Where.TERMINAL and each.items]
    if not any(isinstance(item, Warned) for section in sections for item in section.items):
        sections.insert(0, Section("", [Warned()]))
    environment = _environment()
    # uPlot (MIT, uplot.LICENSE) draws, explore.js passes the figures' data to it
    scripts = [Markup(environment.get_template(name).render().strip()) for name in ("uplot.js", "explore.js")]
    digests = (base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts)
    page = environment.get_template("document.html").render(
        document=document,
        sections=sections,
        written=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC"),
        version=__version__,
        styles=MODEL_STYLES,
        scripts=scripts,
        script_sources=Markup(" ".join(f"'sha256-{digest}'" for digest in digests)),
    )
    save_text(path, page)


def fragment(document: Document) -> str:
    """Return HTML of the answer, sentences and tables for a notebook, as on a terminal."""
    sections = [each for each in document.sections if each.where is not Where.PAGE and each.items]
    context = {"document": document, "sections": sections}
    return _environment().get_template("fragment.html").render(context).strip()


def write_report(path: Path, result: Any) -> None:
    """Write the report (HTML); for a comparison and a path ending in .png only the picture.

    result: also its document. Raises InputError if it cannot be written.
    """
    if isinstance(result, Comparison) and path.suffix.lower() == ".png":
        save_bytes(path, trend_png(result))
    else:
        check_report_name(path)
        write_document(path, result if isinstance(result, Document) else DOCUMENTS[type(result)](result))
