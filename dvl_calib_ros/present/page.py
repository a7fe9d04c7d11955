"""From data to a page: the template engine, tables, and the writing of the file.

Everything that comes from a bag or a folder is escaped by the engine. By its content security policy the page runs
the two scripts that stand in it, known by their hashes, and nothing else, and has no access to the network.

Reports that people read: one self-contained HTML file of a result.

Needs matplotlib and jinja2: nobody imports this but when a report is asked for.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from ..bag_replay.replay import Replayed
from ..calibration.comparison.mounting_change import Comparison
from ..disk.atomic import save_bytes, save_text
from ..version import __version__
from .comparison_figures import trend_png
from .document import Document, Section, Warned, Where
from .figure_style import MODEL_STYLES
from .replay import replayed
from .result_documents import DOCUMENTS


def breakable(text: str) -> Markup:
    """A text that may be broken within names of topics and files, but only between their parts."""
    return Markup(re.sub(r"([/_])(?=\w)", r"\1<wbr>", str(escape(text))))


def plain(value: Any) -> str:
    """A parameter as it is shown."""
    if isinstance(value, list):
        return " ".join(map(plain, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value) or "''"


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("dvl_calib_ros.present"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"breakable": breakable, "plain": plain}
    return environment


def write_document(path: Path, document: Document) -> None:
    """Write the page of a document. Raises InputError if it cannot be written."""
    sections = [each for each in document.sections if each.where is not Where.TERMINAL and each.items]
    if not any(isinstance(item, Warned) for section in sections for item in section.items):
        sections.insert(0, Section("", [Warned()]))
    environment = _environment()
    # uPlot (MIT, uplot.LICENSE) draws, explore.js gives it the data of the figures
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
    """HTML of the answer, its sentences and tables, for a notebook: what a terminal shows of a document."""
    sections = [each for each in document.sections if each.where is not Where.PAGE and each.items]
    context = {"document": document, "sections": sections}
    return _environment().get_template("fragment.html").render(context).strip()


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
