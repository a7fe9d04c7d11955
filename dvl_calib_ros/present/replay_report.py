"""The report of a replay: `dvl-calib replay --report out.html`.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..calibration.frames import Array
from ..calibration.models import MODELS, Model
from ..calibration.parameters import Parameters
from ..calibration.quantities import quantities
from ..calibration.results import Estimate, Result
from ..calibration.samples import VelocityFrame
from ..calibration.verification import HeldOutError, Verification
from ..files.result_file import result_document
from ..replay.navigation import Navigation, metres
from ..replay.recorder import ModelHistory, RunHistory
from ..replay.replay import Replayed
from ..verdict.kinds import Severity
from . import replay_figures as figures
from .document import Cell, Table, parameter_texts, signed
from .mounting_figures import mounting_pictures
from .navigation_figures import navigation_section
from .page import VERDICT_KINDS, write_page
from .style import Picture, picture
from .time_axis import TimeAxis, fitting_unit

EARTH = (VelocityFrame.ENU, VelocityFrame.NED)


class Term(NamedTuple):
    """An error term as people read it. row: of φ (3) and δk (3). factor: from SI."""

    row: int
    name: str
    in_words: str
    unit: str
    factor: float


_DEGREE = math.degrees(1.0)
ANGLES = (
    Term(0, "φx", "Misalignment about x", "°", _DEGREE),
    Term(1, "φy", "Misalignment about y", "°", _DEGREE),
    Term(2, "φz", "Misalignment about z", "°", _DEGREE),
)
SCALES = (
    Term(3, "δk x", "Scale error along x", " %", 100.0),
    Term(4, "δk y", "Scale error along y", " %", 100.0),
    Term(5, "δk z", "Scale error along z", " %", 100.0),
)
_ANY_SCALE = Term(3, "δk", "Scale error", " %", 100.0)
# Which way is plus, for who mounts it
_AXES = {
    "scale": "scale of motion ahead",
    "lever arm x": "lever arm, ahead",
    "lever arm y": "lever arm, to port",
    "lever arm z": "lever arm, up",
}
BODY_AXES = ("ahead", "to port", "up")
FAMILIES = ((True, "Models with GNSS"), (False, "Models without GNSS"))


def write_replay_report(path: Path, replayed: Replayed, bags: Sequence[Path], models: Sequence[str]) -> None:
    """Write the report of a replay that was run with a history.

    bags: what was replayed. models: names to show; the selected one is always among them. Raises InputError if the
    file cannot be written.
    """
    write_page(path, "replay.html", _context(replayed, bags, models))


def _context(replayed: Replayed, bags: Sequence[Path], models: Sequence[str]) -> dict[str, Any]:
    result, history = replayed.result, replayed.history
    if history is None:
        raise ValueError("the replay has no history; run it with with_history=True")
    shown = [name for name in MODELS if name in models or name == result.selected]
    document = result_document(result, replayed.dvl_frame, replayed.turned)
    time = TimeAxis(history.stamps_ns)
    names = ", ".join(bag.name or str(bag) for bag in bags)
    verification = result.verifications.get(result.selected)
    rejected = verification is not None and verification.verdict is Severity.REJECT
    others = tuple(f"{name}: " for name in result.estimates if name != result.selected)
    notes = [note for note in replayed.notes if not note.startswith(others)]
    return {
        "title": "DVL calibration",
        "subtitle": names,
        "written": document["written"].replace("T", " ").replace("+00:00", " UTC"),
        "verdict": _verdict(verification),
        "drift": None if rejected else _drift(replayed.navigation),
        "numbers": [] if rejected else _numbers(result),
        "mounting": [] if rejected else mounting_pictures(result),
        "facts": _facts(replayed, bags),
        "static_transform": None if rejected else document["mounting"]["static_transform_publisher"],
        "warnings": notes,
        "other_warnings": [note for note in replayed.notes if note not in notes],
        "held_out": _held_out(result, shown),
        "navigation": navigation_section(replayed.navigation, time),
        "estimates": _estimate_table(result, shown),
        "families": list(_families(result, history, time, shown)),
        "selected": result.selected,
        "velocities": _velocities(replayed, history, time),
        "velocity_note": _velocity_note(replayed),
        "streams": _stream_table(result),
        "data_pictures": _data_pictures(result, history, time, shown),
        "parameters": parameter_texts(result.parameters),
    }


# ------------------------------------------------------------------ summary


def _error_terms(estimate: Estimate) -> tuple[Array, Array, NDArray[np.bool_]]:
    """φ (3) and δk (3) with their standard deviations, and which of them the model estimates; each (6,)."""
    terms = MODELS[estimate.model].error_terms_from_state
    variance = np.diag(terms @ estimate.covariance @ terms.T)
    return terms @ estimate.state, np.sqrt(variance), np.asarray(terms.any(axis=1))


def _state_of(model: Model, term: Term) -> int:
    """Index of the state that an error term comes from."""
    return int(np.argmax(model.error_terms_from_state[term.row]))


def _scale_terms(model: Model) -> list[Term]:
    """The scale terms that are a state of their own: δk if one stands for all axes, else each axis of its own."""
    terms = [term for term in SCALES if model.error_terms_from_state[term.row].any()]
    if len(terms) == 3 and len({_state_of(model, term) for term in terms}) == 1:
        return [_ANY_SCALE._replace(in_words="Scale error, all axes")]
    return terms


def _numbers(result: Result) -> list[dict[str, str]]:
    """What the selected model found, large, as the DVL is mounted."""
    return [
        {
            "name": _AXES.get(each.name, each.name),
            "value": each.in_unit(each.value, signed=True).replace("-", "−"),
            "std": f"± {each.in_unit(each.std)} (1σ)",
            "note": "" if each.shown else "not shown by this data",
            "nominal": f"configured {each.in_unit(each.nominal).replace('-', '−')}",
        }
        for each in quantities(result)
    ]


def _drift(navigation: Navigation | None) -> dict[str, str] | None:
    """What the calibration is worth, the largest of all."""
    if navigation is None:
        return None
    before, after = (metres(each.per_km) for each in (navigation.before, navigation.after))
    return {"before": before, "after": after}


def _facts(replayed: Replayed, bags: Sequence[Path]) -> list[tuple[str, str]]:
    result = replayed.result
    dvl, pairing = result.counts["dvl"], result.counts["pairing"]
    estimate = result.estimate
    missing = [f"{entry.axis}: shown by {entry.missing}" for entry in estimate.observability if entry.missing]
    return [
        ("Model", f"{result.selected} ({result.selected_because}); {estimate.convergence.value}"),
        *([("Angles", "against the IMU's heading and level")] if replayed.reference_frame in EARTH else []),
        ("Recorded", _when(result)),
        ("DVL data", replayed.dvl_data),
        ("Samples", f"{dvl['accepted']} of the DVL, {pairing['paired']} of them paired with GNSS"),
        ("Used by " + result.selected, f"{estimate.used}, {estimate.gated} gated"),
        *([("Not shown yet", "; ".join(dict.fromkeys(missing)))] if missing else []),
        ("Bags", ", ".join(map(str, bags))),
    ]


def _when(result: Result) -> str:
    if result.first_ns is None or result.last_ns is None:
        return "nothing"
    seconds = (result.last_ns - result.first_ns) * 1e-9
    unit_s, unit = fitting_unit(seconds)
    duration = f"{seconds / unit_s:.1f} {unit}"
    return f"{_utc(result.first_ns)} to {_utc(result.last_ns)} UTC, {duration}"


def _utc(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns // 1_000_000_000, timezone.utc).strftime("%Y-%m-%d %H:%M:%S")


def _verdict(verification: Verification | None) -> dict[str, Any]:
    """Word and reasons on the selected model, large."""
    if verification is None:
        return {"word": "not verified", "reasons": ("nothing was held back to verify the calibration on",)}
    return {"word": verification.verdict.value, "reasons": [each.sentence for each in verification.reasons]}


def _held_out(result: Result, shown: Sequence[str]) -> dict[str, Any] | None:
    """What each model's correction did to data that it had not seen."""
    verifications = {name: result.verifications[name] for name in shown if name in result.verifications}
    judged = {name: each.held_out for name, each in verifications.items() if each.held_out is not None}
    if not judged:
        return None
    rows: list[tuple[str | Cell, ...]] = [
        (name, *_held_out_cells(judged.get(name)), Cell(each.verdict.value, VERDICT_KINDS[each.verdict.value]))
        for name, each in verifications.items()
    ]
    kinds = ("uncorrected", "corrected", "predicted")
    errors = [np.array([getattr(error, kind) for error in judged.values()]) for kind in kinds]
    alt = "; ".join(f"{name}: {e.uncorrected:.3f} to {e.corrected:.3f} m/s" for name, e in judged.items())
    return {
        "table": Table(
            ("model", *kinds, "samples", "verdict"), rows, marked=list(verifications).index(result.selected)
        ),
        "pictures": [
            picture("Velocity error on held-out data", alt, figures.held_out_errors, list(judged), *errors),
        ],
    }


def _held_out_cells(error: HeldOutError | None) -> tuple[str, ...]:
    if error is None:
        return ("–", "–", "–", "0")
    return (f"{error.uncorrected:.4f}", f"{error.corrected:.4f}", f"{error.predicted:.4f}", str(error.samples))


# ------------------------------------------------------------------ estimates


def _estimate_table(result: Result, shown: Sequence[str]) -> Table:
    per_axis = any(len(_scale_terms(MODELS[name])) > 1 for name in shown)
    terms = (*ANGLES, *(SCALES if per_axis else (_ANY_SCALE,)))
    rows = []
    for name in shown:
        estimate = result.estimates[name]
        model = MODELS[name]
        value, std, estimated = _error_terms(estimate)
        cells = []
        for term in terms:
            if not estimated[term.row]:
                cells.append("–")
                continue
            mark = "" if estimate.observability[_state_of(model, term)].observed else " ?"
            axis = " (x)" if model.scale_axes and term.row == 3 and not (per_axis or estimated[4:].any()) else ""
            cells.append(f"{signed(term.factor * value[term.row])} ± {term.factor * std[term.row]:.2f}{axis}{mark}")
        nis = f"{estimate.mean_nis / model.n_measurement:.2f}" if estimate.used else "–"
        rows.append((name, *cells, str(estimate.used), str(estimate.gated), nis, estimate.convergence.value))
    return Table(
        ("model", *(f"{term.name}, {term.unit.strip()}" for term in terms), "used", "gated", "NIS/m", "convergence"),
        rows,
        marked=list(shown).index(result.selected),
        dense=True,
        notes=(
            "± is 1σ as the model believes it; ? marks what this data does not show; – is not estimated. φ and δk are "
            "in the DVL's frame. NIS/m: mean normalised innovation squared per measured component, about 1 when the "
            "noise is as assumed, above when σ is too small.",
        ),
    )


def _families(result: Result, history: RunHistory, time: TimeAxis, shown: Sequence[str]) -> Iterable[dict[str, Any]]:
    """Estimates over time and innovations, for the models with GNSS and for those without."""
    for aided, title in FAMILIES:
        models = [name for name in shown if MODELS[name].aided == aided and result.estimates[name].used]
        if models:
            pictures = list(_estimate_pictures(result, history, time, models))
            yield {"title": title, "models": models, "pictures": pictures}


def _estimate_pictures(result: Result, history: RunHistory, time: TimeAxis, models: Sequence[str]) -> Iterable[Picture]:
    for term in (*ANGLES, *_scales_shown(models)):
        lines = [
            _line(name, history.models[name], term)
            for name in models
            if MODELS[name].error_terms_from_state[term.row].any()
        ]
        if lines:
            final = ", ".join(f"{line.model} {line.value[-1]:+.2f} ± {line.std[-1]:.2f}" for line in lines)
            yield picture(
                f"{term.in_words} ± 1σ", f"{term.name} over time; at the end, in {term.unit.strip()}: {final}",
                figures.estimate_over_time, time, history.stamps_ns, lines, result.selected,
                f"{term.name}, {term.unit.strip()}",
            )  # fmt: skip
    nis = {name: history.models[name].nis for name in models}
    yield picture(
        "Innovations (NIS)", "Mean normalised innovation squared over time; 1 is expected",
        figures.innovations_over_time, time, history.stamps_ns, nis, result.selected,
        caption="Running mean. The line at 1 is what the model expects: above it the σ is too small, below too large.",
    )  # fmt: skip


def _scales_shown(models: Sequence[str]) -> list[Term]:
    """One figure for the scale; one for each axis if a model has more than one scale error."""
    if any(len(_scale_terms(MODELS[name])) > 1 for name in models):
        return list(SCALES)
    return [_ANY_SCALE]


def _line(name: str, history: ModelHistory, term: Term) -> figures.Line:
    index = _state_of(MODELS[name], term)
    return figures.Line(name, term.factor * history.state[:, index], term.factor * history.std[:, index])


# ------------------------------------------------------------------ velocity


def _velocities(replayed: Replayed, history: RunHistory, time: TimeAxis) -> list[Picture]:
    """Velocity and, with a reference, residual, per body axis."""
    t = Parameters.from_mapping(replayed.result.parameters).rotation_dvl_from_body
    correction = replayed.result.estimate
    before, after = history.dvl_velocity @ t, correction.corrected_velocity(history.dvl_velocity, t)
    pictures = [
        picture(
            f"Velocity {where}", f"DVL velocity {where} before and after correction, and the reference, m/s",
            figures.velocity_over_time, time, history.dvl_ns, before[:, axis], after[:, axis], history.paired_ns,
            history.reference_velocity[:, axis], f"velocity {where}, m/s",
        )
        for axis, where in enumerate(BODY_AXES)
    ]  # fmt: skip
    navigation = replayed.navigation
    if navigation is not None:
        pictures += [
            picture(
                f"Residual {where}", f"DVL minus GNSS {where}, before and after correction, m/s",
                figures.residual_over_time, time, navigation.stamps_ns, -navigation.error_before[:, axis],
                -navigation.error_after[:, axis], f"DVL − GNSS {where}, m/s",
            )
            for axis, where in enumerate(BODY_AXES)
        ]  # fmt: skip
    return pictures


def _velocity_note(replayed: Replayed) -> str:
    estimate = replayed.result.estimate
    turned = f"Body frame. Velocities are of the DVL's own place, corrected with the final estimate of {estimate.model}"
    if replayed.navigation is None:
        return f"{turned}. No reference is beside enough of them for residuals."
    return (
        f"{turned}; residuals are at the reference point, corrected by estimates that had not seen the data, with all "
        "that was found, lever arm and delay too. The noise of the reference is in them. Lines are running means."
    )


# ------------------------------------------------------------------ data


_STREAMS = (("dvl", "DVL"), ("reference", "GNSS velocity"), ("imu", "IMU"), ("pairing", "pairing of DVL and GNSS"))


def _stream_table(result: Result) -> Table:
    rows = []
    for key, name in _STREAMS:
        counts = result.counts[key]
        rest = [f"{value} {what.replace('_', ' ')}" for what, value in counts.items() if value and what != "received"]
        rows.append((name, str(counts.get("received", "–")), Cell(", ".join(rest) or "–", "text")))
    return Table(("stream", "received", Cell("of which", "text")), rows)


def _data_pictures(result: Result, history: RunHistory, time: TimeAxis, shown: Sequence[str]) -> list[Picture]:
    fates = _fates(result, shown)
    ends = [*(segment.from_ns for segment in result.segments[1:]), result.last_ns]
    segments = [(each.model, each.from_ns, end) for each, end in zip(result.segments, ends, strict=False)]
    switches = ", ".join(dict.fromkeys(name for name, _, _ in segments)) or "none"
    return [
        picture(
            "Samples by model", "How many DVL samples each model used, gated or was not given",
            figures.samples_by_fate, list(shown), fates,
            caption="Not given: without the GNSS velocity or attitude it needs, or in the window of its prior.",
        ),
        picture(
            "Selected model and GNSS", f"Which model was selected over time: {switches}; and when GNSS was there",
            figures.selection_over_time, time, segments, history.stamps_ns, history.paired_share,
            caption="GNSS: dark where DVL samples had a GNSS velocity beside them.",
        ),
    ]  # fmt: skip


def _fates(result: Result, shown: Sequence[str]) -> dict[str, list[int]]:
    dvl = result.counts["dvl"]
    fates: dict[str, list[int]] = {"used": [], "gated": [], "not given": [], "slow or turning": []}
    for name in shown:
        estimate = result.estimates[name]
        fates["used"].append(estimate.used)
        fates["gated"].append(estimate.gated)
        fates["not given"].append(max(0, dvl["usable"] - estimate.used - estimate.gated))
        fates["slow or turning"].append(dvl["slow"] + dvl["turning"] + dvl["no_turn_rate"])
    return fates
