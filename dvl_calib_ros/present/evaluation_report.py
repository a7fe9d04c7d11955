"""The report of an evaluation: `dvl-calib evaluate --report out.html`.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.frames import Array
from ..calibration.models import MODELS
from ..evaluation.convergence import PUBLISHED_DEG, PUBLISHED_S, TIMES_S
from ..evaluation.protocol import MANOEUVRING
from ..evaluation.results import UNCALIBRATED, Coverage, EachStudy, ErrorsInVariables, Evaluation, HeldOut, Trace
from . import evaluation_figures as figures
from .document import Cell, Table, parameter_texts, signed
from .page import VERDICT_KINDS, write_page
from .replay_figures import held_out_errors
from .style import Picture, picture

BODY_AXES = ("ahead", "to port", "up")
# Deviation from a published figure up to which a cell is coloured so
DEVIATIONS = ((0.05, "good"), (0.25, "off"), (0.5, "far"), (math.inf, "bad"))
# Points of a trace that are drawn
TRACE_POINTS = 400


def write_evaluation_report(path: Path, evaluation: Evaluation) -> None:
    """Write the report of an evaluation. Raises InputError if the file cannot be written."""
    write_page(path, "evaluation.html", _context(evaluation))


def _context(e: Evaluation) -> dict[str, Any]:
    return {
        "title": "Evaluation of the DVL calibration models",
        "subtitle": e.source,
        "written": datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "summary": list(_summary(e)),
        "numbers": list(_numbers(e)),
        "facts": _facts(e),
        "notes": e.notes,
        "models": e.models,
        "scores": _score_table(e),
        "improvement": [_improvement(e)],
        "times": list(_calibration_times(e)),
        "has_published": bool(np.isfinite(_published(e)).any()),
        "convergence": _convergence(e),
        "baselines": _baselines(e) if e.baselines else None,
        "coverages": list(_coverages(e)),
        "errors_in_variables": None if e.errors_in_variables is None else _pull(e.errors_in_variables),
        "studies": [study for study in (_study(e, e.each, _EACH), _study(e, e.single_heading, _SINGLE)) if study],
        "traces": [_trace(trace) for trace in e.traces],
        "held_out": _held_out(e.held_out) if e.held_out else None,
        "parameters": parameter_texts(e.parameters),
    }


def _published(e: Evaluation) -> Array:
    """(S, C) published Avg.VRMSE, nan where there is none: nowhere, if the trajectories are others."""
    return np.full_like(e.published_table, np.nan) if e.own_generator else e.published_table


# ------------------------------------------------------------------ summary


def _best(values: Array, columns: Sequence[str], aided: bool) -> tuple[str, float] | None:
    """Name and value of the best model with or without GNSS among the columns."""
    found = [
        (name, float(value))
        for name, value in zip(columns, values, strict=True)
        if name in MODELS and MODELS[name].aided == aided and math.isfinite(value)
    ]
    return min(found, key=lambda pair: pair[1]) if found else None


_KINDS = ((True, "with GNSS"), (False, "without GNSS"))


def _summary(e: Evaluation) -> Iterable[str]:
    """What was found, in sentences."""
    uncalibrated = e.set_mean[e.columns.index(UNCALIBRATED)]
    for aided, words in _KINDS:
        best = _best(e.set_mean, e.columns, aided)
        if best is None:
            continue
        name, value = best
        gain = 100.0 * (1.0 - value / uncalibrated)
        sentence = f"Best {words}: {name} with {value:.4f} m/s, {gain:.0f} % less than uncalibrated"
        published = _best(_published(e).mean(axis=0), e.columns, aided)
        if published is not None:
            sentence += f"; best published: {published[0]} with {published[1]:.4f} m/s"
        yield sentence + "."
    if e.each is not None and e.each.runs:
        medians = ((words, _best(e.each.median(), e.columns, aided)) for aided, words in _KINDS)
        found = ", ".join(f"{best[0]} {best[1]:.4f} m/s {words}" for words, best in medians if best is not None)
        yield f"Calibrated on each of {len(e.each.runs)} runs with attitude, best medians: {found}."
    if e.own_generator:
        yield "The trajectories are simulated: the published figures do not apply to them."
    else:
        ratio = (e.seed_mean / _published(e))[np.isfinite(_published(e))]
        if len(ratio):
            near = int((np.abs(ratio - 1.0) <= 0.25).sum())
            yield f"{near} of {len(ratio)} published cells are met within 25 %."


def _numbers(e: Evaluation) -> Iterable[dict[str, str]]:
    where = "mean over the sets" if len(e.sets) > 1 else f"set {e.sets[0].name}"
    value = e.set_mean[e.columns.index(UNCALIBRATED)]
    yield {"name": "Uncalibrated", "value": f"{value:.4f} m/s", "note": f"Avg.VRMSE, {where}"}
    for aided, words in _KINDS:
        best = _best(e.set_mean, e.columns, aided)
        if best is not None:
            yield {"name": f"Best {words}", "value": f"{best[1]:.4f} m/s", "note": best[0]}


def _facts(e: Evaluation) -> list[tuple[str, str]]:
    p = e.parameters
    sets = "; ".join(
        f"{each.name}: {each.calibration_run}, " + ("all" if each.window_s is None else f"first {each.window_s:g} s")
        for each in e.sets
    )
    return [
        ("Trajectories", f"{len(e.trajectories)}: {', '.join(e.trajectories)}"),
        ("Calibrated on", sets),
        ("Errors", f"{e.n_combinations} combinations of misalignment and scale, noise seeds {_listed(e.seeds)}"),
        (
            "Prior, all models",
            f"{math.degrees(p['initial_std_misalignment']):.3g}°, {100 * p['initial_std_scale']:.3g} % (1σ)",
        ),
        ("R, per axis", f"{p['gnss_aided_std']:g} m/s with GNSS, {p['gnss_free_std']:g} m/s without"),
        ("Prior sway and heave", str(p["prior_source"])),
    ]


def _listed(seeds: Sequence[int]) -> str:
    return ", ".join(map(str, seeds)) if len(seeds) <= 10 else f"{seeds[0]} to {seeds[-1]} ({len(seeds)})"


# ------------------------------------------------------------------ scores


def _deviation_kind(ratio: float) -> str:
    return next(kind for limit, kind in DEVIATIONS if abs(ratio - 1.0) <= limit)


def _score(value: float, published: float) -> str | Cell:
    if not math.isfinite(value):
        return "–"
    if not math.isfinite(published):
        return f"{value:.4f}"
    ratio = value / published
    return Cell(f"{value:.4f}", _deviation_kind(ratio), f"{published:.4f} ×{ratio:.2f}")


def _score_table(e: Evaluation) -> Table:
    """Avg.VRMSE, a line per model and a column per set, with the published figure and the ratio to it below."""
    rows = []
    for name, here, published in zip(e.columns, e.seed_mean.T, _published(e).T, strict=True):
        means = _score(float(here.mean()), float(published.mean()))
        rows.append((name, *(_score(*pair) for pair in zip(here.tolist(), published.tolist(), strict=True)), means))
    notes = [
        "Avg.VRMSE in m/s: root mean square of the velocity error, mean over trajectories, combinations and seeds."
    ]
    if np.isfinite(_published(e)).any():
        notes.append(
            "Below each: the published figure and the ratio to it; green within 5 %, yellow 25 %, orange 50 %, red "
            "beyond. Means are those of the cells beside them, not the paper's."
        )
    return Table(("model", *(each.name for each in e.sets), "mean"), rows, notes=notes)


def _improvement(e: Evaluation) -> Picture:
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    gone = 1.0 - e.seed_mean[:, models] / e.seed_mean[:, [base]]
    published = 1.0 - _published(e)[:, models] / _published(e)[:, [base]]
    alt = ", ".join(f"{name} {100 * value:.0f} %" for name, value in zip(e.models, gone.mean(axis=0), strict=True))
    return picture(
        "Improvement over uncalibrated", f"Mean over the sets: {alt}",
        figures.improvement_bars, e.models, gone, published,
    )  # fmt: skip


def _calibration_times(e: Evaluation) -> Iterable[Picture]:
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    by_time = e.seed_mean_by_time
    for i, each in enumerate(e.sets):
        yield picture(
            f"{each.name}: calibrated on {each.calibration_run}",
            f"Avg.VRMSE against calibration time for set {each.name}, all models",
            figures.error_over_calibration_time, e.models, e.windows_s, float(e.seed_mean[i, base]),
            by_time[i][:, models], each.window_s, _published(e)[i, models],
        )  # fmt: skip


def _convergence(e: Evaluation) -> list[Picture]:
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


def _baselines(e: Evaluation) -> Table:
    rows = [
        (name, *(f"{value:.4f}" for value in values), f"{values.mean():.4f}") for name, values in e.baselines.items()
    ]
    return Table(
        ("Avg.VRMSE, m/s", *(each.name for each in e.sets), "mean"),
        rows,
        notes=(
            "The rotation alone by least squares on SO(3): of displacements (Kinsey and Whitcomb, 2007; here of the "
            "integrated reference velocity, whose noise grows with time, where they had positions), and of velocities "
            "(Troni and Whitcomb, 2010). They have neither scale nor prior.",
        ),
    )


# ------------------------------------------------------------------ uncertainty


def _coverages(e: Evaluation) -> Iterable[dict[str, Any]]:
    studies = (
        ("Calibrated on the sets and on each run with attitude", e.coverage_of_all),
        ("Calibrated on the sets", e.coverage),
        ("Calibrated on each run with attitude", e.each.coverage if e.each else ()),
        ("Calibrated on stretches of a single heading", e.single_heading.coverage if e.single_heading else ()),
    )
    for title, coverages in studies:
        if coverages:
            yield {"title": title, "table": _coverage_table(coverages), "pictures": [_coverage_picture(coverages)]}


def _coverage_table(coverages: Sequence[Coverage]) -> Table:
    states = list(dict.fromkeys(name for coverage in coverages for name in coverage.state_names))
    rows: list[tuple[str | Cell, ...]] = []
    for coverage in coverages:
        shares = {
            name: f"{100 * low:.0f} / {100 * high:.0f}"
            for name, low, high in zip(coverage.state_names, coverage.within_68, coverage.within_95, strict=True)
        }
        pooled = [
            Cell(f"{100 * share:.1f}", "good" if low <= share <= high else "far")
            for share, (_, (low, high)) in zip((coverage.pooled_68, coverage.pooled_95), figures.CLAIMED, strict=True)
        ]
        rows.append((coverage.model, *pooled, *(shares.get(name, "–") for name in states), str(coverage.n_errors)))
    named = [_state_in_words(name) for name in states]
    return Table(
        ("model", "68 % interval", "95 % interval", *named, "errors each"),
        rows,
        notes=(
            "Per cent of the errors (estimate minus truth) inside the interval that σ claims, over all states and for "
            "each (68 / 95); green within 60–76 and 91–98 %. Below: σ is too small.",
        ),
    )


def _state_in_words(name: str) -> str:
    """phi_x -> φx, delta_k_x -> δk x."""
    for prefix, symbol in (("phi_", "φ"), ("delta_k", "δk")):
        if name.startswith(prefix):
            return symbol + name[len(prefix) :].replace("_", " ")
    return name


def _coverage_picture(coverages: Sequence[Coverage]) -> Picture:
    models = [coverage.model for coverage in coverages]
    within = {0.68: [c.pooled_68 for c in coverages], 0.95: [c.pooled_95 for c in coverages]}
    alt = ", ".join(f"{c.model} {100 * c.pooled_68:.0f} and {100 * c.pooled_95:.0f} %" for c in coverages)
    return picture("Errors inside the claimed intervals", alt, figures.coverage_points, models, within)


def _pull(study: ErrorsInVariables) -> dict[str, Any]:
    rows = [
        (
            f"{std:g}",
            *(
                f"{signed(100 * study.predicted[i, j])} / {signed(100 * study.measured[i, j])}"
                for i in range(len(study.models))
            ),
        )
        for j, std in enumerate(study.gnss_std)
    ]
    return {
        "models": study.models,
        "formula": study.formula,
        "table": Table(("GNSS σ, m/s", *study.models), rows, notes=("Pull of the scale in %: predicted / measured.",)),
        "pictures": [
            picture(
                "Errors in variables", "Pull of the scale by noise in the reference, predicted and measured",
                figures.errors_in_variables, study.models, study.gnss_std, study.predicted, study.measured,
                study.standard_error, caption="Lines: predicted by the formula. Points: measured, ± 2 standard errors.",
            )
        ],
    }  # fmt: skip


# ------------------------------------------------------------------ runs


_EACH = "Calibrated on each run with attitude"
_SINGLE = "Calibrated on stretches of a single heading"


def _study(e: Evaluation, study: EachStudy | None, title: str) -> dict[str, Any] | None:
    if study is None or not study.runs:
        return None
    errors = study.seed_mean  # (L, C)
    runs = [f"{run.trajectory} {run.from_s:.0f}–{run.to_s:.0f} s" for run in study.runs]
    rows = []
    for run, label, values, observed in zip(
        study.runs, runs, errors.tolist(), study.yaw_observed.tolist(), strict=True
    ):
        seen = dict(zip(e.models, observed, strict=True))
        cells = [
            "–" if not math.isfinite(value) else f"{value:.4f}" + (" ?" if seen.get(name, 1.0) < 0.5 else "")
            for name, value in zip(e.columns, values, strict=True)
        ]
        rows.append((label, f"{math.degrees(run.heading_spread):.0f}", *cells))
    median = study.median()
    rows.append(_median_row("median", median))
    manoeuvring = study.median(MANOEUVRING)
    if np.isfinite(manoeuvring).any():
        rows.append(_median_row(f"of {MANOEUVRING[0]} .. {MANOEUVRING[-1]}", manoeuvring))
    alt = ", ".join(f"{name} {value:.4f}" for name, value in zip(e.columns, median.tolist(), strict=True))
    base = e.columns.index(UNCALIBRATED)
    models = [e.columns.index(name) for name in e.models]
    return {
        "title": title,
        "table": Table(
            ("run", "headings, °", *e.columns),
            rows,
            marked=len(study.runs),
            dense=True,
            notes=(
                "Avg.VRMSE on all other trajectories, m/s. Headings: their circular standard deviation. ? marks where "
                "the model mostly says that it has not seen yaw; – where it cannot run.",
            ),
        ),
        "pictures": [
            picture(
                "Avg.VRMSE by calibration run", f"Avg.VRMSE, median over the runs, m/s: {alt}",
                figures.error_by_run, runs, e.models, errors[:, base], errors[:, models],
                caption="Bars: uncalibrated. Filled: models with GNSS. Hollow: without.",
            )
        ],
    }  # fmt: skip


def _median_row(name: str, medians: Array) -> tuple[str, ...]:
    return (name, "", *("–" if not math.isfinite(value) else f"{value:.4f}" for value in medians.tolist()))


def _trace(trace: Trace) -> dict[str, Any]:
    """Velocity of one trajectory before and after the correction by the model that does best on it."""
    step = max(1, len(trace.time) // TRACE_POINTS)
    time_s, truth, uncorrected = trace.time[::step], trace.truth[::step], trace.uncorrected[::step]
    corrected = {name: velocity[::step] for name, velocity in trace.corrected.items()}
    errors = {name: np.linalg.norm(velocity - truth, axis=1) for name, velocity in corrected.items()}
    best = min(errors, key=lambda name: float(np.mean(errors[name] ** 2)))
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
    return {
        "title": f"{trace.trajectory}, calibrated on {trace.calibrated_on}",
        "note": f"Errors put in: {trace.combination}. Corrected by {best}, the best on it.",
        "models": list(corrected),
        "pictures": pictures,
    }


def _held_out(held_out: Sequence[HeldOut]) -> dict[str, Any]:
    sets = list(dict.fromkeys(each.set_name for each in held_out))
    models = list(dict.fromkeys(each.model for each in held_out))
    found = {(each.model, each.set_name): each for each in held_out}
    rows = [(model, *(_held_out_cell(found.get((model, name))) for name in sets)) for model in models]
    notes = ("Velocity error on held-out data, m/s rms; below: uncorrected → predicted, and the verdict.",)
    pictures = [_held_out_picture(name, [each for each in held_out if each.set_name == name]) for name in sets]
    return {"table": Table(("model", *sets), rows, notes=notes), "pictures": pictures}


def _held_out_cell(each: HeldOut | None) -> str | Cell:
    if each is None:
        return "–"
    below = f"{each.uncorrected:.4f} → {each.predicted:.4f}, {each.verdict}"
    return Cell(f"{each.corrected:.4f}", VERDICT_KINDS[each.verdict], below)


def _held_out_picture(name: str, held_out: Sequence[HeldOut]) -> Picture:
    errors = [
        np.array([getattr(each, kind) for each in held_out]) for kind in ("uncorrected", "corrected", "predicted")
    ]
    alt = "Verdicts: " + ", ".join(f"{each.model} {each.verdict}" for each in held_out)
    models = [each.model for each in held_out]
    return picture(f"{name}: error on held-out data", alt, held_out_errors, models, *errors)
