"""The published validation procedure: calibrate on one run, correct all others, and compare with the published table.

FOLDER holds trajectories T01_dvl.csv .. T15_dvl.csv (time s; surge, sway, heave m/s, forward-right-down), and where
there is attitude T01_attitude.csv .. (time s, the same stamps; roll, pitch, yaw rad in north-east-down). They are
public: T01-T13 in github.com/ansfl/A-KIT, T14 and T15 in github.com/ansfl/BeamsNet. Without a folder the procedure
runs on simulated trajectories of the same lengths.

With several recorded bags instead, each is calibrated on, and every other one that has GNSS is corrected with it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import common
from .reporting import add_report_option, report_writer
from .tables import cell, titled

if TYPE_CHECKING:
    from rich.table import Table

    from ..evaluation.results import Coverage, EachStudy, ErrorsInVariables, Evaluation
    from ..parallel import Workers

MAX_SEEDS = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("paths", nargs="*", type=Path, metavar="FOLDER | BAG", help="trajectories, or two bags or more")
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="noise seeds 0 .. N - 1; default: %(default)s"
    )
    parser.add_argument("--sets", default="all", help="such as E1,E2; default: all")
    parser.add_argument("--models", default="all", help="such as M3,M7; default: all")
    parser.add_argument("--partial", action="store_true", help="go on although trajectories are missing in the folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything that was found as JSON")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every Avg.VRMSE as CSV, one per line")
    add_report_option(parser)
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes; default: one per core")
    parser.add_argument("--dask", default="", metavar="ADDRESS", help="scheduler to work on, such as tcp://host:8786")
    common.add_parameter_options(parser)
    common.add_topic_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Evaluate, print, save."""
    from ..calibration.models import MODELS
    from ..disk.atomic import save_text
    from ..errors import InputError
    from ..evaluation.documents import evaluation_csv, evaluation_document
    from ..evaluation.evaluate import DEFAULTS, EVALUATED, evaluate
    from ..evaluation.protocol import SETS
    from ..parallel import Workers

    are_bags = _are_bags(arguments.paths)
    models = common.chosen("--models", arguments.models, tuple(MODELS) if are_bags else EVALUATED)
    sets = common.chosen("--sets", arguments.sets, [each.name for each in SETS])
    if not 1 <= arguments.seeds <= MAX_SEEDS:
        raise InputError(f"--seeds: {arguments.seeds} is outside 1 .. {MAX_SEEDS}")
    if arguments.jobs < 0:
        raise InputError(f"--jobs: {arguments.jobs} is negative; give a number of processes, or 0 for one per core")
    common.check_outputs(arguments, "json", "csv", "report")
    workers = Workers(arguments.jobs, arguments.dask)
    if are_bags:
        _cross_check(arguments, models, workers)
        return
    parameters = common.load(arguments, DEFAULTS)
    write_report = report_writer(arguments)
    with common.progress("evaluating") as on_progress:
        evaluation = evaluate(
            arguments.paths[0] if arguments.paths else None,
            parameters,
            models=models,
            sets=sets,
            n_seeds=arguments.seeds,
            partial_folder=arguments.partial,
            workers=workers,
            on_progress=on_progress,
        )
    common.deliver(
        lambda: _print(evaluation),
        (arguments.json, lambda path: common.write_json(path, evaluation_document(evaluation))),
        (arguments.csv, lambda path: save_text(path, evaluation_csv(evaluation))),
        (arguments.report, lambda path: write_report(path, evaluation)),
    )


def _are_bags(paths: list[Path]) -> bool:
    """Whether bags were named, not a folder of trajectories."""
    from ..errors import InputError

    if not paths:
        return False
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder; give a folder of trajectories, or bags")
    if len(paths) == 1 and paths[0].is_dir() and not (paths[0] / "metadata.yaml").exists():
        return False
    if len(paths) == 1:
        raise InputError(f"{paths[0]}: one bag cannot be checked against another; name two at least, or use replay")
    return True


# ------------------------------------------------------------------ tables


def _print(e: Evaluation) -> None:
    from rich.markup import escape

    out = common.console()
    out.print(
        f"{escape(e.source)}: {len(e.trajectories)} trajectories, {e.n_combinations} combinations of errors, "
        f"{len(e.seeds)} noise seed{'s' if len(e.seeds) > 1 else ''}"
    )
    for note in e.notes:
        out.print(f"[yellow]note:[/] {escape(note)}")
    out.print(_score_table(e))
    out.print(escape(_settings(e)))
    if e.baselines:
        out.print(_baseline_table(e))
    out.print(_held_out_table(e))
    out.print(_time_table(e))
    if e.convergence:
        out.print(_convergence_table(e))
    for study, title in (
        (e.each, "Avg.VRMSE m/s, calibrated on each run with attitude"),
        (e.single_heading, "Avg.VRMSE m/s, calibrated on stretches of a single heading"),
    ):
        if study is not None:
            out.print(_each_table(e, study, title))
    out.print(_coverage_table(e.coverage, "Coverage over the sets: share of errors within the σ claimed"))
    if e.each is not None:
        out.print(_coverage_table(e.each.coverage, "Coverage over the runs with attitude"))
        out.print(_coverage_table(e.coverage_of_all, "Coverage over all of these"))
    if e.errors_in_variables is not None:
        out.print(_noise_table(e.errors_in_variables))


def _score_table(e: Evaluation) -> Table:
    table = titled("Avg.VRMSE m/s", ["set"], e.columns)
    for each, scores, ratios in zip(e.sets, e.seed_mean, e.ratio, strict=True):
        window = "all" if each.window_s is None else f"{each.window_s:g} s"
        table.add_row(f"{each.name} ({each.calibration_run}, {window})", *map(cell, scores))
        if not e.own_generator:
            table.add_row("  × published", *(f"[dim]{cell(ratio, 2)}[/]" if ratio == ratio else "" for ratio in ratios))
    table.add_section()
    table.add_row("mean", *map(cell, e.set_mean))
    if not e.own_generator:
        table.add_row("published mean", *map(cell, e.published_table.mean(axis=0)))
    return table


def _baseline_table(e: Evaluation) -> Table:
    caption = "rotation alone by least squares on SO(3), of displacements (2007) and of velocities (2010); no scale"
    table = titled("Avg.VRMSE m/s, before", ["baseline"], [*(each.name for each in e.sets), "mean"], caption=caption)
    for name, values in e.baselines.items():
        table.add_row(name, *map(cell, values), cell(float(values.mean())))
    return table


def _convergence_table(e: Evaluation) -> Table:
    from ..evaluation.convergence import PUBLISHED_DEG, PUBLISHED_S, TIMES_S

    title = "Error of the misalignment against time, ° rms: whole angle / pitch and yaw"
    caption = (
        "calibrated on each run with attitude; by the noise of the reference. Published for a network: "
        f"{PUBLISHED_DEG:g}° after {PUBLISHED_S:g} s"
    )
    table = titled(title, ["first"], [curve.label for curve in e.convergence], caption=caption)
    for index, seconds in enumerate(TIMES_S):
        cells = (f"{each.angle_deg[index]:.2f} / {each.level_deg[index]:.2f}" for each in e.convergence)
        table.add_row(f"{seconds:g} s", *cells)
    return table


def _settings(e: Evaluation) -> str:
    """What goes with the table: one prior and one R for all cells, and what the means are means of."""
    import math

    p = e.parameters
    return (
        f"Prior σ of all models {math.degrees(p['initial_std_misalignment']):.3g}°, "
        f"{100 * p['initial_std_scale']:.3g} %; R of those with GNSS ({p['gnss_aided_std']:g} m/s)², of those without "
        f"({p['gnss_free_std']:g} m/s)²; prior sway and heave: {p['prior_source']}. Means over the seeds, and over the "
        "cells of a column" + ("." if e.own_generator else " (the paper's own mean of M3, 0.0323, is not that).")
    )


def _held_out_table(e: Evaluation) -> Table:
    import math

    caption = (
        "Velocity error against GNSS, whose noise is in it, on samples held back: rms over one combination of every "
        "misalignment; how many of these would be accepted / found marginal / rejected. By its size alone, a "
        f"misalignment of {math.degrees(e.parameters['accept_misalignment']):.3g}° is marginal, one of "
        f"{math.degrees(e.parameters['reject_misalignment']):.3g}° rejected."
    )
    table = titled("Hold-out verification, m/s", ["set", ""], e.models, caption=caption)
    for each in e.sets:
        found = {one.model: one for one in e.held_out if one.set_name == each.name}
        for kind in ("uncorrected", "corrected", "predicted"):
            values = (getattr(found[name], kind) if name in found else math.nan for name in e.models)
            table.add_row(each.name if kind == "uncorrected" else "", kind, *map(cell, values))
        counts = [found[name].verdicts if name in found else None for name in e.models]
        words = ("accept", "marginal", "reject")
        table.add_row("", "a / m / r", *("/".join(str(c.get(w, 0)) for w in words) if c else "-" for c in counts))
        table.add_section()
    return table


def _time_table(e: Evaluation) -> Table:
    table = titled("Avg.VRMSE m/s against calibration time", ["set", "first"], e.columns)
    for each, rows in zip(e.sets, e.seed_mean_by_time, strict=True):
        for window, row in zip(e.windows_s, rows, strict=True):
            name = each.name if window == e.windows_s[0] else ""
            table.add_row(name, "all" if window is None else f"{window:g} s", *map(cell, row))
        table.add_section()
    return table


def _each_table(e: Evaluation, study: EachStudy, title: str) -> Table:
    import math

    from ..evaluation.protocol import MANOEUVRING

    caption = "?: the model says that it has not seen yaw, in most of the combinations"
    table = titled(title, ["run", "heading spread"], e.columns, caption=caption)
    scores = study.seed_mean
    for run, row, observed in zip(study.runs, scores, study.yaw_observed, strict=True):
        marks = ["", *(" ?" if share < 0.5 else "" for share in observed)]
        cells = [cell(value) + mark for value, mark in zip(row, marks, strict=True)]
        name = f"{run.trajectory}, {run.from_s:.0f} .. {run.to_s:.0f} s"
        table.add_row(name, f"{math.degrees(run.heading_spread):.0f}°", *cells)
    table.add_section()
    table.add_row("median", "", *map(cell, study.median()))
    table.add_row(f"of {MANOEUVRING[0]} .. {MANOEUVRING[-1]}", "", *map(cell, study.median(MANOEUVRING)))
    return table


def _coverage_table(coverage: Sequence[Coverage], title: str) -> Table:
    caption = "per cent of errors within the 68 % / 95 % interval; error / σ: rms, 1 for an honest σ"
    states = ("φx", "φy", "φz", "δk", "δk y", "δk z")[: max((len(each.state_names) for each in coverage), default=3)]
    table = titled(title, ["model"], (*states, "pooled", "error / σ", "errors"), caption=caption)
    for each in coverage:
        pairs = [f"{100 * a:.0f} / {100 * b:.0f}" for a, b in zip(each.within_68, each.within_95, strict=True)]
        pairs += ["-"] * (len(states) - len(pairs))
        pooled = f"{100 * each.pooled_68:.0f} / {100 * each.pooled_95:.0f}"
        table.add_row(each.model, *pairs, pooled, f"{each.normalised_rms:.2f}", str(each.n_errors))
    return table


def _noise_table(study: ErrorsInVariables) -> Table:
    caption = "predicted / measured, per cent; predicted by " + study.formula
    title = "Errors in variables: pull of the scale by noise in the reference"
    table = titled(title, ["model", "noisy axes"], [f"{std:g} m/s" for std in study.gnss_std], caption=caption)
    for name, axes, predicted, measured in zip(
        study.models, study.noisy_axes, study.predicted, study.measured, strict=True
    ):
        cells = [f"{100 * p:.2f} / {100 * m:.2f}" for p, m in zip(predicted, measured, strict=True)]
        table.add_row(name, f"{axes:g}", *cells)
    return table


# ------------------------------------------------------------------ bags


def _cross_check(arguments: argparse.Namespace, models: list[str], workers: Workers) -> None:
    from ..errors import InputError
    from ..evaluation.bags import cross_check, cross_check_document
    from ..present import cross_check as present
    from ..recordings.topics import Topics

    if arguments.csv is not None:
        raise InputError("--csv: only for a folder of trajectories; for bags there is --json")
    write_report = report_writer(arguments)
    topics = Topics(arguments.dvl_topic, arguments.gnss_topic, arguments.imu_topic)
    with common.progress("replaying") as on_progress:
        check = cross_check(arguments.paths, common.load(arguments), models, topics, workers, on_progress)
    common.deliver(
        lambda: common.print_document(present.cross_check(check)),
        (arguments.json, lambda path: common.write_json(path, cross_check_document(check))),
        (arguments.report, lambda path: write_report(path, check)),
    )
