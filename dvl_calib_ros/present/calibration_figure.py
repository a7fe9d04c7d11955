"""A calibration in one picture: the mounting as it settles, and the velocity error before and after."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..bag_replay.replay import Replayed
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.error_model import corrected_mounting
from ..calibration.numerics.frames import Array, rpy_from_rotation
from ..calibration.results.mounting_quantities import quantities
from ..calibration.results.results import rpy_std

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
    """Above, roll, pitch and yaw over time with ±1σ, less those configured; below, the velocity error of samples.

    replayed: with a history. Degrees; m/s, corrected by estimates that had not seen the data, with all that was found.
    """
    result, history, navigation = replayed.result, replayed.history, replayed.navigation
    if history is None:
        raise ValueError("a replay without history has nothing to draw")
    parameters = Parameters.from_mapping(result.parameters)
    rotation = parameters.rotation_dvl_from_body
    first_ns = result.first_ns or 0
    model = history.models[result.selected]
    figure = NotebookFigure(figsize=(8.0, 5.6), layout="constrained")
    angles, errors = figure.subplots(2, 1, sharex=True)
    time = 1e-9 * (history.stamps_ns - first_ns)
    phi = model.state[:, :3]
    turned = np.degrees([rpy_from_rotation(corrected_mounting(each, rotation)) for each in phi])
    turned -= np.degrees(parameters.mounting_rpy)
    turned = (turned + 180.0) % 360.0 - 180.0
    std = np.degrees([rpy_std(*each, parameters) for each in zip(phi, model.misalignment_covariance, strict=True)])
    settled = slice(int(_SETTLING * len(time)), None)
    for axis, found in enumerate(quantities(result)[:3]):  # whose σ is also of the next recording
        value, sleeve = turned[:, axis], std[:, axis]
        label = f"{found.name} {value[-1]:+.2f}° ± {found.in_unit(found.std)}"
        angles.fill_between(time, value - sleeve, value + sleeve, color=_COLOURS[axis], alpha=0.15, linewidth=0)
        angles.plot(time, value, color=_COLOURS[axis], label=label)
    span = turned[settled]
    margin = 0.2 * float(np.ptp(span)) + 0.1
    angles.set_ylim(float(span.min()) - margin, float(span.max()) + margin)
    angles.set_ylabel("correction of the mounting, °")
    _legend_above(angles)
    if navigation is not None:
        for each, name, colour in (
            (navigation.error_before, "before", _COLOURS[2]),
            (navigation.error_after, "after", _COLOURS[0]),
        ):
            _errors(errors, 1e-9 * (navigation.stamps_ns - first_ns), each, name, colour)
        _legend_above(errors)
    errors.set_ylabel("DVL less reference, m/s")
    errors.set_xlabel("time, s")
    for axes in (angles, errors):
        axes.grid(True, alpha=0.3)
    return figure


def _errors(axes: Axes, time: Array, error: Array, name: str, colour: str) -> None:
    """Points of the length of an error (N, 3), with its root mean square."""
    length = np.linalg.norm(error, axis=1)
    rms = float(np.sqrt(np.mean(length**2)))
    axes.plot(time, length, ".", markersize=3, color=colour, alpha=0.6, label=f"{name}: {rms:.3f} m/s rms")


def _legend_above(axes: Axes) -> None:
    """One line above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small", frameon=False)
