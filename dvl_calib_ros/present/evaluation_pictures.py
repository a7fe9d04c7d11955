"""Pictures of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..calibration.models import MODELS
from ..evaluation.convergence import PUBLISHED_DEG, PUBLISHED_S, TIMES_S
from ..evaluation.results import UNCALIBRATED, Coverage, EachStudy, ErrorsInVariables, Evaluation, HeldOut, Trace
from . import evaluation_figures as figures
from .replay_figures import held_out_errors
from .style import Picture, picture

BODY_AXES = ("ahead", "to port", "up")
# Points of a trace that are drawn
TRACE_POINTS = 400


def improvement_picture(e: Evaluation) -> Picture:
    """How much of the error is gone, by model."""
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    gone = 1.0 - e.seed_mean[:, models] / e.seed_mean[:, [base]]
    published = 1.0 - e.published_of_these[:, models] / e.published_of_these[:, [base]]
    alt = ", ".join(f"{name} {100 * value:.0f} %" for name, value in zip(e.models, gone.mean(axis=0), strict=True))
    return picture(
        "Improvement over uncalibrated", f"Mean over the sets: {alt}",
        figures.improvement_bars, e.models, gone, published,
    )  # fmt: skip


def time_pictures(e: Evaluation) -> Iterable[Picture]:
    """Error against calibration time, by set."""
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    by_time = e.seed_mean_by_time
    for i, each in enumerate(e.sets):
        yield picture(
            f"{each.name}: calibrated on {each.calibration_run}",
            f"Avg.VRMSE against calibration time for set {each.name}, all models",
            figures.error_over_calibration_time, e.models, e.windows_s, float(e.seed_mean[i, base]),
            by_time[i][:, models], each.window_s, e.published_of_these[i, models],
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


def coverage_picture(coverages: Sequence[Coverage]) -> Picture:
    """Errors inside the intervals that σ claims."""
    models = [coverage.model for coverage in coverages]
    within = {0.68: [c.pooled_68 for c in coverages], 0.95: [c.pooled_95 for c in coverages]}
    alt = ", ".join(f"{c.model} {100 * c.pooled_68:.0f} and {100 * c.pooled_95:.0f} %" for c in coverages)
    return picture("Errors inside the claimed intervals", alt, figures.coverage_points, models, within)


def study_picture(e: Evaluation, study: EachStudy) -> Picture:
    """Errors by the run that was calibrated on."""
    errors, median = study.seed_mean, study.median()
    alt = ", ".join(f"{name} {value:.4f}" for name, value in zip(e.columns, median.tolist(), strict=True))
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    return picture(
        "Avg.VRMSE by calibration run", f"Avg.VRMSE, median over the runs, m/s: {alt}",
        figures.error_by_run, study.run_names, e.models, errors[:, base], errors[:, models],
        caption="Bars: uncalibrated. Filled: models with GNSS. Hollow: without.",
    )  # fmt: skip


def pull_picture(study: ErrorsInVariables) -> Picture:
    """Pull of the scale by noise in the reference."""
    return picture(
        "Errors in variables", "Pull of the scale by noise in the reference, predicted and measured",
        figures.errors_in_variables, study.models, study.gnss_std, study.predicted, study.measured,
        study.standard_error, caption="Lines: predicted by the formula. Points: measured, ± 2 standard errors.",
    )  # fmt: skip


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


def held_out_picture(name: str, held_out: Sequence[HeldOut]) -> Picture:
    """Errors on held-out data, of one set."""
    errors = [
        np.array([getattr(each, kind) for each in held_out]) for kind in ("uncorrected", "corrected", "predicted")
    ]
    alt = "Verdicts: " + ", ".join(f"{each.model} {each.verdict}" for each in held_out)
    models = [each.model for each in held_out]
    return picture(f"{name}: error on held-out data", alt, held_out_errors, models, *errors)
