"""Style of figures, and their embedding in a page.

Figures use only matplotlib's object interface: no pyplot, no window, and no global settings outside `drawing`.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from ..calibration.models import MODELS
from .figure_data import explorable

# inches; narrow, so that text is legible on a phone that shows the figure 340 pixels wide
WIDTH, HEIGHT = 4.6, 2.9
# resolution of the parts drawn as pixels inside the SVG: clouds of points
RASTER_DPI = 160

# Petroff's ten colours, distinguishable with any colour vision; muted ones first, for the baselines
_COLOURS = (
    "#94a4a2",
    "#b9ac70",
    "#3f90da",
    "#832db6",
    "#55b9c4",
    "#a96b59",
    "#e76300",
    "#bd1f01",
    "#ffa90e",
    "#717581",
)
INK, FAINT, UNCALIBRATED_COLOUR, REFERENCE_COLOUR = "#222222", "#b8bec4", "#555b61", "#9aa5ad"

_SETTINGS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#808890",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": "#e3e7ea",
    "grid.linewidth": 0.6,
    "xtick.color": "#808890",
    "xtick.labelcolor": INK,
    "ytick.color": "#808890",
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "figure.constrained_layout.use": True,
    "text.parse_math": False,  # names of trajectories are the user's: a dollar sign is a dollar sign
    "svg.fonttype": "path",  # looks the same everywhere, inside an <img> that cannot load fonts
    "svg.hashsalt": "dvl_calib_ros",  # the same data gives the same file
}


class LineStyle(NamedTuple):
    """Colour and dashes of one model, the same in every figure."""

    color: str
    linestyle: str


def _styles() -> dict[str, LineStyle]:
    """Return the line style of each model: a colour, and dashes by its kind of reference."""
    colours = islice(cycle(_COLOURS), len(MODELS))
    return {
        name: LineStyle(colour, "-." if model.from_positions else "-" if model.aided else "--")
        for (name, model), colour in zip(MODELS.items(), colours, strict=True)
    }


MODEL_STYLES = _styles()


@dataclass(frozen=True)
class Picture:
    """Figure on a page. title and caption: text next to it. alt: description for readers who cannot see it.

    plot: data of a figure over time for the page's script; "" for any other.
    """

    title: str
    alt: str
    svg: bytes
    caption: str = ""
    plot: str = ""

    @property
    def data_uri(self) -> str:
        """The figure as the source of an <img>, where its ids and styles cannot clash with another figure's."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg).decode()


def drawing() -> AbstractContextManager[None]:
    """Return a context in which figures are made and saved in the style of the reports."""
    return matplotlib.rc_context(_SETTINGS)


def new_figure(height: float = HEIGHT) -> tuple[Figure, Axes]:
    """Return a figure with one pair of axes; height in inches."""
    figure = Figure(figsize=(WIDTH, height))
    return figure, figure.add_subplot()


def rows_figure(
    names: Sequence[str], label: str, height: float = 1.2, per_row: float = 0.36, pad: float = 0.6, grid: bool = False
) -> tuple[Figure, Axes, NDArray[np.intp]]:
    """Return a figure with a named row for each value, from the top, and the rows' places (N,).

    label: of the values. height, per_row: inches without rows, and of each. pad: rows of space at both ends. grid:
    whether rows have lines.
    """
    figure, axes = new_figure(height + per_row * len(names))
    rows = np.arange(len(names))
    axes.set_yticks(rows, names)
    axes.set_ylim(len(names) - (1.0 - pad), -pad)
    axes.set_xlabel(label)
    axes.grid(grid, axis="y")
    return figure, axes, rows


def line_widths(models: Sequence[str], selected: str = "") -> list[float]:
    """Return line widths: the selected model's is the widest, later ones are thinner.

    Models that agree stay visible, because the thin lines are drawn on the wide ones.
    """
    return [4.0 if name == selected else 2.2 - 1.2 * i / len(models) for i, name in enumerate(models)]


def legend_above(axes: Axes, columns: int = 3, markerscale: float = 1.0) -> None:
    """Draw the legend above the axes, where it hides no data."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, columnspacing=1.2, handlelength=1.4,
        handletextpad=0.5, markerscale=markerscale,
    )  # fmt: skip


def log_scale(axes: Axes, names: str) -> None:
    """Make axes logarithmic, such as ``xy``, with plain numbers at the ticks."""
    for name in names:
        getattr(axes, f"set_{name}scale")("log")
        _plain_log_ticks(getattr(axes, f"{name}axis"))


def _plain_log_ticks(axis: Axis) -> None:
    """Format the ticks of a logarithmic axis as plain numbers."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def picture(title: str, alt: str, draw: Callable[..., Figure], *arguments: Any, caption: str = "") -> Picture:
    """Draw a figure from data and return it as SVG."""
    with drawing():
        figure = draw(*arguments)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", dpi=RASTER_DPI, metadata={"Date": None})
    return Picture(title, alt, _PATH_DATA.sub(_rounded, buffer.getvalue()), caption, explorable(figure))


# matplotlib writes paths to a millionth of a point; a hundredth is invisible and halves the size
_PATH_DATA = re.compile(rb' d="[^"]*"')
_DECIMALS = re.compile(rb"(\.\d\d)\d+")


def _rounded(path: re.Match[bytes]) -> bytes:
    return _DECIMALS.sub(rb"\1", path[0])
