"""What a replay says: what to do with the calibration, the mounting found, what it is worth, and what to type next.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from ..calibration.frames import FLU_FROM_FRD, rpy_from_rotation
from ..calibration.models import MODELS
from ..calibration.navigation import in_words, metres
from ..calibration.parameters import Parameters
from ..calibration.quantities import quantities
from ..calibration.results import Result
from ..calibration.samples import VelocityFrame
from ..calibration.verification import Verification
from ..files.result_file import result_document
from ..files.urdf import origin_tag
from ..replay.recorder import RunHistory
from ..replay.replay import Replayed
from ..verdict.kinds import Severity
from .document import (
    CELL_KINDS,
    Answer,
    Cell,
    Columns,
    Commands,
    Document,
    Facts,
    Item,
    Legend,
    Map,
    Number,
    Numbers,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    Worth,
    figures,
    fitting_unit,
    parameter_texts,
    table_by,
)
from .terms import estimate_table
from .typed import typed

# What the verdict's word asks of the reader.
ADVICE = {
    Severity.ACCEPT: "Use this calibration.",
    Severity.MARGINAL: "Use this calibration with care.",
    Severity.REJECT: "Do not use this calibration.",
}
EARTH = (VelocityFrame.ENU, VelocityFrame.NED)
FAMILIES = ((True, "Models with GNSS"), (False, "Models without GNSS"))
# Which way is plus, for who mounts it
_AXES = {
    "scale": "scale of motion ahead",
    "lever arm x": "lever arm, ahead",
    "lever arm y": "lever arm, to port",
    "lever arm z": "lever arm, up",
}


HELD_OUT: Columns[Verification] = {
    "model": lambda each: each.model,
    "uncorrected": lambda each: "–" if each.held_out is None else f"{each.held_out.uncorrected:.4f}",
    "corrected": lambda each: "–" if each.held_out is None else f"{each.held_out.corrected:.4f}",
    "predicted": lambda each: "–" if each.held_out is None else f"{each.held_out.predicted:.4f}",
    "samples": lambda each: "0" if each.held_out is None else str(each.held_out.samples),
    "verdict": lambda each: Cell(each.verdict.value, CELL_KINDS[each.verdict]),
}


def replayed(
    run: Replayed,
    bags: Sequence[Path],
    models: Sequence[str],
    *,
    details: bool = False,
    warnings: Sequence[str] | None = None,
    commands: Sequence[str] = (),
) -> Document:
    """The answer of a replay.

    Parameters
    ----------
    run
        The replay; a page has its pictures if it was run with a history.
    bags
        What was replayed.
    models
        Names to show; the selected one is always among them.
    details
        Whether a terminal shows the models and the counts as well.
    warnings
        What to warn of; None for all notes, those of models that were not chosen folded away.
    commands
        What to type next.

    """
    result = run.result
    shown = [name for name in MODELS if name in models or name == result.selected]
    verification = result.verifications.get(result.selected)
    rejected = verification is not None and verification.verdict is Severity.REJECT
    others = tuple(f"{name}: " for name in result.estimates if name != result.selected)
    first = next((each for each in run.findings if each.code == "BAG_NO_IMU"), None)
    notes = [note for note in run.notes if first is None or note != str(first)]
    own = [note for note in notes if not note.startswith(others)] if warnings is None else warnings
    where = Where.BOTH if details else Where.PAGE
    history = run.history
    velocities: list[Item] = []
    data: list[Item] = []
    if history is not None:
        drawn = figures("replay_pictures.velocity_pictures", run, history)
        velocities = [Sentence(_velocity_note(run), soft=True), drawn]
        data = [figures("replay_pictures.data_pictures", result, history, shown)]
    dvl, pairing = result.counts["dvl"], result.counts["pairing"]
    counted = [
        ("selected", f"{result.selected} ({result.selected_because.sentence})"),
        ("dvl data", run.dvl_data),
        ("samples", f"{dvl['accepted']} of the DVL, {pairing['paired']} with a reference velocity at their time"),
    ]
    drift = run.navigation
    worth = [] if drift is None else [Worth(metres(drift.before.per_km), metres(drift.after.per_km))]
    said = [
        Sentence(f"? {axes}: not shown by this recording; it needs {lacks}")
        for lacks, axes in not_shown(result).items()
    ]
    # an angle that the data do not show is none to put on a vehicle
    is_shown = not rejected and any(each.shown for each in quantities(result)[:3])
    return Document(
        title="DVL calibration",
        subtitle=", ".join(bag.name or str(bag) for bag in bags),
        answer=_answer(verification),
        warnings=own,
        sections=[
            Section("", worth if not rejected else [], Where.PAGE),
            Section(_headline(run, rejected), _mounting(run, rejected)),
            Section("", [] if rejected else [figures("mounting_figures.mounting_pictures", result)], Where.PAGE),
            Section("", [Facts(_facts(run, bags))], Where.PAGE),
            Section("", [Sentence("Corrected mounting, ready to paste:", soft=True)] if is_shown else [], Where.PAGE),
            Section("", [_paste(run)] if is_shown else []),
            Section("", [Warned()], Where.PAGE),
            Section("What it means for navigation", _navigation(run)),
            Section("", said, Where.TERMINAL),
            Section(
                "",
                [Commands([("next" if not k else "", each) for k, each in enumerate(commands)])] if commands else [],
                Where.TERMINAL,
            ),
            Section("Held-out verification", _held_out(result, shown), Where.PAGE),
            Section("Estimates", [estimate_table(result, shown)], where),
            *_families(result, history, shown),
            Section("Velocity before and after correction", velocities, Where.PAGE),
            Section("Data", [Facts(counted)] if details else [], Where.TERMINAL),
            Section("" if details else "Data", [_stream_table(result)], where),
            Section("", data, Where.PAGE),
        ],
        parameters=parameter_texts(result.parameters),
        lead=first,
        folded=[note for note in run.notes if note.startswith(others)] if warnings is None else (),
    )


def _answer(verification: Verification | None) -> Answer:
    if verification is None:
        return Answer("not verified", Severity.MARGINAL, ["Nothing was held back to verify the calibration on."])
    reasons = [*verification.reasons, *([verification.mounting] if verification.mounting is not None else [])]
    said = [each.full_sentence for each in reasons]
    return Answer(verification.verdict.value, verification.verdict, said, ADVICE[verification.verdict])


def _headline(run: Replayed, rejected: bool) -> str:
    """By how much the mounting is off, by which model, from how much data; after a reject no mounting."""
    result = run.result
    seconds = 1e-9 * ((result.last_ns or 0) - (result.first_ns or 0)) - run.pause_s
    data = f"(model {result.selected}, {seconds:.0f} s of data)"
    if rejected:
        return f"Not to be used: no mounting is given {data}"
    parameters = Parameters.from_mapping(result.parameters)
    turn = parameters.rotation_dvl_from_body @ result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    angle = math.degrees(math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(turn)) - 1.0)))))
    return f"The DVL is turned by {angle:.2f}° from its nominal place in {parameters.base_frame} {data}"


def _mounting(run: Replayed, rejected: bool) -> list[Item]:
    numbers = Numbers(
        [
            Number(
                _AXES.get(each.name, each.name),
                each.in_unit(each.value, signed=True),
                each.in_unit(each.std),
                each.in_unit(each.nominal),
                "" if each.shown else "not shown by this data",
                each.shown,
            )
            for each in quantities(run.result)
        ],
        is_valid=not rejected,
    )
    return [numbers, *([Sentence(against)] if (against := _against(run)) and not rejected else [])]


def _against(run: Replayed) -> str:
    """What the angles are measured against, whose own error no data of this kind tell from the DVL's."""
    if not MODELS[run.result.selected].aided:
        return (
            "Without a reference the angles are relative to the direction of travel: a constant sideslip looks like "
            "yaw, and driving astern looks like a DVL turned by 180°."
        )
    if run.reference_frame in EARTH:
        return (
            "Angles are relative to the IMU: a constant error of its heading is in the yaw, one of its level in roll "
            "and pitch. Both are harmless as long as the same IMU is used."
        )
    return ""


def _paste(run: Replayed) -> Commands:
    """The corrected mounting as a URDF joint's origin, of forward-right-down data with both axes, and for tf2."""
    result = run.result
    parameters = Parameters.from_mapping(result.parameters)
    rotation = result.estimate.rotation_body_from_dvl(parameters.rotation_dvl_from_body)
    arm = result.position_in_body
    tag = origin_tag(arm, rpy_from_rotation(rotation))
    lines = [("URDF", tag)]
    if run.turned:
        own = origin_tag(arm, rpy_from_rotation(rotation @ FLU_FROM_FRD))
        lines = [
            ("URDF", f"{tag}  (forward-left-up axes)"),
            ("", f"{own}  ({run.dvl_frame} of the driver: forward-right-down)"),
        ]
    static = result_document(result, run.dvl_frame, run.turned)["mounting"]["static_transform_publisher"]
    return Commands(lines, on_page=[("tf", static)] if static else [])


def _navigation(run: Replayed) -> list[Item]:
    navigation = run.navigation
    if navigation is None:
        return []

    history = run.history
    pictures = [] if history is None else [figures("replay_pictures.navigation", navigation, history)]
    return [*map(Sentence, in_words(navigation)), *([Map(navigation)] if navigation.on_a_map else []), *pictures]


def not_shown(result: Result) -> dict[str, str]:
    """The axes that the data do not show, by what they lack.

    An angle is that about an axis of the vehicle, and says so where the DVL's own angle of the same name is shown: of a
    DVL that is mounted across, the vehicle's roll is the DVL's pitch.
    """
    shown = {each.name for each in quantities(result) if each.shown}
    causes: dict[str, dict[str, None]] = {}
    for entry in result.estimate.observability:
        if entry.missing:
            axis = f"the vehicle's {entry.axis} axis" if entry.axis in shown else entry.axis
            causes.setdefault(entry.missing, {})[axis] = None
    return {missing: " and ".join(axes) for missing, axes in causes.items()}


def _facts(run: Replayed, bags: Sequence[Path]) -> list[tuple[str, str]]:
    result = run.result
    dvl, pairing = result.counts["dvl"], result.counts["pairing"]
    estimate = result.estimate
    missing = [f"{axes}: shown by {lacking}" for lacking, axes in not_shown(result).items()]
    used = "references" if MODELS[result.selected].estimator else "DVL samples"
    return [
        ("Model", f"{result.selected} ({result.selected_because.sentence}); {estimate.convergence.value}"),
        *([("Angles", "against the IMU's heading and level")] if run.reference_frame in EARTH else []),
        ("Recorded", _when(result)),
        ("DVL data", run.dvl_data),
        ("Samples", f"{dvl['accepted']} of the DVL, {pairing['paired']} of them paired with GNSS"),
        ("Used by " + result.selected, f"{estimate.used} {used}, {estimate.gated} rejected as outliers"),
        *([("Not shown yet", "; ".join(missing))] if missing else []),
        ("Bags", ", ".join(map(str, bags))),
    ]


def _when(result: Result) -> str:
    if result.first_ns is None or result.last_ns is None:
        return "nothing"
    seconds = (result.last_ns - result.first_ns) * 1e-9
    unit_s, unit = fitting_unit(seconds)
    duration = f"{seconds / unit_s:.1f} {unit}"
    first, last = (datetime.fromtimestamp(ns // 10**9, timezone.utc) for ns in (result.first_ns, result.last_ns))
    return f"{first:%Y-%m-%d %H:%M:%S} to {last:%Y-%m-%d %H:%M:%S} UTC, {duration}"


def _held_out(result: Result, shown: Sequence[str]) -> list[Item]:
    """What each model's correction did to data that it had not seen."""
    verifications = {name: result.verifications[name] for name in shown if name in result.verifications}
    judged = {name: each.held_out for name, each in verifications.items() if each.held_out is not None}
    if not judged:
        return []

    return [
        Sentence(
            "Each block of the run was held back in turn and corrected with a calibration that had not seen it. "
            "Velocity error against the reference, m/s rms, with the noise of the reference in all of them; predicted "
            "is what that noise and the uncertainty of the calibration lead one to expect."
        ),
        replace(table_by(HELD_OUT, verifications.values()), marked=list(verifications).index(result.selected)),
        figures("replay_pictures.held_out_picture", judged),
    ]


def _families(result: Result, history: RunHistory | None, shown: Sequence[str]) -> list[Section]:
    """Estimates over time and innovations, for the models with GNSS and for those without."""
    sections = []
    for aided, title in FAMILIES:
        models = [name for name in shown if MODELS[name].aided == aided and result.estimates[name].used]
        if models and history is not None:
            drawn = figures("replay_pictures.estimate_pictures", result, history, models)
            sections.append(Section(title, [Legend(models, result.selected), drawn], Where.PAGE))
    return sections


def _velocity_note(run: Replayed) -> str:
    estimate = run.result.estimate
    turned = f"Body frame. Velocities are of the DVL's own place, corrected with the final estimate of {estimate.model}"
    if run.navigation is None:
        return f"{turned}. No reference is beside enough of them for residuals."
    return (
        f"{turned}; residuals are at the reference point, corrected by estimates that had not seen the data, with all "
        "that was found, lever arm and delay too. The noise of the reference is in them. Lines are running means."
    )


_STREAMS = (("dvl", "DVL"), ("reference", "GNSS velocity"), ("imu", "IMU"), ("pairing", "pairing of DVL and GNSS"))


def _stream_table(result: Result) -> Table:
    rows = []
    for key, name in _STREAMS:
        counts = result.counts[key]
        rest = [f"{value} {what.replace('_', ' ')}" for what, value in counts.items() if value and what != "received"]
        rows.append((name, str(counts.get("received", "–")), Cell(", ".join(rest) or "–", "text")))
    return Table(("", "received", Cell("of which", "text")), rows)


def next_commands(
    run: Replayed, bags: Sequence[Path], saved: Path | None, options: Sequence[str], doubts: bool
) -> list[str]:
    """What to type next, in order. options: of this run, which the next needs as well."""
    verdict = run.result.verifications[run.result.selected].verdict
    if verdict is Severity.REJECT:
        moved = run.recordings is not None and run.recordings.moved
        found, doctor = typed("compare" if moved else "diagnose", bags, *options), typed("doctor", bags)
        return [found, doctor] if moved else [doctor, found]
    if saved is None:
        return [typed("replay", bags, *options, "--save", "calibration.yaml")]
    commands = [typed("apply", [saved], "--urdf", "robot.urdf")]
    return commands + ([typed("doctor", bags)] if doubts else [])
