"""From data to a page: the template engine, tables, and the writing of the file.

Everything that comes from a bag or a folder is escaped by the engine. By its content security policy the page runs
the two scripts that stand in it, known by their hashes, and nothing else, and has no access to the network.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from .. import __version__
from ..disk.atomic import save_text
from .style import MODEL_STYLES

# Class of a cell that holds a verdict
VERDICT_KINDS = {"accept": "good", "marginal": "off", "reject": "bad"}


@dataclass(frozen=True)
class Cell:
    """Text of a table. kind: a class of the style sheet, such as good, off, far, bad.

    below: small, on a second line.
    """

    text: str
    kind: str = ""
    below: str = ""


@dataclass(frozen=True)
class Table:
    """head: names of the columns. rows: cells, each a text or a `Cell`; the first column names the row.

    marked: index of the row that stands out. notes: below the table. dense: of many columns.
    """

    head: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    title: str = ""
    marked: int | None = None
    notes: Sequence[str] = ()
    dense: bool = False


def signed(value: float, digits: int = 2) -> str:
    """A number with its sign, the minus as wide as the plus."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "−")  # + 0.0: no minus before zero


def parameter_texts(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Parameters as they are shown, by name."""
    return {name: _plain(value) for name, value in parameters.items()}


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return " ".join(_plain(each) for each in value)
    return str(value) if value != "" else "''"


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("dvl_calib_ros.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render_page(template: str, context: Mapping[str, Any]) -> str:
    """HTML of a page."""
    environment = _environment()
    # uPlot (MIT, uplot.LICENSE) draws, explore.js gives it the data of the figures
    scripts = [Markup(environment.get_template(name).render().strip()) for name in ("uplot.js", "explore.js")]
    sources = Markup(" ".join(f"'sha256-{_digest(script)}'" for script in scripts))
    return environment.get_template(template).render(
        version=__version__, styles=MODEL_STYLES, scripts=scripts, script_sources=sources, **context
    )


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


def write_page(path: Path, template: str, context: Mapping[str, Any]) -> None:
    """Write a page, whole or not at all; raises InputError if it cannot be written."""
    save_text(path, render_page(template, context))
