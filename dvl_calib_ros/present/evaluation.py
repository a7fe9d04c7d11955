"""Documents of an evaluation, and of bags checked against each other."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from ..calibration.models import MODELS
from ..evaluation.cross_check import CrossCheck
from ..evaluation.protocol import MANOEUVRING
from ..evaluation.results import UNCALIBRATED, Coverage, EachStudy, Evaluation, HeldOut
from ..evaluation.validation_study import PUBLISHED_DEG, PUBLISHED_S, TIMES_S
from ..verdict.kinds import VERDICT_WORDS, Severity
from .document import (
    CELL_KINDS,
    HELD_OUT_KINDS,
    Answer,
    Cell,
    Document,
    Item,
    Legend,
    Number,
    Numbers,
    Section,
    Sentence,
    SideBySide,
    Table,
    Warned,
    Where,
    facts_by,
    figure,
    figures,
    section,
)
from .numbers import number

# largest relative deviations from a published figure for each colour; the last is for no published figure
WITHIN, KINDS = (0.05, 0.25, 0.5, math.inf), ("good", "off", "far", "bad", "")
BODY_AXES = ("ahead", "to port", "up")
CONVERGENCE_NOTE = (
    "Error of the misalignment, ° rms: of the whole angle / of pitch and yaw alone. Calibrated on each run with "
    f"attitude, for each noise of the reference. A published network has {PUBLISHED_DEG:g}° after {PUBLISHED_S:g} s. "
    "Only turns make roll observable: without them the whole angle keeps the error of the prior."
)
BASELINES_NOTE = (
    "Only the rotation, by least squares on SO(3): from displacements (Kinsey and Whitcomb, 2007; here of the "
    "integrated reference velocity, whose noise grows with time, where they had positions), and from velocities "
    "(Troni and Whitcomb, 2010). They have neither scale nor prior."
)
# prefixes of state names -> displayed symbols
SYMBOLS = {"phi_": "φ", "delta_k": "δk", "delta_k_": "δk "}
# shares claimed by the intervals, with the range of observed shares that agrees
CLAIMED = ((0.68, (0.60, 0.76)), (0.95, (0.91, 0.98)))
FACTS: Mapping[str, Callable[[Evaluation], str]] = {
    "Trajectories": lambda e: f"{len(e.trajectories)}: {', '.join(e.trajectories)}",
    "Calibrated on": lambda e: "; ".join(
        f"{each.name}: {each.calibration_run}, " + ("all" if each.window_s is None else f"first {each.window_s:g} s")
        for each in e.sets
    ),
    "Errors": lambda e: (
        f"{e.n_combinations} combinations of misalignment and scale, noise seeds "
        + (", ".join(map(str, e.seeds)) if len(e.seeds) <= 10 else f"{e.seeds[0]} to {e.seeds[-1]} ({len(e.seeds)})")
    ),
    "Prior, all models": lambda e: (
        f"{math.degrees(e.parameters['initial_std_misalignment']):.3g}°, "
        f"{100 * e.parameters['initial_std_scale']:.3g} % (1σ)"
    ),
    "R, per axis": lambda e: (
        f"{e.parameters['gnss_aided_std']:g} m/s with GNSS, {e.parameters['gnss_free_std']:g} m/s without"
    ),
    "Prior sway and heave": lambda e: str(e.parameters["prior_source"]),
}

SEVERITIES = {"better": Severity.ACCEPT, "not_better": Severity.REJECT, "not_known": Severity.MARGINAL}


def evaluation(e: Evaluation) -> Document:
    """Lay out the velocity error after calibration, by model and set, and the reliability of σ."""
    studies = [
        (e.each, "Calibrated on each run with attitude"),
        (e.single_heading, "Calibrated on stretches of a single heading"),
    ]
    coverages = [
        ("Calibrated on the sets and on each run with attitude", e.coverage_of_all),
        ("Calibrated on the sets", e.coverage),
        *((title, study.coverage) for study, title in studies if study is not None),
    ]
    others = [(name, *(f"{value:.4f}" for value in each), f"{each.mean():.4f}") for name, each in e.baselines.items()]
    baselines = Table(("Avg.VRMSE, m/s", *(each.name for each in e.sets), "mean"), others, notes=(BASELINES_NOTE,))
    where = "mean over the sets" if len(e.sets) > 1 else f"set {e.sets[0].name}"
    uncalibrated = e.set_mean[e.columns.index(UNCALIBRATED)]
    published = e.best(e.published_of_these.mean(axis=0))
    found = [Number(UNCALIBRATED, f"{uncalibrated:.4f} m/s", note=f"Avg.VRMSE, {where}")]
    for aiding, (name, value) in e.best(e.set_mean).items():
        note = f"{name}, {100.0 * (1.0 - value / uncalibrated):.0f} % less than uncalibrated"
        if aiding in published:
            note += "; best published: {} with {:.4f} m/s".format(*published[aiding])
        found.append(Number(f"best {aiding}", f"{value:.4f} m/s", note=note))
    return Document(
        title="Evaluation of the DVL calibration models",
        subtitle=e.source,
        answer=Answer(e.verdict, SEVERITIES[e.verdict], [e.improvement.sentence("runs")]),
        warnings=e.notes,
        sections=[
            section("", Sentence(f"{e.source}: {len(e.trajectories)} trajectories"), where=Where.TERMINAL),
            section("", Numbers(found)),
            section("", facts_by(FACTS, e)),
            section("", Warned(), where=Where.PAGE),
            section("Velocity error after calibration", *_scores(e)),
            _error_by_time(e),
            *([_convergence(e)] if e.convergence else []),
            section("Earlier methods", baselines),
            *(
                section(f"Can the uncertainty be trusted? {title}", *_coverage(found))
                for title, found in coverages
                if found
            ),
            *(_single_run_study(e, study, title) for study, title in studies if study is not None and study.runs),
            *([_held_out(e.held_out)] if e.held_out else []),
        ],
        parameters=e.parameters,
    )


def _scores(e: Evaluation) -> Iterable[Item]:
    """Yield Avg.VRMSE by model and set, with the published figure and the ratio, and the error reduction by model."""
    ours, published = (np.vstack([each, each.mean(axis=0)]).T for each in (e.seed_mean, e.published_of_these))
    ratio = ours / published
    kinds = np.searchsorted(WITHIN, np.abs(ratio - 1.0))  # nan sorts after all others
    rows: list[tuple[str | Cell, ...]] = []
    for name, *of_sets in zip(e.columns, *map(np.ndarray.tolist, (ours, published, ratio, kinds)), strict=True):
        cells = (
            Cell(number(value, 4), KINDS[kind], f"{known:.4f} ×{times:.2f}" if math.isfinite(times) else "")
            for value, known, times, kind in zip(*of_sets, strict=True)
        )
        rows.append((name, *cells))
    notes = [
        "Avg.VRMSE in m/s: root mean square of the velocity error, mean over trajectories, combinations and seeds."
    ]
    if e.own_generator:
        notes.append("The trajectories are simulated: the published figures do not apply to them.")
    if np.isfinite(published).any():
        ratios = e.ratio[np.isfinite(e.ratio)]
        notes.append(
            f"{int((np.abs(ratios - 1.0) <= 0.25).sum())} of {len(ratios)} published cells are reproduced within 25 %. "
            "Below each: the published figure and the ratio to it; green within 5 %, yellow 25 %, orange 50 %, red "
            "beyond. Means are over the cells in the row, not the paper's."
        )
    yield Table(("model", *(each.name for each in e.sets), "mean"), rows, notes=notes)
    base = e.columns.index(UNCALIBRATED)
    both_vrmse = (e.seed_mean, e.published_of_these)
    gains, gains_published = (1.0 - e.of_models(vrmse) / vrmse[:, [base]] for vrmse in both_vrmse)
    text = ", ".join(f"{name} {100 * value:.0f} %" for name, value in zip(e.models, gains.mean(axis=0), strict=True))
    yield figure(
        "evaluation_figures.improvement_bars",
        "Improvement over uncalibrated",
        f"Mean over the sets: {text}",
        e.models,
        gains,
        gains_published,
    )


def _error_by_time(e: Evaluation) -> Section:
    """Lay out the error by set and calibration time."""
    rows = [
        (each.name, "all" if window is None else f"{window:g} s", *(number(value, 4) for value in row.tolist()))
        for each, of_set in zip(e.sets, e.seed_mean_by_time, strict=True)
        for window, row in zip(e.windows_s, of_set, strict=True)
    ]
    table = Table(("set", "first", *e.columns), rows, notes=("Avg.VRMSE, m/s.",), words=2, dense=True)
    rings = "Rings: published." if np.isfinite(e.published_of_these).any() else ""
    drawn = [
        figure(
            "evaluation_figures.error_over_calibration_time",
            f"{each.name}: calibrated on {each.calibration_run}",
            f"Avg.VRMSE against calibration time for set {each.name}, all models",
            e.models,
            e.windows_s,
            float(e.seed_mean[i, e.columns.index(UNCALIBRATED)]),
            e.of_models(e.seed_mean_by_time[i]),
            each.window_s,
            e.of_models(e.published_of_these[i]),
            caption=rings,
        )
        for i, each in enumerate(e.sets)
    ]
    return section("Velocity error against calibration time", Legend(e.models, ""), SideBySide(drawn), table)


def _convergence(e: Evaluation) -> Section:
    """Lay out the error of the misalignment over time."""
    rows = [
        (f"{seconds:g} s", *(f"{each.angle_deg[k]:.2f} / {each.level_deg[k]:.2f}" for each in e.convergence))
        for k, seconds in enumerate(TIMES_S)
    ]
    table = Table(("first", *(each.label for each in e.convergence)), rows, notes=(CONVERGENCE_NOTE,), dense=True)
    curves = [each for each in e.convergence if each.name in MODELS]
    drawn = []
    for what, values in (
        ("Pitch and yaw", [each.level_deg for each in curves]),
        ("The whole angle", [each.angle_deg for each in curves]),
    ):
        text = "; ".join(f"{each.label}: {value[-1]:.2f}°" for each, value in zip(curves, values, strict=True))
        drawn.append(
            figure(
                "evaluation_figures.misalignment_over_time",
                f"{what}, error against time",
                f"{what} against time; after {TIMES_S[-1]:g} s {text}",
                TIMES_S,
                [each.name for each in curves],
                [each.gnss_std for each in curves],
                values,
                (PUBLISHED_S, PUBLISHED_DEG),
                caption="rms over runs, combinations of errors and seeds. Star: published for a network.",
            )
        )
    return section("How fast is the misalignment found?", SideBySide(drawn) if curves else None, table)


def _coverage(coverages: Sequence[Coverage]) -> Iterable[Item]:
    """Yield the share of errors inside the intervals claimed by σ, by model."""
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
    yield Table(
        ("model", "68 % interval", "95 % interval", *named, "number of errors per state"),
        rows,
        notes=(
            "Per cent of the errors (estimate minus truth) inside the interval that σ claims, over all states and for "
            "each (68 / 95); green within 60–76 and 91–98 %. Below: σ is too small.",
        ),
    )
    yield figure(
        "evaluation_figures.coverage_points",
        "Errors inside the claimed intervals",
        ", ".join(f"{c.model} {100 * c.pooled_68:.0f} and {100 * c.pooled_95:.0f} %" for c in coverages),
        [coverage.model for coverage in coverages],
        {0.68: [c.pooled_68 for c in coverages], 0.95: [c.pooled_95 for c in coverages]},
    )


def _single_run_study(e: Evaluation, study: EachStudy, title: str) -> Section:
    """Lay out the scores of calibrations on each single run."""
    rows = []
    for run, label, values, observed in zip(
        study.runs, study.run_names, study.seed_mean.tolist(), study.yaw_observed.tolist(), strict=True
    ):
        share_by_model = dict(zip(e.models, observed, strict=True))
        cells = [
            number(value, 4) + (" ?" if math.isfinite(value) and share_by_model.get(name, 1.0) < 0.5 else "")
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
        "yaw is mostly not observable for the model; – where it cannot run.",
    )
    table = Table(("run", "headings, °", *e.columns), rows, marked=len(study.runs), dense=True, notes=notes)
    median = ", ".join(f"{name} {v:.4f}" for name, v in zip(e.columns, medians["median"].tolist(), strict=True))
    by_run = figure(
        "evaluation_figures.error_by_run",
        "Avg.VRMSE by calibration run",
        f"Avg.VRMSE, median over the runs, m/s: {median}",
        study.run_names,
        e.models,
        study.seed_mean[:, e.columns.index(UNCALIBRATED)],
        e.of_models(study.seed_mean),
        caption="Bars: uncalibrated. Filled: models with GNSS. Hollow: without.",
    )
    return section(title, Legend(e.models, ""), by_run, table)


def _held_out(held_out: Sequence[HeldOut]) -> Section:
    """Lay out error and verdict on held-out data, by set and model."""
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
    drawn = [
        figure(
            "replay_figures.held_out_errors",
            f"{name}: error on held-out data",
            "Verdicts: " + ", ".join(f"{each.model} {each.verdict}" for each in of_set),
            [each.model for each in of_set],
            *(np.array([getattr(each, kind) for each in of_set]) for kind in HELD_OUT_KINDS),
        )
        for name, of_set in by_set.items()
    ]
    return section("Held-out verification", Table(("model", *sets), rows, notes=notes), *drawn)


ERRORS_NOTE = (
    "rms of the vector, m/s, with the noise of GNSS. A delay moves the times at which GNSS is interpolated, and with "
    "them this noise: judge such a model by its drift. – nothing to calibrate with, or to check against."
)
DRIFT_NOTE = (
    "Drift in m per km, and per cent of the distance, rms over stretches of up to 1 km. With the lever arm of the "
    "calibrating bag; the delay, which differs per recording, is estimated from the bag itself."
)


def cross_check(check: CrossCheck) -> Document:
    """Lay out the errors of each bag's calibration on every other bag.

    Rows: calibrating bags and models. Columns: bags that are corrected. First drift of dead reckoning, with a picture
    per bag, then the velocity error.
    """
    heading, uncalibrated = ("calibrated on", "model", *check.names), ("nothing", "uncalibrated")
    errors = [(*uncalibrated, *(number(value, 4) for value in check.uncorrected.tolist()))]
    for name, by_model in zip(check.names, check.corrected, strict=True):
        for model, row in zip(check.models, by_model, strict=True):
            errors.append((name, model, *(number(value, 4) for value in row.tolist())))
    by_bag = [
        (name, model, [check.navigation.get((calibrated, verified)) for verified in check.bags])
        for calibrated, name, model in zip(check.bags, check.names, check.selected, strict=True)
    ]
    # as mounted, a drift hardly depends on the calibrating bag: the first one's
    first = [next(filter(None, of_bag), None) for of_bag in zip(*(each for *_, each in by_bag), strict=True)]
    drifts = [("nothing", "as mounted", [each and each.before for each in first])]
    drifts += [(name, model, [each and each.after for each in navigations]) for name, model, navigations in by_bag]
    drift_rows = [
        (name, model, *("–" if each is None else f"{each.per_km:.1f} ({each.percent:.2g} %)" for each in of_bags))
        for name, model, of_bags in drifts
    ]
    pictures: list[Item] = []
    for k, name in enumerate(check.names):
        tracks = {f"by {other}": found for other, _, each in by_bag if (found := each[k]) is not None}
        if tracks:
            uncorrected = next(iter(tracks.values()))
            pictures.append(figures("replay_figures.navigation_pictures", uncorrected, tracks, f", {name}"))
    return Document(
        title="Bags checked against each other",
        subtitle=", ".join(check.names),
        answer=Answer(check.verdict, SEVERITIES[check.verdict], [check.improvement.sentence("bags")]),
        warnings=check.notes,
        sections=[
            section(
                "",
                Sentence("Each bag calibrates; all other bags with a reference are corrected with the result."),
                where=Where.PAGE,
            ),
            section(
                "Dead reckoning on the other bags",
                Table(heading, drift_rows if check.navigation else (), notes=(DRIFT_NOTE,), words=2),
                *pictures,
            ),
            section(
                "Difference of DVL and GNSS on the other bags",
                Table(heading, errors, dense=True, notes=(ERRORS_NOTE,), words=2),
            ),
            section("", *(Sentence(each, soft=True) for each in check.found)),
        ],
        parameters=check.parameters,
    )
