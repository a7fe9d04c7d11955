"""An evaluation as JSON and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..calibration.numerics.frames import Array
from ..errors import as_cell
from .protocol import MANOEUVRING
from .results import Coverage, EachStudy, Evaluation
from .validation_study import curves_document

CSV_COLUMNS = ("study", "set", "calibrated_on", "from_s", "to_s", "model", "seed", "avg_vrmse_mps", "published_mps")


def evaluation_document(evaluation: Evaluation) -> dict[str, Any]:
    """Return the JSON of `evaluate --json`: velocities in m/s, angles in rad; means over seeds, or per_seed."""
    e = evaluation
    names = [each.name for each in e.sets]
    return {
        "avg_vrmse": _by_name(names, e.columns, e.seed_mean),
        "mean": _by_column(e.columns, e.set_mean),
        "published": {name: dict(e.published[name]) for name in names},
        "ratio": _by_name(names, e.columns, e.ratio),
        "avg_vrmse_per_seed": {
            name: {column: values.tolist() for column, values in zip(e.columns, rows, strict=True)}
            for name, rows in zip(names, e.avg_vrmse, strict=True)
        },
        "avg_vrmse_by_time": {
            name: {_window(w): _by_column(e.columns, row) for w, row in zip(e.windows_s, rows, strict=True)}
            for name, rows in zip(names, e.seed_mean_by_time, strict=True)
        },
        "coverage": _coverage(e.coverage),
        "coverage_of_all": _coverage(e.coverage_of_all),
        "each": _single_run_document(e.each, e.columns),
        "single_heading": _single_run_document(e.single_heading, e.columns),
        "held_out": [vars(each) for each in e.held_out],
        "baselines": {
            name: {**dict(zip(names, values.tolist(), strict=True)), "mean": float(values.mean())}
            for name, values in e.baselines.items()
        },
        "convergence": curves_document(e.convergence),
        "sets": {each.name: {"calibrated_on": each.calibration_run, "window_s": each.window_s} for each in e.sets},
        "trajectories": list(e.trajectories),
        "source": e.source,
        "notes": list(e.notes),
        "failures": [vars(each) for each in e.failures],
        "seeds": list(e.seeds),
        "combinations": e.n_combinations,
        "parameters": dict(e.parameters),
        "version": e.version,
    }


def evaluation_csv(evaluation: Evaluation) -> str:
    """Return the CSV of `evaluate --csv`: one line per Avg.VRMSE of every study, set or run, window, model and seed."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    writer.writerows(map(as_cell, row) for row in _csv_rows(evaluation))
    return text.getvalue()


def _csv_rows(e: Evaluation) -> Iterator[Sequence[Any]]:
    """Yield the CSV's rows: sets, calibration times, then calibrations on each run."""
    for each, by_column, published in zip(e.sets, e.avg_vrmse, e.published_table, strict=True):
        where = ("sets", each.name, each.calibration_run, 0.0, each.window_s)
        yield from _per_seed(e, where, by_column, published)
    for each, by_window in zip(e.sets, e.avg_vrmse_by_time, strict=True):
        for window, by_column in zip(e.windows_s, by_window, strict=True):
            yield from _per_seed(e, ("time", each.name, each.calibration_run, 0.0, window), by_column)
    for name, study in (("each", e.each), ("single_heading", e.single_heading)):
        for run, by_column in zip(study.runs, study.avg_vrmse, strict=True) if study else ():
            yield from _per_seed(e, (name, "", run.trajectory, run.from_s, run.to_s), by_column)


def _per_seed(
    e: Evaluation, where: Sequence[Any], by_column: Array, published: Array | None = None
) -> Iterator[Sequence[Any]]:
    """Yield one CSV row per column and seed. by_column: (C, seeds) m/s. published: (C,) m/s."""
    for index, column in enumerate(e.columns):
        known = "" if published is None or np.isnan(published[index]) else float(published[index])
        for seed, value in zip(e.seeds, by_column[index].tolist(), strict=True):
            if np.isfinite(value):
                yield (*where, column, seed, value, known)


def _window(seconds: float | None) -> str:
    return "all" if seconds is None else f"{seconds:g}"


def _by_column(columns: Sequence[str], values: Array) -> dict[str, float]:
    return dict(zip(columns, values.tolist(), strict=True))


def _by_name(names: Sequence[str], columns: Sequence[str], values: Array) -> dict[str, dict[str, float]]:
    return {name: _by_column(columns, row) for name, row in zip(names, values, strict=True)}


def _coverage(coverage: Sequence[Coverage]) -> dict[str, Any]:
    """Return plain data of the coverage by model."""
    return {
        each.model: {
            "errors": each.n_errors,
            "normalised_rms": each.normalised_rms,
            "within_68": {"pooled": each.pooled_68, **_by_column(each.state_names, each.within_68)},
            "within_95": {"pooled": each.pooled_95, **_by_column(each.state_names, each.within_95)},
            "mean_error": _by_column(each.state_names, each.mean_error),
            "rms_error": _by_column(each.state_names, each.rms_error),
            "mean_std": _by_column(each.state_names, each.mean_std),
        }
        for each in coverage
    }


def _single_run_document(study: EachStudy | None, columns: Sequence[str]) -> dict[str, Any] | None:
    """Return plain data of the calibrations on each single run; None if they were not made."""
    if study is None:
        return None
    runs = [
        {
            **vars(run),
            "avg_vrmse": _by_column(columns, scores),
            "yaw_observed": _by_column(columns[1:], observed),
        }
        for run, scores, observed in zip(study.runs, study.seed_mean, study.yaw_observed, strict=True)
    ]
    return {
        "runs": runs,
        "median": _by_column(columns, study.median()),
        "median_manoeuvring": _by_column(columns, study.median(MANOEUVRING)),
        "coverage": _coverage(study.coverage),
    }
