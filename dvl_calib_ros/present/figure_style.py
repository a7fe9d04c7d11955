"""Style of figures, their embedding in a page, and their data for the page's script.

Figures use only matplotlib's object interface: no pyplot, no window, and no global settings outside `drawing`.
"""

from __future__ import annotations

import base64
import io
import json
import re
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from ..calibration.models import MODELS
from ..calibration.numerics.frames import Array
from .numbers import fitting_unit

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


# line style of each model: a colour, and dashes by its kind of reference
MODEL_STYLES = {
    name: LineStyle(colour, "-." if model.from_positions else "-" if model.aided else "--")
    for (name, model), colour in zip(MODELS.items(), cycle(_COLOURS), strict=False)
}


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


def new_figure(height: float = HEIGHT, xlabel: str = "", ylabel: str = "") -> tuple[Figure, Axes]:
    """Return a figure with one pair of axes, labelled; height in inches."""
    figure = Figure(figsize=(WIDTH, height))
    return figure, figure.add_subplot(xlabel=xlabel, ylabel=ylabel)


def rows_figure(
    names: Sequence[str], label: str, height: float = 1.2, per_row: float = 0.36, pad: float = 0.6, grid: bool = False
) -> tuple[Figure, Axes, NDArray[np.intp]]:
    """Return a figure with a named row for each value, from the top, and the rows' places (N,).

    label: of the values. height, per_row: inches without rows, and of each. pad: rows of space at both ends. grid:
    whether rows have lines.
    """
    figure, axes = new_figure(height + per_row * len(names), xlabel=label)
    rows = np.arange(len(names))
    axes.set_yticks(rows, names)
    axes.set_ylim(len(names) - (1.0 - pad), -pad)
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
        axis: Axis = getattr(axes, f"{name}axis")
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


# Figures over time as data for the page's script, which draws them with a common cursor and zoom.
#
# On a map the cursor is a point on each track. The figure remains the only description: its lines, bands and limits are
# read back from matplotlib. Time axes start at zero, have a fitting unit, and omit long gaps between bags.

# points of a line or cloud: enough for a zoom of ten times, few enough to send the page from a ship
POINTS = 1500
# labels (matplotlib's free gid) of axes over time, and of the marks of omitted time
TIME_MARK, BREAK_MARK = "time", "cut out"


class MapTrack(Line2D):
    """Invisible copy of a line on a map, with a time for each point. The times are on the axis of the run's figures."""

    def __init__(self, line: Line2D, run: str, times: Array) -> None:
        """Set up. line: drawn line of P points. times: (P,)."""
        super().__init__(*line.get_data(), color=line.get_color(), alpha=0.0)
        self.run = f"{TIME_MARK} {run}"
        self.times = times


def explorable(figure: Figure) -> str:
    """Return a drawn figure over time or map with tracks as base64 of deflated JSON; "" for any other figure."""
    axes = figure.axes[0]
    tracks = [line for line in axes.get_lines() if isinstance(line, MapTrack)]
    if tracks:
        return _packed(_map(figure, axes, tracks))
    mark = axes.get_gid() or ""
    if not mark.startswith(TIME_MARK):
        return ""
    lines = [line for line in axes.get_lines() if line.get_transform() == axes.transData]
    sleeves = [each for each in axes.collections if isinstance(each, PolyCollection)]
    if not lines:
        return ""
    plot: dict[str, Any] = {
        "run": mark,
        "x_label": axes.get_xlabel(),
        "y_label": axes.get_ylabel(),
        "x_limits": _numbers(axes.get_xlim(), 9),
        "y_limits": _numbers(axes.get_ylim()),
        "log": axes.get_yscale() == "log",
        "levels": _numbers([np.ravel(line.get_ydata())[0] for line in axes.get_lines() if line not in lines]),
        "breaks": [
            _numbers(patch.get_extents().transformed(axes.transData.inverted()).intervalx, 9)
            for patch in axes.patches
            if patch.get_gid() == BREAK_MARK
        ],
        "lines": [
            {
                "name": "" if str(line.get_label()).startswith("_") else line.get_label(),
                "color": to_hex(line.get_color()),
                "width": line.get_linewidth(),
                "dashed": line.get_linestyle() == "--",
                "points": line.get_linestyle() == "None",
                "x": _numbers(_thinned(line.get_xdata()), 6),
                "y": _numbers(_thinned(line.get_ydata())),
            }
            for line in sorted(lines, key=lambda line: line.get_zorder())
        ],
        "sleeves": [_band_limits(each) for each in sleeves],
    }
    return _packed(plot)


def _packed(plot: dict[str, Any]) -> str:
    return base64.b64encode(zlib.compress(json.dumps(plot, separators=(",", ":")).encode(), 9)).decode()


def _map(figure: Figure, axes: Axes, tracks: Sequence[MapTrack]) -> dict[str, Any]:
    """Return the points of tracks in the picture, per cent from its left and upper edge."""
    tracks_in_picture = []
    for track in tracks:
        at = figure.transFigure.inverted().transform(axes.transData.transform(np.column_stack(track.get_data())))
        x, y = 100.0 * at[:, 0], 100.0 * (1.0 - at[:, 1])
        tracks_in_picture.append({"color": to_hex(track.get_color()), "x": _numbers(x), "y": _numbers(y)})
    return {"run": tracks[0].run, "times": _numbers(tracks[0].times, 9), "tracks": tracks_in_picture}


def _band_limits(area: PolyCollection) -> dict[str, Any]:
    """Return the lowest and highest value of a fill_between at each position."""
    vertices = np.asarray(area.get_paths()[0].vertices)
    red, green, blue, alpha = np.asarray(area.get_facecolor(), dtype=float)[0]
    x, group = np.unique(vertices[:, 0], return_inverse=True)
    low, high = np.full(len(x), np.inf), np.full(len(x), -np.inf)
    np.minimum.at(low, group, vertices[:, 1])
    np.maximum.at(high, group, vertices[:, 1])
    return {
        "color": to_hex((red, green, blue, alpha), keep_alpha=True),
        "x": _numbers(_thinned(x), 6),
        "low": _numbers(_thinned(low)),
        "high": _numbers(_thinned(high)),
    }


def _thinned(values: ArrayLike) -> Array:
    values = np.asarray(values, dtype=float)
    return np.asarray(values[:: max(1, -(-len(values) // POINTS))])


def _numbers(values: Iterable[float], digits: int = 4) -> list[float | None]:
    """Round numbers to `digits` significant digits; None if not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values]


# points of a line; more are not visible at this width
LINE_POINTS = 600
# a gap is omitted if it is longer than this (s) and than this share of the recorded time ...
CUT_FROM_S, CUT_SHARE = 60.0, 0.2
# ... and replaced by this share of the recorded time
LEFT_SHARE = 0.02


class TimeAxis:
    """Conversion of stamps to plot positions.

    breaks: (B, 2) start and end of omitted time, in the unit of the axis.
    label: with the unit.
    run: name for figures that share a cursor.
    """

    def __init__(self, stamps_ns: ArrayLike) -> None:
        """Set up from the stamps of the run, in order; at least one."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        self._first_ns = stamps[0]
        self._seconds = (stamps - self._first_ns) * 1e-9
        steps = np.diff(self._seconds)
        recorded = float(steps[steps <= CUT_FROM_S].sum())
        cut = (steps > CUT_FROM_S) & (steps > CUT_SHARE * recorded)
        positions = np.concatenate([[0.0], np.cumsum(np.where(cut, LEFT_SHARE * recorded, steps))])
        unit_s, unit = fitting_unit(float(positions[-1]))
        self._shown = positions / unit_s
        self.breaks = np.column_stack([self._shown[:-1][cut], self._shown[1:][cut]])
        self.run = f"{self._first_ns} .. {stamps[-1]}"
        self.label = f"time from the start, {unit}" + (" (gaps cut out)" if cut.any() else "")

    def __call__(self, stamps_ns: ArrayLike) -> Array:
        """Convert stamps (N,) ns within the run to positions on the axis (N,)."""
        seconds = (np.asarray(stamps_ns, dtype=np.int64) - self._first_ns) * 1e-9
        return np.asarray(np.interp(seconds, self._seconds, self._shown))

    def label_time(self, axes: Axes) -> None:
        """Label the axis and mark omitted time."""
        axes.set_gid(f"{TIME_MARK} {self.run}")  # figures of one run share cursor and zoom
        axes.set_xlabel(self.label)
        axes.set_xlim(self._shown[0], max(self._shown[-1], 1e-3))
        for start, end in self.breaks:
            axes.axvspan(
                start, end, facecolor="white", edgecolor="#c5cbd0", hatch="////", linewidth=0.0, zorder=3,
                gid=BREAK_MARK,
            )  # fmt: skip


def thin(n: int) -> slice:
    """Return a slice with an even step over n points that includes the last one."""
    step = max(1, -(-n // LINE_POINTS))
    return slice((n - 1) % step if n else 0, None, step)


def running_mean(t: Array, values: Array, points: int = 31) -> tuple[Array, Array]:
    """Return positions and means of `points` neighbours (fewer for short runs); nan across a gap."""
    width = max(1, min(points, len(values) // 5))
    window = np.ones(width) / width
    mean = np.convolve(values, window, "valid")
    duration = t[width - 1 :] - t[: len(t) - width + 1]
    mean[duration > 2.0 * np.median(duration)] = np.nan
    return np.convolve(t, window, "valid"), mean
