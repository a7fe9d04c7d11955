"""From data to a page: the template engine, tables, and the writing of the file.

Everything that comes from a bag or a folder is escaped by the engine. By its content security policy the page runs
the two scripts that stand in it, known by their hashes, and nothing else, and has no access to the network.
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

from .. import __version__
from ..disk.atomic import save_text
from .document import Document, Section, Warned, Where
from .style import MODEL_STYLES


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
