"""Document of a replay: verdict, mounting, error terms of the models, drift and next commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..bag_replay.replay import Replayed
from ..calibration.assessment.dead_reckoning import in_words, metres
from ..calibration.assessment.manoeuvre_planner import drift_left_open
from ..calibration.models import MODELS, Model
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import rpy_from_rotation
from ..calibration.numerics.samples import VelocityFrame
from ..calibration.results.mounting_quantities import not_shown, quantities
from ..calibration.results.results import Estimate, Result, Verification
from ..files.result_file import result_document
from ..files.urdf import origin_tag
from ..verdict.kinds import Severity
from .document import (
    CELL_KINDS,
    HELD_OUT_KINDS,
    Answer,
    Cell,
    Columns,
    Commands,
    Document,
    Item,
    Legend,
    Number,
    Numbers,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    Worth,
    columns_for,
    facts_by,
    figure,
    figures,
    section,
    table_by,
)
from .numbers import fitting_unit, typed, with_std

# advice for each verdict
ADVICE = {
    Severity.ACCEPT: "Use this calibration.",
    Severity.MARGINAL: "Use this calibration with care.",
    Severity.REJECT: "Do not use this calibration.",
}
EARTH = (VelocityFrame.ENU, VelocityFrame.NED)
FAMILIES = ((True, "Models with GNSS"), (False, "Models without GNSS"))
# positive direction of each quantity, for the installer
_AXES = {
    "scale": "scale of motion ahead",
}


NO_MOUNTING = "No mounting is given. The models' estimates are in the details (--verbose)."
AGAINST_TRAVEL = (
    "Without a reference the angles are relative to the direction of travel: a constant sideslip looks like yaw, and "
    "driving astern looks like a DVL rotated by 180°."
)
AGAINST_IMU = (
    "Angles are relative to the IMU: a constant error of its heading is in the yaw, one of its level in roll and "
    "pitch. Both are harmless as long as the same IMU is used."
)
STRAIGHT = "A straight kilometre of dead reckoning ends {0.before} m off as mounted, {0.after} m corrected (1σ)."
NO_RESIDUALS = ". Too few of them have a reference for residuals."
RESIDUALS = (
    "; residuals are at the reference point, corrected by estimates without this data, with everything "
    "found, including lever arm and delay. They include the reference's noise. Lines are running means."
)
HELD_OUT_NOTE = (
    "Each block of the run was held back in turn and corrected with a calibration that had not seen it. Velocity error "
    "against the reference, m/s rms, with the noise of the reference in all of them. A delay moves the times at which "
    "the reference is interpolated, and so changes this noise. Predicted: by this noise and the calibration's σ."
)
HELD_OUT: Columns[Verification] = {
    "model": lambda each: each.model,
    **columns_for(
        {kind: kind for kind in HELD_OUT_KINDS},
        lambda each, kind: "–" if each.held_out is None else f"{getattr(each.held_out, kind):.4f}",
    ),
    "samples": lambda each: "0" if each.held_out is None else str(each.held_out.samples),
    "verdict": lambda each: Cell(each.verdict.value, CELL_KINDS[each.verdict]),
}


STREAMS: Columns[tuple[str, Mapping[str, int]]] = {
    "": lambda each: each[0],
    "received": lambda each: str(each[1].get("received", "–")),
    "of which": lambda each: Cell(
        ", ".join(f"{n} {what.replace('_', ' ')}" for what, n in each[1].items() if n and what != "received") or "–",
        "text",
    ),
}
_STREAMS = (("dvl", "DVL"), ("reference", "GNSS velocity"), ("imu", "IMU"), ("pairing", "pairing of DVL and GNSS"))


def _period_text(run: Replayed) -> str:
    """Return the first and last stamp in UTC and the duration, as text."""
    result = run.result
    if result.first_ns is None or result.last_ns is None:
        return "nothing"
    seconds = (result.last_ns - result.first_ns) * 1e-9
    unit_s, unit = fitting_unit(seconds)
    duration = f"{seconds / unit_s:.1f} {unit}"
    first, last = (datetime.fromtimestamp(ns // 10**9, timezone.utc) for ns in (result.first_ns, result.last_ns))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S} UTC, {duration}"


FACTS: Mapping[str, Callable[[Replayed], str]] = {
    "Model": lambda run: (
        f"{run.result.selected} ({run.result.selected_because.sentence}); {run.result.estimate.convergence.value}"
    ),
    "Angles": lambda run: "against the IMU's heading and level" if run.reference_frame in EARTH else "",
    "Recorded": _period_text,
    "DVL data": lambda run: run.dvl_data,
    "Samples": lambda run: (
        f"{run.result.counts['dvl']['accepted']} of the DVL, {run.result.counts['pairing']['paired']} with a reference "
        "velocity at their time"
    ),
    "Used by the model": lambda run: (
        f"{run.result.estimate.used} {'references' if MODELS[run.result.selected].estimator else 'DVL samples'}, "
        f"{run.result.estimate.gated} rejected as outliers"
    ),
}


def replayed(
    run: Replayed,
    bags: Sequence[Path],
    models: Sequence[str],
    *,
    details: bool = False,
    warnings: Sequence[str] | None = None,
    found: Sequence[str] = (),
    commands: Sequence[str] = (),
) -> Document:
    """Lay out the result of a replay.

    Parameters
    ----------
    run
        The replay; a page has its pictures if it was run with a history.
    bags
        Replayed bags.
    models
        Names to show, in addition to the selected one.
    details
        Whether a terminal also shows the models and the counts.
    warnings
        Warnings; None for all notes, with those of other models folded away.
    found
        Discovered topics and parameters in sentences, for a terminal.
    commands
        Commands to type next.
    """
    result, history = run.result, run.history
    shown_models = [name for name in result.estimates if name in models or name == result.selected]
    verification = result.verifications.get(result.selected)
    rejected = verification is not None and verification.verdict is Severity.REJECT
    drift = None if rejected else run.navigation
    others = tuple(f"{name}: " for name in result.estimates if name != result.selected)
    shown_warnings = [note for note in run.notes if not note.startswith(others)] if warnings is None else warnings
    where = Where.BOTH if details else Where.PAGE
    streams = [(name, result.counts[key]) for key, name in _STREAMS]
    # an angle that is not observable must not be put on a vehicle
    is_shown = not rejected and any(each.shown for each in quantities(result)[:3])
    worth = Worth(*map(metres, straight_kilometre(result))) if is_shown else None
    return Document(
        title="DVL calibration",
        subtitle=", ".join(map(str, bags)),
        answer=_verdict_answer(verification),
        warnings=shown_warnings,
        sections=[
            section("", worth, where=Where.PAGE),
            section(_headline(run, rejected), *([Sentence(NO_MOUNTING)] if rejected else _mounting(run))),
            section("", None if rejected else figures("replay_figures.mounting_pictures", result), where=Where.PAGE),
            section("", facts_by(FACTS, run), where=where),
            section(
                "", Sentence("Corrected mounting, ready to paste:", soft=True) if is_shown else None, where=Where.PAGE
            ),
            section("", _mounting_to_copy(run) if is_shown else None),
            section("", Warned(), where=Where.PAGE),
            section(
                "Effect on navigation",
                None if worth is None else Sentence(STRAIGHT.format(worth)),
                *map(Sentence, in_words(drift) if drift else ()),
                figures("replay_figures.navigation_pictures", drift, {"": drift}, "", history.stamps_ns)
                if drift and history
                else None,
            ),
            section("Found in the recording", *(Sentence(each, soft=True) for each in found), where=Where.TERMINAL),
            section(
                "",
                Commands([("next" if not k else "", each) for k, each in enumerate(commands)]) if commands else None,
                where=Where.TERMINAL,
            ),
            section("Held-out verification", *_held_out(result, shown_models), where=Where.PAGE),
            section("Estimates", estimate_table(result, shown_models), where=where),
            *_over_time(run, shown_models),
            section("Data", table_by(STREAMS, streams), where=where),
            section(
                "",
                figures("replay_figures.data_pictures", result, history, shown_models) if history else None,
                where=Where.PAGE,
            ),
        ],
        parameters=result.parameters,
        folded=[note for note in run.notes if note.startswith(others)] if warnings is None else (),
    )


def straight_kilometre(result: Result) -> tuple[float, float]:
    """Return the error of dead reckoning after a straight kilometre, m (1σ): as mounted, and with the correction.

    The uncertainty of the correction is included in both.
    """
    parameters = Parameters.from_mapping(result.parameters)
    ahead, nominal = np.eye(3)[0], parameters.rotation_dvl_from_body
    measured = (1.0 + result.estimate.scale) * (result.estimate.rotation_body_from_dvl(nominal).T @ ahead)
    error_m = 1000.0 * float(np.linalg.norm((nominal.T @ measured - ahead)[:2]))
    left_open = drift_left_open(result.estimate, parameters)
    return math.hypot(error_m, left_open), left_open


def _verdict_answer(verification: Verification | None) -> Answer:
    """Return the verdict of the held-out data with its reasons and advice."""
    if verification is None:
        return Answer("not verified", Severity.MARGINAL, ["No data were held back to verify the calibration."])
    reasons = [*verification.reasons]
    if verification.mounting is not None and verification.verdict is not Severity.REJECT:
        reasons.append(verification.mounting)
    verdict = verification.verdict
    return Answer(verdict.value, verdict, [each.full_sentence for each in reasons], ADVICE[verdict])


def _headline(run: Replayed, rejected: bool) -> str:
    """Return rotation from the configured mounting, model and amount of data; no mounting after a reject."""
    result = run.result
    seconds = 1e-9 * ((result.last_ns or 0) - (result.first_ns or 0)) - run.pause_s
    data = f"(model {result.selected}, {seconds:.0f} s of data)"
    if rejected:
        return f"Not to be used {data}"
    parameters = Parameters.from_mapping(result.parameters)
    turn = parameters.rotation_dvl_from_body @ result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    angle = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(turn)) - 1.0)))))
    return f"The DVL is rotated by {angle:.2f}° from its configured mounting in {parameters.base_frame} {data}"


def _mounting(run: Replayed) -> Iterator[Item]:
    """Yield the mounting found, the reference of the angles with its own error, and unobservable quantities."""
    body_axes = Parameters.from_mapping(run.result.parameters).body_axes
    names = _AXES | {f"lever arm {axis}": f"lever arm, {where}" for axis, where in zip("xyz", body_axes, strict=True)}
    numbers = [
        Number(
            names.get(each.name, each.name),
            each.in_unit(each.value),
            each.in_unit(each.std),
            each.in_unit(each.nominal),
            each.in_unit(each.value - each.nominal, signed=True),
            "" if each.shown else "not observable in this data",
            each.shown,
        )
        for each in quantities(run.result)
    ]
    yield Numbers(numbers)
    if not MODELS[run.result.selected].aided:
        yield Sentence(AGAINST_TRAVEL)
    elif run.reference_frame in EARTH:
        yield Sentence(AGAINST_IMU)
    for lacks, axes in not_shown(run.result).items():
        yield Sentence(f"{axes} (?): not observable in this recording; needed: {lacks}")
    if (cause := run.cause_of_scale) is not None:
        yield Sentence(cause.sentence)
    if run.result.iac_model in run.result.estimates and run.result.iac_model != run.result.selected:
        yield Sentence(_iac_sentence(run.result))


def _iac_sentence(result: Result) -> str:
    """Return the result of the paper's own selection for roll, pitch, yaw and scale."""
    found = quantities(replace(result, selected=result.iac_model))
    values = ", ".join(
        f"{each.name} {each.in_unit(each.value)} ± {each.in_unit(each.std)}" if each.shown else f"{each.name} not shown"
        for each in found[:4]
    )
    return f"The paper's own selection (iac, {result.iac_model}): {values}."


def _mounting_to_copy(run: Replayed) -> Commands:
    """Return the corrected mounting to copy: URDF origin (for forward-right-down data with both axes) and tf2."""
    result = run.result
    parameters = Parameters.from_mapping(result.parameters)
    rotation = result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    mounting = result_document(result, run.dvl_frame, run.turned)["mounting"]
    static, origin = mounting["static_transform_publisher"], mounting["urdf_origin"]
    lines = [("URDF", origin)]
    if run.turned:
        tag = origin_tag(result.position_in_body, rpy_from_rotation(rotation))
        lines = [
            ("URDF", f"{tag}  (forward-left-up axes)"),
            ("", f"{origin}  ({run.dvl_frame} of the driver: forward-right-down)"),
        ]
    return Commands(lines, on_page=[("tf", static)] if static else [])


def _held_out(result: Result, models: Sequence[str]) -> Iterator[Item]:
    """Yield the errors of each model's correction on held-out data."""
    verifications = {name: result.verifications[name] for name in models if name in result.verifications}
    judged = {name: each.held_out for name, each in verifications.items() if each.held_out is not None}
    if judged:
        yield Sentence(HELD_OUT_NOTE)
        yield replace(table_by(HELD_OUT, verifications.values()), marked=list(verifications).index(result.selected))
        yield figure(
            "replay_figures.held_out_errors",
            "Velocity error on held-out data",
            "; ".join(f"{name}: {e.uncorrected:.3f} to {e.corrected:.3f} m/s" for name, e in judged.items()),
            list(judged),
            *(np.array([getattr(error, kind) for error in judged.values()]) for kind in HELD_OUT_KINDS),
        )


def _over_time(run: Replayed, names: Sequence[str]) -> Iterator[Section]:
    """Yield estimates over time and innovations, for models with and without GNSS; velocities."""
    result, history = run.result, run.history
    if history is None or len(history.stamps_ns) < 2:  # nothing to draw over time
        return
    for aided, title in FAMILIES:
        models = [name for name in names if MODELS[name].aided == aided and result.estimates[name].used]
        if models:
            drawn = figures("replay_figures.estimate_pictures", result, history, models)
            yield section(title, Legend(models, result.selected), drawn, where=Where.PAGE)
    by = f"Body frame. Velocities are of the DVL's own place, corrected with the final estimate of {result.selected}"
    yield section(
        "Velocity before and after correction",
        Sentence(by + (NO_RESIDUALS if run.navigation is None else RESIDUALS), soft=True),
        figures("replay_figures.velocity_pictures", run, history),
        where=Where.PAGE,
    )


def next_commands(
    run: Replayed, bags: Sequence[Path], saved: Path | None, options: Sequence[str], doubts: bool
) -> list[str]:
    """Return the commands to type next, in order. options: options of this run that the next one needs."""
    verification = run.result.verifications[run.result.selected]
    if verification.verdict is Severity.REJECT:
        apart = any(reason.code.startswith("BAGS_") for reason in verification.reasons)
        apart |= run.recordings is not None and bool(run.recordings.moved)
        found, doctor = (typed(command, bags, *options) for command in ("compare" if apart else "diagnose", "doctor"))
        return [found, doctor] if apart else [doctor, found]
    if saved is None:
        return [typed("replay", bags, *options, "--save", "calibration.yaml")]
    commands = [typed("apply", [saved], "--urdf", "robot.urdf")]
    return commands + ([typed("doctor", bags, *options)] if doubts else [])


# Error terms in displayed units, and the models' estimates of them.


class Term(NamedTuple):
    """Displayed error term. row: index in φ (3) and δk (3). factor: from SI."""

    row: int
    name: str
    in_words: str
    unit: str
    factor: float


_DEGREE = math.degrees(1.0)
ANGLES = tuple(Term(k, f"φ{axis}", f"Misalignment about {axis}", "°", _DEGREE) for k, axis in enumerate("xyz"))
SCALES = tuple(Term(3 + k, f"δk {axis}", f"Scale error along {axis}", " %", 100.0) for k, axis in enumerate("xyz"))
ANY_SCALE = Term(3, "δk", "Scale error", " %", 100.0)


def state_of(model: Model, term: Term) -> int:
    """Return the index of the state of an error term."""
    return int(np.argmax(model.error_terms_from_state[term.row]))


def scale_terms(model: Model) -> list[Term]:
    """Return the scale terms with their own state: a common δk, or one per axis."""
    terms = [term for term in SCALES if model.error_terms_from_state[term.row].any()]
    if len(terms) == 3 and len({state_of(model, term) for term in terms}) == 1:
        return [ANY_SCALE._replace(in_words="Scale error, all axes")]
    return terms


def terms_of(models: Sequence[str]) -> tuple[Term, ...]:
    """Return the error terms of some models: one for the scale, or one per axis if a model has several."""
    per_axis = any(len(scale_terms(MODELS[name])) > 1 for name in models)
    return *ANGLES, *(SCALES if per_axis else (ANY_SCALE,))


def estimate_table(result: Result, models: Sequence[str]) -> Table:
    """Return one row per model, the selected one marked."""
    terms = terms_of(models)
    rows = []
    for name in models:
        estimate = result.estimates[name]
        nis = f"{estimate.mean_nis / MODELS[name].n_measurement:.2f}" if estimate.used else "–"
        cells = _cells(estimate, terms)
        rows.append((name, *cells, str(estimate.used), str(estimate.gated), nis, estimate.convergence.value))
    return Table(
        ("model", *(f"{term.name}, {term.unit.strip()}" for term in terms), "used", "gated", "NIS/m", "convergence"),
        rows,
        marked=list(models).index(result.selected),
        dense=True,
        notes=(
            "± is the model's 1σ; ? is not observable in this data; – is not estimated. φ and δk are "
            "in the DVL's frame. NIS/m: mean normalised innovation squared per measured component, about 1 when the "
            "noise is as assumed, above when σ is too small.",
        ),
    )


def _cells(estimate: Estimate, terms: Sequence[Term]) -> list[str]:
    """Return error terms with ±1σ; – if the model has none, ? if not observable."""
    model = MODELS[estimate.model]
    of_state = model.error_terms_from_state
    value, std = of_state @ estimate.state, np.sqrt(np.diag(of_state @ estimate.covariance @ of_state.T))
    estimated = np.asarray(of_state.any(axis=1))
    cells = []
    for term in terms:
        if not estimated[term.row]:
            cells.append("–")
            continue
        mark = "" if estimate.observability[state_of(model, term)].observed else " ?"
        is_one = model.scale_axes and term is ANY_SCALE and not estimated[4:].any()
        axis = " (x)" if is_one else ""
        cells.append(with_std(*(term.factor * each[term.row] for each in (value, std)), signed=True) + axis + mark)
    return cells
