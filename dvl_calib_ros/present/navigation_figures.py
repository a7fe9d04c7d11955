"""Figures of dead reckoning: the track on a map, and how far it is astray along it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ..calibration.frames import Array
from ..calibration.navigation import Navigation
from .exploring import MapTrack
from .replay_figures import AFTER, BAD
from .style import INK, WIDTH, Picture, legend_above, new_figure, picture
from .time_axis import TimeAxis

# A map is as high as it is wide at most, and never a strip, inches
HIGHEST, LOWEST = WIDTH, 2.2
_OTHERS = (AFTER, "#2a7f62", "#832db6", "#a96b59")


def navigation_pictures(
    one: Navigation, corrected: Mapping[str, Navigation], where: str = "", stamps_ns: Array | None = None
) -> Sequence[Picture]:
    """Map, if headings are known, and error along the track.

    one: whose reference and uncorrected track are drawn. corrected: by what corrected it, '' for one alone; the first
    four are drawn. stamps_ns: of figures whose cursor the map follows.
    """
    told = "; ".join(f"{name or 'corrected'} {each.after.end:.1f} m" for name, each in corrected.items())
    alt = f"over {one.distance_m:.0f} m; off at the end: as mounted {one.before.end:.1f} m; {told}"
    time = None if stamps_ns is None else TimeAxis(stamps_ns)
    figures = []
    if one.on_a_map:
        figures.append(
            picture(f"Track{where}", f"Map of the track {alt}", track_map, one, corrected, time,
                    caption="From the same start; the corrected track by estimates that had not seen the data, its "
                    "colour by how far it is off the reference.")
        )  # fmt: skip
    figures.append(picture(f"Error of position{where}", f"Error of dead reckoning {alt}", error_along, one, corrected))
    return figures


def track_map(one: Navigation, corrected: Mapping[str, Navigation], time: TimeAxis | None = None) -> Figure:
    """East and north, m, the same scale along both. time: of the figures whose cursor is followed."""
    drawn = [one.reference, one.track_before, *(each.track_after for each in corrected.values())]
    every = np.concatenate(drawn)
    east, north = np.ptp(every, axis=0)
    height = float(np.clip(0.85 * WIDTH * north / max(east, 1e-9) + 0.9, LOWEST, HIGHEST))
    figure, axes = new_figure(height=height)
    lines = axes.plot(*one.reference.T, color=INK, linewidth=2.6, alpha=0.35, label="reference")
    lines += axes.plot(*one.track_before.T, color=BAD, linewidth=1.2, label="as mounted")
    for (name, each), colour in zip(corrected.items(), _OTHERS, strict=False):
        lines += axes.plot(*each.track_after.T, color=colour, linewidth=1.2, label=name or "corrected")
    if len(corrected) == 1:
        lines[-1].set(alpha=0.0, label="_corrected")  # the bar of colours says it
        _coloured(figure, axes, one)
    if time is not None:
        for line in lines:
            axes.add_line(MapTrack(line, time.run, time(one.stamps_ns)))
    axes.plot(*one.reference[0], "o", color=INK, markersize=4.0)
    for track, colour in zip(drawn[1:], (BAD, *_OTHERS), strict=False):
        axes.plot(*track[-1], "s", color=colour, markersize=3.5)
    axes.plot(*one.reference[-1], "s", color=INK, markersize=3.5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east, m (● start, ■ end)")
    axes.set_ylabel("north, m")
    legend_above(axes)
    return figure


def _coloured(figure: Figure, axes: Axes, one: Navigation) -> None:
    """The corrected track, by its distance from the reference's."""
    off = np.linalg.norm(one.track_after - one.reference, axis=1)
    parts = np.stack([one.track_after[:-1], one.track_after[1:]], axis=1)
    track = LineCollection(list(parts), cmap="viridis", linewidths=1.6, zorder=3.0)
    track.set_array(0.5 * (off[:-1] + off[1:]))
    track.set_clim(0.0, max(float(off.max()), 1e-3))
    axes.add_collection(track)
    bar = figure.colorbar(track, ax=axes, shrink=0.6, aspect=24, pad=0.02)
    bar.outline.set_visible(False)
    bar.set_label("corrected: off by, m")


def error_along(one: Navigation, corrected: Mapping[str, Navigation]) -> Figure:
    """Distance of the dead-reckoned position from the reference's, m, along the track."""

    def off(each: Navigation, track: Array) -> Array:
        return np.asarray(np.linalg.norm(track - each.reference, axis=1))

    figure, axes = new_figure()
    axes.plot(one.distances, off(one, one.track_before), color=BAD, label="as mounted")
    for (name, each), colour in zip(corrected.items(), _OTHERS, strict=False):
        axes.plot(each.distances, off(each, each.track_after), color=colour, label=name or "corrected")
    axes.set_xlim(0.0, one.distance_m)
    axes.set_ylim(0.0, None)
    axes.set_xlabel("distance along the track, m")
    axes.set_ylabel("off the reference's track, m")
    legend_above(axes)
    return figure
