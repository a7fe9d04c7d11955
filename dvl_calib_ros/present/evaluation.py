"""What an evaluation says.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np

from ..calibration.frames import Array
from ..calibration.models import MODELS
from ..evaluation.convergence import PUBLISHED_DEG, PUBLISHED_S, TIMES_S
from ..evaluation.protocol import MANOEUVRING
from ..evaluation.results import UNCALIBRATED, Coverage, EachStudy, ErrorsInVariables, Evaluation, HeldOut, Trace
from ..verdict.kinds import VERDICT_WORDS
from .document import (
    CELL_KINDS,
    Cell,
    Document,
    Facts,
    Figures,
    Legend,
    Number,
    Numbers,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    figures,
    number,
    parameter_texts,
)

# Deviation from a published figure up to which a cell is coloured so
DEVIATIONS = ((0.05, "good"), (0.25, "off"), (0.5, "far"), (math.inf, "bad"))
CONVERGENCE_NOTE = (
    "Error of the misalignment, ° rms: of the whole angle / of pitch and yaw alone. Calibrated on each run with "
    f"attitude, for each noise of the reference. A published network has {PUBLISHED_DEG:g}° after {PUBLISHED_S:g} s."
)
BASELINES_NOTE = (
    "The rotation alone by least squares on SO(3): of displacements (Kinsey and Whitcomb, 2007; here of the integrated "
    "reference velocity, whose noise grows with time, where they had positions), and of velocities (Troni and "
    "Whitcomb, 2010). They have neither scale nor prior."
)
# How names of states begin, and how people read them
SYMBOLS = {"phi_": "φ", "delta_k": "δk", "delta_k_": "δk "}
# Shares that the intervals claim, and from where to where a share that was found is as claimed
CLAIMED = ((0.68, (0.60, 0.76)), (0.95, (0.91, 0.98)))


def evaluation(e: Evaluation) -> Document:
    """How large the velocity error is after calibration, by model and set, and whether σ can be trusted."""
    studies = [
        (e.each, "Calibrated on each run with attitude"),
        (e.single_heading, "Calibrated on stretches of a single heading"),
    ]
    shown = [each for each in e.convergence if each.name in MODELS]
    by_time = [
        (each.name, "all" if window is None else f"{window:g} s", *(number(value, 4) for value in row.tolist()))
        for each, of_set in zip(e.sets, e.seed_mean_by_time, strict=True)
        for window, row in zip(e.windows_s, of_set, strict=True)
    ]
    times = Table(("set", "first", *e.columns), by_time, notes=("Avg.VRMSE, m/s.",), words=2)
    angles = [
        (f"{seconds:g} s", *(f"{each.angle_deg[k]:.2f} / {each.level_deg[k]:.2f}" for each in e.convergence))
        for k, seconds in enumerate(TIMES_S)
    ]
    converging = Table(("first", *(each.label for each in e.convergence)), angles, notes=(CONVERGENCE_NOTE,))
    others = [(name, *(f"{value:.4f}" for value in each), f"{each.mean():.4f}") for name, each in e.baselines.items()]
    baselines = Table(("Avg.VRMSE, m/s", *(each.name for each in e.sets), "mean"), others, notes=(BASELINES_NOTE,))
    return Document(
        title="Evaluation of the DVL calibration models",
        subtitle=e.source,
        answer=None,
        warnings=e.notes,
        sections=[
            Section("", [Sentence(f"{e.source}: {len(e.trajectories)} trajectories")], Where.TERMINAL),
            Section("", list(map(Sentence, _summary(e)))),
            Section("", [Numbers(_numbers(e))]),
            Section("", [Facts(_facts(e))]),
            Section("", [Warned()], Where.PAGE),
            Section("Velocity error after calibration", [_score_table(e)]),
            _pictures("", figures("evaluation_pictures.improvement_picture", e)),
            Section("Velocity error against calibration time", [times], Where.TERMINAL),
            _pictures(
                "Velocity error against calibration time",
                figures("evaluation_pictures.time_pictures", e),
                e.models,
                "Rings: published." if np.isfinite(published_of(e)).any() else "",
            ),
            Section("How fast is the misalignment found?", [converging] if e.convergence else [], Where.TERMINAL),
            *(
                [
                    _pictures(
                        "How fast is the misalignment found?",
                        figures("evaluation_pictures.convergence_pictures", e),
                        (),
                        "Calibrated on each run with attitude, from ten seconds on, with a reference of this noise or "
                        "none. Roll is shown by turns only: without them the whole angle stays near that of the prior.",
                    )
                ]
                if shown
                else []
            ),
            Section("What was done before", [baselines] if others else []),
            *_coverages(e),
            *_pull(e.errors_in_variables),
            *(each for study, title in studies for each in _study(e, study, title)),
            *_held_out(e.held_out),
            *(
                _pictures(
                    f"Velocity before and after correction: {trace.trajectory}, calibrated on {trace.calibrated_on}",
                    figures("evaluation_pictures.trace_pictures", trace),
                    list(trace.corrected),
                    f"Errors put in: {trace.combination}. Corrected by {best_of_trace(trace)}, the best on it.",
                )
                for trace in e.traces
            ),
        ],
        parameters=parameter_texts(e.parameters),
    )


def _pictures(title: str, drawn: Figures, models: Sequence[str] = (), note: str = "") -> Section:
    """Figures for a page, with the legend of models."""
    legend = [Legend(models, "")] if models else []
    said = [Sentence(note, soft=True)] if note else []
    return Section(title, [*legend, *said, drawn], Where.PAGE)


def published_of(e: Evaluation) -> Array:
    """(S, C) published Avg.VRMSE, nan where there is none: nowhere, if the trajectories are others."""
    return np.full_like(e.published_table, np.nan) if e.own_generator else e.published_table


# ------------------------------------------------------------------ summary


def _best(values: Array, columns: Sequence[str]) -> dict[str, tuple[str, float]]:
    """Name and value of the best model with and without GNSS among the columns, where there is one."""
    found = {
        words: [
            (name, float(value))
            for name, value in zip(columns, values, strict=True)
            if name in MODELS and MODELS[name].aided == aided and math.isfinite(value)
        ]
        for words, aided in (("with GNSS", True), ("without GNSS", False))
    }
    return {words: min(each, key=lambda pair: pair[1]) for words, each in found.items() if each}


def _summary(e: Evaluation) -> Iterable[str]:
    """What was found, in sentences."""
    uncalibrated = e.set_mean[e.columns.index(UNCALIBRATED)]
    published = _best(published_of(e).mean(axis=0), e.columns)
    for words, (name, value) in _best(e.set_mean, e.columns).items():
        gain = 100.0 * (1.0 - value / uncalibrated)
        sentence = f"Best {words}: {name} with {value:.4f} m/s, {gain:.0f} % less than uncalibrated"
        if words in published:
            sentence += "; best published: {} with {:.4f} m/s".format(*published[words])
        yield sentence + "."
    if e.each is not None and e.each.runs:
        medians = _best(e.each.median(), e.columns).items()
        found = ", ".join(f"{name} {value:.4f} m/s {words}" for words, (name, value) in medians)
        yield f"Calibrated on each of {len(e.each.runs)} runs with attitude, best medians: {found}."
    if e.own_generator:
        yield "The trajectories are simulated: the published figures do not apply to them."
    else:
        ratio = (e.seed_mean / published_of(e))[np.isfinite(published_of(e))]
        if len(ratio):
            near = int((np.abs(ratio - 1.0) <= 0.25).sum())
            yield f"{near} of {len(ratio)} published cells are met within 25 %."


def _numbers(e: Evaluation) -> list[Number]:
    where = "mean over the sets" if len(e.sets) > 1 else f"set {e.sets[0].name}"
    value = e.set_mean[e.columns.index(UNCALIBRATED)]
    best = _best(e.set_mean, e.columns).items()
    return [
        Number("uncalibrated", f"{value:.4f} m/s", note=f"Avg.VRMSE, {where}"),
        *(Number(f"best {words}", f"{value:.4f} m/s", note=name) for words, (name, value) in best),
    ]


def _facts(e: Evaluation) -> list[tuple[str, str]]:
    p, n = e.parameters, len(e.seeds)
    seeds = ", ".join(map(str, e.seeds)) if n <= 10 else f"{e.seeds[0]} to {e.seeds[-1]} ({n})"
    sets = "; ".join(
        f"{each.name}: {each.calibration_run}, " + ("all" if each.window_s is None else f"first {each.window_s:g} s")
        for each in e.sets
    )
    return [
        ("Trajectories", f"{len(e.trajectories)}: {', '.join(e.trajectories)}"),
        ("Calibrated on", sets),
        ("Errors", f"{e.n_combinations} combinations of misalignment and scale, noise seeds {seeds}"),
        (
            "Prior, all models",
            f"{math.degrees(p['initial_std_misalignment']):.3g}°, {100 * p['initial_std_scale']:.3g} % (1σ)",
        ),
        ("R, per axis", f"{p['gnss_aided_std']:g} m/s with GNSS, {p['gnss_free_std']:g} m/s without"),
        ("Prior sway and heave", str(p["prior_source"])),
    ]


# ------------------------------------------------------------------ scores


def _score(value: float, published: float) -> str | Cell:
    if not math.isfinite(value):
        return "–"
    if not math.isfinite(published):
        return f"{value:.4f}"
    ratio = value / published
    kind = next(kind for limit, kind in DEVIATIONS if abs(ratio - 1.0) <= limit)
    return Cell(f"{value:.4f}", kind, f"{published:.4f} ×{ratio:.2f}")


def _score_table(e: Evaluation) -> Table:
    """Avg.VRMSE, a line per model and a column per set, with the published figure and the ratio to it below."""
    rows = []
    for name, here, published in zip(e.columns, e.seed_mean.T, published_of(e).T, strict=True):
        means = _score(float(here.mean()), float(published.mean()))
        rows.append((name, *(_score(*pair) for pair in zip(here.tolist(), published.tolist(), strict=True)), means))
    notes = [
        "Avg.VRMSE in m/s: root mean square of the velocity error, mean over trajectories, combinations and seeds."
    ]
    if np.isfinite(published_of(e)).any():
        notes.append(
            "Below each: the published figure and the ratio to it; green within 5 %, yellow 25 %, orange 50 %, red "
            "beyond. Means are those of the cells beside them, not the paper's."
        )
    return Table(("model", *(each.name for each in e.sets), "mean"), rows, notes=notes)


# ------------------------------------------------------------------ uncertainty


def _coverages(e: Evaluation) -> Iterable[Section]:
    studies = (
        ("Calibrated on the sets and on each run with attitude", e.coverage_of_all),
        ("Calibrated on the sets", e.coverage),
        ("Calibrated on each run with attitude", e.each.coverage if e.each else ()),
        ("Calibrated on stretches of a single heading", e.single_heading.coverage if e.single_heading else ()),
    )
    for title, coverages in studies:
        if coverages:
            yield Section(f"Can the uncertainty be trusted? {title}", [_coverage_table(coverages)])
            yield _pictures("", figures("evaluation_pictures.coverage_picture", coverages))


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
            for share, (_, (low, high)) in zip((coverage.pooled_68, coverage.pooled_95), CLAIMED, strict=True)
        ]
        rows.append((coverage.model, *pooled, *(shares.get(name, "–") for name in states), str(coverage.n_errors)))
    named = [re.sub("^(phi_|delta_k_?)", lambda found: SYMBOLS[found[0]], name) for name in states]
    return Table(
        ("model", "68 % interval", "95 % interval", *named, "errors each"),
        rows,
        notes=(
            "Per cent of the errors (estimate minus truth) inside the interval that σ claims, over all states and for "
            "each (68 / 95); green within 60–76 and 91–98 %. Below: σ is too small.",
        ),
    )


def _pull(study: ErrorsInVariables | None) -> list[Section]:
    if study is None:
        return []
    rows = [
        (
            f"{std:g}",
            *(
                " / ".join(number(100 * each[i, j], signed=True) for each in (study.predicted, study.measured))
                for i in range(len(study.models))
            ),
        )
        for j, std in enumerate(study.gnss_std)
    ]
    table = Table(("GNSS σ, m/s", *study.models), rows, notes=("Pull of the scale in %: predicted / measured.",))
    return [
        Section("Noise in the reference pulls the scale", [Sentence(study.formula), table]),
        _pictures("", figures("evaluation_pictures.pull_picture", study), study.models),
    ]


# ------------------------------------------------------------------ runs


def run_names(study: EachStudy) -> list[str]:
    """Runs that were calibrated on, as they are named."""
    return [f"{run.trajectory} {run.from_s:.0f}–{run.to_s:.0f} s" for run in study.runs]


def _study(e: Evaluation, study: EachStudy | None, title: str) -> list[Section]:
    if study is None or not study.runs:
        return []
    found = zip(study.runs, run_names(study), study.seed_mean.tolist(), study.yaw_observed.tolist(), strict=True)
    rows = []
    for run, label, values, observed in found:
        seen = dict(zip(e.models, observed, strict=True))
        cells = [
            number(value, 4) + (" ?" if math.isfinite(value) and seen.get(name, 1.0) < 0.5 else "")
            for name, value in zip(e.columns, values, strict=True)
        ]
        rows.append((label, f"{math.degrees(run.heading_spread):.0f}", *cells))
    medians = {"median": study.median(), f"of {MANOEUVRING[0]} .. {MANOEUVRING[-1]}": study.median(MANOEUVRING)}
    rows += [
        (name, "", *(number(value, 4) for value in each.tolist()))
        for name, each in medians.items()
        if name == "median" or np.isfinite(each).any()
    ]
    notes = (
        "Avg.VRMSE on all other trajectories, m/s. Headings: their circular standard deviation. ? marks where the "
        "model mostly says that it has not seen yaw; – where it cannot run.",
    )
    table = Table(("run", "headings, °", *e.columns), rows, marked=len(study.runs), dense=True, notes=notes)
    return [
        _pictures(title, figures("evaluation_pictures.study_picture", e, study), e.models),
        Section(title, [table], Where.TERMINAL),
        Section("", [table], Where.PAGE),
    ]


def best_of_trace(trace: Trace) -> str:
    """The model that does best on a trajectory."""
    errors = {
        name: float(((velocity - trace.truth) ** 2).sum(axis=1).mean()) for name, velocity in trace.corrected.items()
    }
    return min(errors, key=lambda name: errors[name])


def _held_out(held_out: Sequence[HeldOut]) -> list[Section]:
    if not held_out:
        return []
    sets = list(dict.fromkeys(each.set_name for each in held_out))
    models = list(dict.fromkeys(each.model for each in held_out))
    cells = {
        (each.model, each.set_name): Cell(
            f"{each.corrected:.4f}",
            CELL_KINDS[VERDICT_WORDS[each.verdict]],
            f"{each.uncorrected:.4f} → {each.predicted:.4f}, {each.verdict}",
        )
        for each in held_out
    }
    rows = [(model, *(cells.get((model, name), "–") for name in sets)) for model in models]
    notes = (
        "Velocity error on held-out data, m/s rms; below: uncorrected → predicted, and the verdict. Each block of a "
        "calibration run was held back in turn and corrected with a calibration that had not seen it; the noise of the "
        "reference is in all errors.",
    )

    by_set = {name: [each for each in held_out if each.set_name == name] for name in sets}
    drawn = [_pictures("", figures("evaluation_pictures.held_out_picture", *each)) for each in by_set.items()]
    return [Section("Held-out verification", [Table(("model", *sets), rows, notes=notes)]), *drawn]
