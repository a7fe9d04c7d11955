"""Pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..calibration.models import MODELS
from ..evaluation.convergence import PUBLISHED_DEG, PUBLISHED_S, TIMES_S
from ..evaluation.results import UNCALIBRATED, Evaluation, Trace
from . import evaluation_figures as figures
from .style import Picture, picture

BODY_AXES = ("ahead", "to port", "up")
# Points of a trace that are drawn
TRACE_POINTS = 400


def time_pictures(e: Evaluation) -> Iterable[Picture]:
    """Error against calibration time, by set."""
    base = e.columns.index(UNCALIBRATED)
    for i, each in enumerate(e.sets):
        yield picture(
            f"{each.name}: calibrated on {each.calibration_run}",
            f"Avg.VRMSE against calibration time for set {each.name}, all models",
            figures.error_over_calibration_time, e.models, e.windows_s, float(e.seed_mean[i, base]),
            e.of_models(e.seed_mean_by_time[i]), each.window_s, e.of_models(e.published_of_these[i]),
        )  # fmt: skip


def convergence_pictures(e: Evaluation) -> list[Picture]:
    """Error of the misalignment against time."""
    shown = [each for each in e.convergence if each.name in MODELS]
    if not shown:
        return []
    made = []
    for title, values in (
        ("Pitch and yaw", [each.level_deg for each in shown]), ("The whole angle", [each.angle_deg for each in shown]),
    ):  # fmt: skip
        told = "; ".join(f"{each.label}: {value[-1]:.2f}°" for each, value in zip(shown, values, strict=True))
        made.append(
            picture(
                f"{title}, error against time",
                f"{title} against time; after {TIMES_S[-1]:g} s {told}",
                figures.misalignment_over_time,
                TIMES_S,
                [each.name for each in shown],
                [each.gnss_std for each in shown],
                values,
                (PUBLISHED_S, PUBLISHED_DEG),
                caption="rms over runs, combinations of errors and seeds. Star: published for a network.",
            )
        )
    return made


def trace_pictures(trace: Trace) -> list[Picture]:
    """Velocity of one trajectory before and after the correction by the model that does best on it."""
    step = max(1, len(trace.time) // TRACE_POINTS)
    time_s, truth, uncorrected = trace.time[::step], trace.truth[::step], trace.uncorrected[::step]
    corrected = {name: velocity[::step] for name, velocity in trace.corrected.items()}
    errors = {name: np.linalg.norm(velocity - truth, axis=1) for name, velocity in corrected.items()}
    best = trace.best
    pictures = [
        picture(
            f"Velocity {where}", f"Velocity {where} of {trace.trajectory}: truth, DVL, and corrected by {best}, m/s",
            figures.velocity_of_trace, time_s, truth[:, axis], uncorrected[:, axis], corrected[best][:, axis],
            f"velocity {where}, m/s",
        )
        for axis, where in enumerate(BODY_AXES)
    ]  # fmt: skip
    pictures.append(
        picture(
            "Velocity error, all models", "Length of the velocity error before and after correction, m/s",
            figures.error_of_trace, time_s, np.linalg.norm(uncorrected - truth, axis=1), errors,
            caption="Running root mean square. Dotted: uncorrected.",
        )
    )  # fmt: skip
    return pictures
