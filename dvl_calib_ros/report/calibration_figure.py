"""A calibration in one picture: the mounting as it settles, and the velocity error before and after."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..calibration.error_model import correct
from ..calibration.frames import Array
from ..calibration.models import MODELS
from ..calibration.parameters import Parameters
from ..replay.recorder import RunHistory
from ..replay.replay import Replayed

_COLOURS = ("#1f6fb2", "#2a7f62", "#c0392b")
# Share of the run at its beginning that does not set the limits: the prior's width would
_SETTLING = 0.1


class NotebookFigure(Figure):
    """A figure that a notebook shows by itself, without pyplot and its state."""

    def _repr_png_(self) -> bytes:
        target = io.BytesIO()
        self.savefig(target, format="png")
        return target.getvalue()


def calibration_figure(replayed: Replayed) -> Figure:
    """Above, roll, pitch and yaw of the correction over time with ±1σ; below, the velocity error of each sample.

    replayed: with a history. Angles about the body's axes, degrees; errors in m/s.
    """
    result, history = replayed.result, replayed.history
    if history is None:
        raise ValueError("a replay without history has nothing to draw")
    parameters = Parameters.from_mapping(result.parameters)
    rotation = parameters.rotation_dvl_from_body
    first_ns = result.first_ns or 0
    model = history.models[result.selected]
    figure = NotebookFigure(figsize=(8.0, 5.6), layout="constrained")
    angles, errors = figure.subplots(2, 1, sharex=True)
    time = 1e-9 * (history.stamps_ns - first_ns)
    # φ turns the measured velocity in the DVL's frame: about the body's axes it is the mounting's turn, reversed
    turned = np.degrees(-model.state[:, :3] @ rotation)
    std = np.degrees(np.sqrt((model.std[:, :3] ** 2) @ rotation**2))
    settled = slice(int(_SETTLING * len(time)), None)
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        value, sleeve = turned[:, axis], std[:, axis]
        angles.fill_between(time, value - sleeve, value + sleeve, color=_COLOURS[axis], alpha=0.15, linewidth=0)
        angles.plot(time, value, color=_COLOURS[axis], label=f"{name} {value[-1]:+.2f}° ± {sleeve[-1]:.2f}°")
    span = turned[settled]
    margin = 0.2 * float(np.ptp(span)) + 0.1
    angles.set_ylim(float(span.min()) - margin, float(span.max()) + margin)
    angles.set_ylabel("correction of the mounting, °")
    _legend_above(angles)
    if len(history.paired_ns):
        terms = MODELS[result.selected].error_terms_from_state @ result.estimate.state
        corrected = correct(history.paired_velocity, terms[:3], terms[3:], rotation)
        _errors(errors, history, history.paired_velocity @ rotation, "before", _COLOURS[2], first_ns)
        _errors(errors, history, corrected, "after", _COLOURS[0], first_ns)
        _legend_above(errors)
    errors.set_ylabel("DVL less reference, m/s")
    errors.set_xlabel("time, s")
    for axes in (angles, errors):
        axes.grid(True, alpha=0.3)
    return figure


def _errors(axes: Axes, history: RunHistory, velocity: Array, name: str, colour: str, first_ns: int) -> None:
    """Points of the error's length, with its root mean square."""
    error = np.linalg.norm(velocity - history.reference_velocity, axis=1)
    rms = float(np.sqrt(np.mean(error**2)))
    time = 1e-9 * (history.paired_ns - first_ns)
    axes.plot(time, error, ".", markersize=3, color=colour, alpha=0.6, label=f"{name}: {rms:.3f} m/s rms")


def _legend_above(axes: Axes) -> None:
    """One line above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small", frameon=False)
