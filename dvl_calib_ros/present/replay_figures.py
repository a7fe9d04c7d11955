"""Figures of a replay: functions from plain arrays to a matplotlib Figure, units on every axis.

They show estimates over time, the DVL's axes on the vehicle, dead reckoning on a map, and a summary in one picture.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import EngFormatter, MaxNLocator

from ..bag_replay.replay import ModelHistory, Replayed, RunHistory
from ..calibration.assessment.dead_reckoning import Navigation
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array, rotation_from_rpy, rotation_of, turn_between
from ..calibration.results.mounting_quantities import quantities
from ..calibration.results.results import Result, corrected_rpy, rpy_std
from .figure_style import (
    FAINT,
    INK,
    MODEL_STYLES,
    REFERENCE_COLOUR,
    WIDTH,
    MapTrack,
    Picture,
    TimeAxis,
    legend_above,
    line_widths,
    log_scale,
    new_figure,
    picture,
    rows_figure,
    running_mean,
    thin,
)
from .replay import Term, state_of, terms_of

GOOD, WARNING, BAD, AFTER = "#2a7f62", "#e0a030", "#c0392b", "#1f6fb2"


class ModelLine(NamedTuple):
    """One error term of one model over time: value and std (N,), in the unit of the axis."""

    model: str
    value: Array
    std: Array


def estimate_over_time(
    time: TimeAxis, stamps_ns: Array, lines: Sequence[ModelLine], selected: str, label: str
) -> Figure:
    """Draw one error term with the ±1σ bands of several models; the selected one is highlighted."""
    figure, axes = new_figure(ylabel=label)
    kept = thin(len(stamps_ns))
    t = time(stamps_ns)[kept]
    for line, width in zip(lines, line_widths([line.model for line in lines], selected), strict=True):
        colour, dashes = MODEL_STYLES[line.model]
        value, std = line.value[kept], line.std[kept]
        strong = line.model == selected
        axes.fill_between(t, value - std, value + std, color=colour, alpha=0.25 if strong else 0.12, linewidth=0)
        dashes = "-" if strong else dashes
        axes.plot(t, value, color=colour, linestyle=dashes, linewidth=width, zorder=2.0 - 0.1 * width, label=line.model)
    axes.set_ylim(*_settled_range(lines))
    time.label_time(axes)
    return figure


def _settled_range(lines: Sequence[ModelLine]) -> tuple[float, float]:
    """Return limits for every estimate after the first tenth, and its final σ, without the prior's width."""
    settled = [line.value[len(line.value) // 10 :] for line in lines]
    low = min(min(value.min(), line.value[-1] - line.std[-1]) for value, line in zip(settled, lines, strict=True))
    high = max(max(value.max(), line.value[-1] + line.std[-1]) for value, line in zip(settled, lines, strict=True))
    margin = 0.15 * (high - low) or 1.0
    return float(low - margin), float(high + margin)


def velocity_over_time(
    time: TimeAxis, dvl_ns: Array, before: Array, after: Array, reference_ns: Array, reference: Array, label: str
) -> Figure:
    """Draw one body axis of the velocity: DVL before (N,) and after correction (N,), and the reference (M,), m/s."""
    figure, axes = new_figure(ylabel=label)
    kept = thin(len(reference_ns))
    if len(reference_ns):
        axes.plot(
            time(reference_ns)[kept], reference[kept], ".", markersize=2.0, color=REFERENCE_COLOUR, label="GNSS",
            rasterized=True,
        )  # fmt: skip
    kept = thin(len(dvl_ns))
    t = time(dvl_ns)[kept]
    axes.plot(t, before[kept], color=BAD, linewidth=1.0, label="DVL as measured")
    axes.plot(t, after[kept], color=AFTER, linewidth=1.0, label="DVL corrected")
    time.label_time(axes)
    legend_above(axes, markerscale=3.0)
    return figure


def residual_over_time(time: TimeAxis, stamps_ns: Array, before: Array, after: Array, label: str) -> Figure:
    """Draw DVL minus reference (N,) along one body axis, before and after correction, m/s: points and running mean."""
    figure, axes = new_figure(ylabel=label)
    t = time(stamps_ns)
    for residual, colour, name in ((before, BAD, "before"), (after, AFTER, "after")):
        rms = float(np.sqrt(np.mean(residual**2)))
        axes.plot(t, residual, ".", markersize=2.0, alpha=0.35, color=colour, rasterized=True)
        axes.plot(*running_mean(t, residual), color=colour, label=f"{name}: RMS {rms:.3f} m/s")
    axes.axhline(0.0, color=INK, linewidth=0.7)
    spread = 1.2 * float(np.quantile(np.abs(np.concatenate([before, after])), 0.995))
    axes.set_ylim(-spread or -0.01, spread or 0.01)
    time.label_time(axes)
    legend_above(axes)
    return figure


def selection_over_time(
    time: TimeAxis, segments: Sequence[tuple[str, int, int]], stamps_ns: Array, paired_share: Array
) -> Figure:
    """Draw the selected model, (name, from, to) in ns, and the share of samples (N,) with a reference."""
    names = list(dict.fromkeys(name for name, _, _ in segments))
    figure, axes = new_figure(height=1.0 + 0.36 * (len(names) + 1))
    for name, start, end in segments:
        begin, end_shown = time([start, end])
        axes.barh(names.index(name) + 1, end_shown - begin, left=begin, height=0.62, color=MODEL_STYLES[name].color)
    edges = time(stamps_ns)
    if len(edges) > 1:
        share = _filled_from_next(paired_share[1:])[None]
        axes.pcolormesh(edges, [-0.31, 0.31], share, cmap="Greys", vmin=-0.05, vmax=1.6, rasterized=True)
    axes.set_yticks(range(len(names) + 1), ["GNSS", *names])
    axes.set_ylim(len(names) + 0.6, -0.6)
    axes.grid(False, axis="y")
    time.label_time(axes)
    return figure


def _filled_from_next(values: Array) -> Array:
    """Replace every nan in (N,) by the next number: a slow receiver decides several samples together."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return np.zeros_like(values)
    following = np.searchsorted(known, np.arange(len(values)))
    return np.asarray(values[known[np.minimum(following, len(known) - 1)]])


def innovations_over_time(time: TimeAxis, stamps_ns: Array, nis: Mapping[str, Array], selected: str) -> Figure:
    """Draw the mean normalised innovation squared per measurement row (N,) of several models; 1 is expected."""
    figure, axes = new_figure(ylabel="NIS per measured component")
    t = time(stamps_ns)
    for (name, values), width in zip(nis.items(), line_widths(list(nis), selected), strict=True):
        used = np.isfinite(values) & (values > 0.0)
        if not used.any():
            continue
        colour, dashes = MODEL_STYLES[name]
        where, mean = running_mean(t[used], np.log10(values[used]), points=9)
        axes.plot(
            where, 10.0**mean, color=colour, linestyle=dashes, linewidth=width, zorder=2.0 - 0.1 * width, label=name
        )
    axes.axhline(1.0, color=INK, linewidth=0.8)
    log_scale(axes, "y")
    time.label_time(axes)
    return figure


def samples_by_fate(models: Sequence[str], counts: Mapping[str, Sequence[int]]) -> Figure:
    """Draw bars of the DVL samples that each model used, gated, or was not given, by reason."""
    colours = (GOOD, BAD, WARNING, FAINT, "#8d99a6", "#d8dde1")
    figure, axes = new_figure(height=1.1 + 0.28 * len(models), xlabel="DVL samples")
    bar_start = np.zeros(len(models))
    for (reason, values), colour in zip(counts.items(), colours, strict=False):
        axes.barh(models, values, left=bar_start, color=colour, height=0.7, label=reason)
        bar_start += np.asarray(values, dtype=float)
    axes.invert_yaxis()
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(False, axis="y")
    legend_above(axes, columns=4)
    return figure


def held_out_errors(labels: Sequence[str], uncorrected: Array, corrected: Array, predicted: Array) -> Figure:
    """Draw velocity errors on held-out data (N,), m/s rms. Points, because each includes the reference's noise."""
    label = "velocity error on held-out data, m/s rms"
    figure, axes, rows = rows_figure(labels, label, per_row=0.27, pad=0.5, grid=True)
    axes.hlines(rows, corrected, uncorrected, color=FAINT, linewidth=1.6)
    axes.plot(uncorrected, rows, "|", color=BAD, markersize=11.0, markeredgewidth=2.2, label="uncorrected")
    axes.plot(corrected, rows, "o", color=AFTER, markersize=6.0, label="corrected")
    axes.plot(
        predicted, rows, "D", color=INK, markersize=5.0, markerfacecolor="none", markeredgewidth=1.1, label="predicted"
    )
    legend_above(axes)
    return figure


# a smaller rotation is enlarged to this (rad), by an integer factor up to this limit: 1° is not visible
_SEEN, _MOST_TIMES = math.radians(12.0), 20
# length of the drawn vehicle, m; drawn axes as a share of it; its height divided by its length
_LENGTH, _AXIS, _SLENDER = 2.0, 0.25, 0.3
# two axes of the body, and the viewpoint on the third
_VIEWS = ((0, 1, "from above"), (0, 2, "from starboard"))


def mounting_pictures(result: Result) -> list[Picture]:
    """Draw the DVL from above and from the side, at its position if known."""
    parameters = Parameters.from_mapping(result.parameters)
    nominal = rotation_from_rpy(parameters.mounting_rpy)
    found = result.estimate.rotation_body_from_dvl(nominal.T)
    turn = turn_between(nominal, found)
    angle = float(np.linalg.norm(turn))
    times = int(np.clip(round(_SEEN / max(angle, 1e-9)), 1, _MOST_TIMES))
    place = result.position_in_body
    how = f"The turn of {math.degrees(angle):.2f}° is drawn {times} times as large." if times > 1 else "True to scale."
    if place is None:
        how += " The position of the DVL is unknown: drawn in the middle."
    return [
        picture(
            f"DVL on the vehicle, {where}", f"Axes of the DVL as configured and as found, {where}. {how}",
            _hull, (across, up, parameters.body_axes[up]), nominal, rotation_of(times * turn) @ nominal,
            place or (0.0, 0.0, 0.0), parameters.is_z_down, caption=how,
        )
        for across, up, where in _VIEWS
    ]  # fmt: skip


def _hull(axes_of: tuple[int, int, str], nominal: Array, found: Array, place: Sequence[float], down: bool) -> Figure:
    """Draw the DVL's axes on the hull in one view, as configured and as found."""
    across, up, name = axes_of
    figure, axes = new_figure(height=2.6, xlabel="ahead, m", ylabel=f"{name}, m")
    length = max(_LENGTH, 2.4 * float(np.abs(place).max()))
    axes.add_patch(Ellipse((0.0, 0.0), length, _SLENDER * length, facecolor="#f1f3f5", edgecolor=FAINT))
    axes.annotate(
        "", (0.62 * length, 0.0), (0.5 * length, 0.0), arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.5}
    )
    axes.text(0.64 * length, 0.0, "ahead", va="center", fontsize=8.0, color=INK)
    for rotation, colour, label in ((nominal, FAINT, "as configured"), (found, AFTER, "as found")):
        _axes_of_dvl(axes, rotation[[across, up]], (place[across], place[up]), _AXIS * length, colour, label)
    axes.update_datalim([(-0.6 * length, 0.0), (0.85 * length, 0.0)])
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    if down:  # port stays on the left, the surface on top
        axes.invert_yaxis()
    legend_above(axes)
    return figure


def _axes_of_dvl(axes: Axes, ends: Array, at: tuple[float, float], length: float, colour: str, label: str) -> None:
    """Draw the DVL's axes, ends (2, 3) in this view; one that points at the viewer is omitted."""
    for index, axis in enumerate("xyz"):
        arrow = length * ends[:, index]
        if float(np.hypot(*arrow)) < 0.3 * length:
            continue
        tip = at[0] + arrow[0], at[1] + arrow[1]
        axes.annotate("", tip, at, arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.8})
        if colour == AFTER:
            axes.text(at[0] + 1.15 * arrow[0], at[1] + 1.15 * arrow[1], axis, color=colour, ha="center", va="center")
            axes.update_datalim([(at[0] + 1.3 * arrow[0], at[1] + 1.3 * arrow[1])])  # keeps letters off the title
    axes.plot([], [], color=colour, label=label)
    axes.plot(*at, "o", color=colour, markersize=4.0)


# a map is at most as high as wide, and never a strip, inches
HIGHEST, LOWEST = WIDTH, 2.2
_OTHERS = (AFTER, "#2a7f62", "#832db6", "#a96b59")


def navigation_pictures(
    one: Navigation, corrected: Mapping[str, Navigation], where: str = "", stamps_ns: Array | None = None
) -> Sequence[Picture]:
    """Draw a map, if headings are known, and the error along the track.

    one: its reference and uncorrected track are drawn.
    corrected: tracks by their correction ('' for a single one); the first four are drawn.
    stamps_ns: of figures whose cursor the map follows.
    """
    ends = "; ".join(f"{name or 'corrected'} {each.after.end:.1f} m" for name, each in corrected.items())
    alt = f"over {one.distance_m:.0f} m; error at the end: as mounted {one.before.end:.1f} m; {ends}"
    time = None if stamps_ns is None else TimeAxis(stamps_ns)
    figures = []
    if one.on_a_map:
        figures.append(
            picture(f"Track{where}", f"Map of the track {alt}", track_map, one, corrected, time,
                    caption="From the same start; the corrected track by estimates without this data, its "
                    "colour by its distance from the reference.")
        )  # fmt: skip
    figures.append(picture(f"Error of position{where}", f"Error of dead reckoning {alt}", error_along, one, corrected))
    return figures


def track_map(one: Navigation, corrected: Mapping[str, Navigation], time: TimeAxis | None = None) -> Figure:
    """Draw east and north, m, with equal scales. time: of the figures whose cursor is followed."""
    drawn = [one.reference, one.track_before, *(each.track_after for each in corrected.values())]
    every = np.concatenate(drawn)
    east, north = np.ptp(every, axis=0)
    height = float(np.clip(0.85 * WIDTH * north / max(east, 1e-9) + 0.9, LOWEST, HIGHEST))
    figure, axes = new_figure(height=height, xlabel="east, m (● start, ■ end)", ylabel="north, m")
    lines = axes.plot(*one.reference.T, color=INK, linewidth=2.6, alpha=0.35, label="reference")
    lines += axes.plot(*one.track_before.T, color=BAD, linewidth=1.2, label="as mounted")
    for (name, each), colour in zip(corrected.items(), _OTHERS, strict=False):
        lines += axes.plot(*each.track_after.T, color=colour, linewidth=1.2, label=name or "corrected")
    if len(corrected) == 1:
        lines[-1].set(alpha=0.0, label="_corrected")  # the colour bar is the legend
        _draw_coloured_track(figure, axes, one)
    if time is not None:
        for line in lines:
            axes.add_line(MapTrack(line, time.run, time(one.stamps_ns)))
    axes.plot(*one.reference[0], "o", color=INK, markersize=4.0)
    for track, colour in zip(drawn[1:], (BAD, *_OTHERS), strict=False):
        axes.plot(*track[-1], "s", color=colour, markersize=3.5)
    axes.plot(*one.reference[-1], "s", color=INK, markersize=3.5)
    axes.set_aspect("equal", adjustable="datalim")
    legend_above(axes)
    return figure


def _draw_coloured_track(figure: Figure, axes: Axes, one: Navigation) -> None:
    """Draw the corrected track, coloured by its distance from the reference's."""
    distance = np.linalg.norm(one.track_after - one.reference, axis=1)
    parts = np.stack([one.track_after[:-1], one.track_after[1:]], axis=1)
    track = LineCollection(list(parts), cmap="viridis", linewidths=1.6, zorder=3.0)
    track.set_array(0.5 * (distance[:-1] + distance[1:]))
    track.set_clim(0.0, max(float(distance.max()), 1e-3))
    axes.add_collection(track)
    bar = figure.colorbar(track, ax=axes, shrink=0.6, aspect=24, pad=0.02)
    bar.outline.set_visible(False)
    bar.set_label("corrected: error, m")


def error_along(one: Navigation, corrected: Mapping[str, Navigation]) -> Figure:
    """Draw the distance of the dead-reckoned position from the reference's, m, along the track."""

    def off(each: Navigation, track: Array) -> Array:
        return np.asarray(np.linalg.norm(track - each.reference, axis=1))

    figure, axes = new_figure(xlabel="distance along the track, m", ylabel="off the reference's track, m")
    axes.plot(one.distances, off(one, one.track_before), color=BAD, label="as mounted")
    for (name, each), colour in zip(corrected.items(), _OTHERS, strict=False):
        axes.plot(each.distances, off(each, each.track_after), color=colour, label=name or "corrected")
    axes.set_xlim(0.0, one.distance_m)
    axes.set_ylim(0.0, None)
    legend_above(axes)
    return figure


_COLOURS = ("#1f6fb2", "#2a7f62", "#c0392b")
# share of the run at its beginning that does not set the limits, because the prior is wide
_SETTLING = 0.1


class NotebookFigure(Figure):
    """Figure that a notebook displays without pyplot."""

    def _repr_png_(self) -> bytes:
        target = io.BytesIO()
        self.savefig(target, format="png")
        return target.getvalue()


def calibration_figure(replayed: Replayed) -> Figure:
    """Draw roll, pitch and yaw minus the configured ones over time with ±1σ; below, the velocity error of samples.

    replayed: with a history. Degrees; m/s, corrected by estimates without this data, with everything found.
    """
    result, history, navigation = replayed.result, replayed.history, replayed.navigation
    if history is None:
        raise ValueError("a replay without history has nothing to draw")
    parameters = Parameters.from_mapping(result.parameters)
    first_ns = result.first_ns or 0
    model = history.models[result.selected]
    figure = NotebookFigure(figsize=(8.0, 5.6), layout="constrained")
    angles, errors = figure.subplots(2, 1, sharex=True)
    time = 1e-9 * (history.stamps_ns - first_ns)
    phi = model.state[:, :3]
    change = np.degrees([corrected_rpy(each, parameters) for each in phi]) - np.degrees(parameters.mounting_rpy)
    std = np.degrees([rpy_std(*each, parameters) for each in zip(phi, model.misalignment_covariance, strict=True)])
    settled = slice(int(_SETTLING * len(time)), None)
    for axis, found in enumerate(quantities(result)[:3]):  # σ includes the change to the next recording
        value, sleeve = change[:, axis], std[:, axis]
        label = f"{found.name} {value[-1]:+.2f}° ± {found.in_unit(found.std)}"
        angles.fill_between(time, value - sleeve, value + sleeve, color=_COLOURS[axis], alpha=0.15, linewidth=0)
        angles.plot(time, value, color=_COLOURS[axis], label=label)
    span = change[settled]
    margin = 0.2 * float(np.ptp(span)) + 0.1
    angles.set_ylim(float(span.min()) - margin, float(span.max()) + margin)
    angles.set_ylabel("correction of the mounting, °")
    _legend_above(angles)
    if navigation is not None:
        for each, name, colour in (
            (navigation.error_before, "before", _COLOURS[2]),
            (navigation.error_after, "after", _COLOURS[0]),
        ):
            length = np.linalg.norm(each, axis=1)  # as points
            label = f"{name}: {float(np.sqrt(np.mean(length**2))):.3f} m/s rms"
            seconds = 1e-9 * (navigation.stamps_ns - first_ns)
            errors.plot(seconds, length, ".", markersize=3, color=colour, alpha=0.6, label=label)
        _legend_above(errors)
    errors.set(xlabel="time, s", ylabel="DVL less reference, m/s")
    for axes in (angles, errors):
        axes.grid(True, alpha=0.3)
    return figure


def _legend_above(axes: Axes) -> None:
    """Draw the legend in one line above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small", frameon=False)


# Pictures of a replay: estimates over time, velocities, use of the samples.

# use of DVL samples, by model
FATES: Mapping[str, Callable[[Result, str], int]] = {
    "used": lambda result, name: result.estimates[name].used,
    "gated": lambda result, name: result.estimates[name].gated,
    "not given": lambda result, name: max(
        0, result.counts["dvl"]["usable"] - result.estimates[name].used - result.estimates[name].gated
    ),
    "slow or turning": lambda result, _: sum(
        result.counts["dvl"][fate] for fate in ("slow", "turning", "no_turn_rate")
    ),
}


def estimate_pictures(result: Result, history: RunHistory, models: Sequence[str]) -> Iterable[Picture]:
    """Draw the estimates of some models over time, and their innovations."""
    time = TimeAxis(history.stamps_ns)
    for term in terms_of(models):
        lines = [
            _model_line(name, history.models[name], term)
            for name in models
            if MODELS[name].error_terms_from_state[term.row].any()
        ]
        if lines:
            final = ", ".join(f"{line.model} {line.value[-1]:+.2f} ± {line.std[-1]:.2f}" for line in lines)
            yield picture(
                f"{term.in_words} ± 1σ", f"{term.name} over time; at the end, in {term.unit.strip()}: {final}",
                estimate_over_time, time, history.stamps_ns, lines, result.selected,
                f"{term.name}, {term.unit.strip()}",
            )  # fmt: skip
    nis = {name: history.models[name].nis for name in models}
    yield picture(
        "Innovations (NIS)", "Mean normalised innovation squared over time; 1 is expected",
        innovations_over_time, time, history.stamps_ns, nis, result.selected,
        caption="Running mean. The model expects 1 (line): above it the σ is too small, below too large.",
    )  # fmt: skip


def _model_line(name: str, history: ModelHistory, term: Term) -> ModelLine:
    index = state_of(MODELS[name], term)
    return ModelLine(name, term.factor * history.state[:, index], term.factor * history.std[:, index])


def velocity_pictures(replayed: Replayed, history: RunHistory) -> list[Picture]:
    """Draw velocity and, with a reference, residual, per body axis."""
    time = TimeAxis(history.stamps_ns)
    parameters = Parameters.from_mapping(replayed.result.parameters)
    t = parameters.rotation_dvl_from_body
    correction = replayed.result.estimate
    before, after = history.dvl_velocity @ t, correction.corrected_velocity(history.dvl_velocity, t)
    pictures = [
        picture(
            f"Velocity {where}", f"DVL velocity {where} before and after correction, and the reference, m/s",
            velocity_over_time, time, history.dvl_ns, before[:, axis], after[:, axis], history.paired_ns,
            history.reference_velocity[:, axis], f"velocity {where}, m/s",
        )
        for axis, where in enumerate(parameters.body_axes)
    ]  # fmt: skip
    navigation = replayed.navigation
    if navigation is not None:
        pictures += [
            picture(
                f"Residual {where}", f"DVL minus GNSS {where}, before and after correction, m/s",
                residual_over_time, time, navigation.stamps_ns, -navigation.error_before[:, axis],
                -navigation.error_after[:, axis], f"DVL − GNSS {where}, m/s",
            )
            for axis, where in enumerate(parameters.body_axes)
        ]  # fmt: skip
    return pictures


def data_pictures(result: Result, history: RunHistory, models: Sequence[str]) -> list[Picture]:
    """Draw the use of the samples, and the selected model over time."""
    time = TimeAxis(history.stamps_ns)
    fates = {fate: [count(result, name) for name in models] for fate, count in FATES.items()}
    ends = [*(segment.from_ns for segment in result.segments[1:]), result.last_ns]
    segments = [(each.model, each.from_ns, end) for each, end in zip(result.segments, ends, strict=False)]
    switches = ", ".join(dict.fromkeys(name for name, _, _ in segments)) or "none"
    return [
        picture(
            "Samples by model", "How many DVL samples each model used, gated or was not given",
            samples_by_fate, list(models), fates,
            caption="Not given: samples without a GNSS velocity or attitude, or in the window of the prior.",
        ),
        picture(
            "Selected model and GNSS", f"Which model was selected over time: {switches}; and when GNSS was there",
            selection_over_time, time, segments, history.stamps_ns, history.paired_share,
            caption="GNSS: dark where DVL samples had a GNSS velocity at their time.",
        ),
    ]  # fmt: skip
