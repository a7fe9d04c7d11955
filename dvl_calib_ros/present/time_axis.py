"""Time and series of a run as figures show them: from its start, in a fitting unit, without hours between two bags."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from ..calibration.numerics.frames import Array
from .figure_data import BREAK_MARK, mark_time
from .numbers import fitting_unit

# Points of a line: more cannot be seen at this width
LINE_POINTS = 600
# A gap is cut out if it is longer than this (s) and than this share of what was recorded in all ...
CUT_FROM_S, CUT_SHARE = 60.0, 0.2
# ... and this share of it is left.
LEFT_SHARE = 0.02


class TimeAxis:
    """Turns stamps into what is plotted.

    breaks: (B, 2) from and to where time was cut out, in the unit of the axis. label: with the unit. run: its name to
    figures that share a cursor.
    """

    def __init__(self, stamps_ns: ArrayLike) -> None:
        """From the stamps of the run, in order; at least one."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        self._first_ns = stamps[0]
        self._seconds = (stamps - self._first_ns) * 1e-9
        steps = np.diff(self._seconds)
        recorded = float(steps[steps <= CUT_FROM_S].sum())
        cut = (steps > CUT_FROM_S) & (steps > CUT_SHARE * recorded)
        shown = np.concatenate([[0.0], np.cumsum(np.where(cut, LEFT_SHARE * recorded, steps))])
        unit_s, unit = fitting_unit(float(shown[-1]))
        self._shown = shown / unit_s
        self.breaks = np.column_stack([self._shown[:-1][cut], self._shown[1:][cut]])
        self.run = f"{self._first_ns} .. {stamps[-1]}"
        self.label = f"time from the start, {unit}" + (" (gaps cut out)" if cut.any() else "")

    def __call__(self, stamps_ns: ArrayLike) -> Array:
        """Stamps (N,) ns within the run -> positions on the axis (N,)."""
        seconds = (np.asarray(stamps_ns, dtype=np.int64) - self._first_ns) * 1e-9
        return np.asarray(np.interp(seconds, self._seconds, self._shown))

    def dress(self, axes: Axes) -> None:
        """Label the axis and mark what was cut out."""
        mark_time(axes, self.run)
        axes.set_xlabel(self.label)
        axes.set_xlim(self._shown[0], max(self._shown[-1], 1e-3))
        for start, end in self.breaks:
            axes.axvspan(
                start, end, facecolor="white", edgecolor="#c5cbd0", hatch="////", linewidth=0.0, zorder=3,
                gid=BREAK_MARK,
            )  # fmt: skip


def thin(n: int) -> slice:
    """Every so many-th of n points, and so that the last one is among them."""
    step = max(1, -(-n // LINE_POINTS))
    return slice((n - 1) % step if n else 0, None, step)


def running_mean(t: Array, values: Array, points: int = 31) -> tuple[Array, Array]:
    """Positions and mean of so many neighbours; of fewer where there are not enough, nan across a gap."""
    width = max(1, min(points, len(values) // 5))
    window = np.ones(width) / width
    mean = np.convolve(values, window, "valid")
    duration = t[width - 1 :] - t[: len(t) - width + 1]
    mean[duration > 2.0 * np.median(duration)] = np.nan
    return np.convolve(t, window, "valid"), mean
