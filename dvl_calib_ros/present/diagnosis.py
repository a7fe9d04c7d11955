"""What a diagnosis says.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math

import numpy as np

from ..diagnosis.clock_or_arm import Combination
from ..diagnosis.noise_findings import NoiseFinding
from ..diagnosis.results import Diagnosis, FoundEffect
from ..diagnosis.series import DiagnosisSeries
from ..diagnosis.where import GapPlace
from ..effects.registry import EFFECTS
from .document import (
    Answer,
    Cell,
    Columns,
    Document,
    Facts,
    Item,
    Number,
    Numbers,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    figures,
    intervals,
    p_value,
    share,
    table_by,
    three,
    with_std,
)
from .twin_table import twin_table

BODY_AXES = {"x": "ahead", "y": "to port", "z": "up"}
NOISE_MEANING = {
    "outliers": "samples far outside the noise, as a share",
    "stale_samples": "samples that repeat the one before, as a share",
    "noise_inflation": "the noise is larger than reported, or grows with speed or turn rate",
    "reported_covariance": "how the noise follows covariances that differ by sample: 1 as claimed, 0 not at all",
    "coloured_reference_noise": "the noise has a memory",
}
MAX_PLACES = 12
PLACES = "Share: of the gap's energy. Places overlap: only the axes over all of the run add up."
EFFECTS_NOTE = (
    "The calibration is refitted with every effect. p is adjusted for all effects that were tried. Of names joined by "
    "“or”, the parameters are those of the first."
)
WHERE: Columns[GapPlace] = {
    "axis": lambda place: f"{place.axis} ({BODY_AXES[place.axis]})",
    "regime": lambda place: place.regime,
    "time, s": lambda place: "{:.0f} to {:.0f}".format(*place.segment_s),
    "band, Hz": lambda place: "{:.2g} to {:.2g}".format(*place.band_hz),
    "share": lambda place: share(place.share),
    "p, adjusted": lambda place: p_value(place.p),
}
FOUND: Columns[FoundEffect] = {
    "effect": lambda effect: " or ".join((effect.name, *effect.equivalent_to)),
    "closes alone": lambda effect: share(effect.closure),
    "p, adjusted": lambda effect: p_value(effect.p),
    "parameters (95 %)": lambda effect: Cell(intervals(effect.parameters, _units(effect.name)), "text"),
}
NEEDS: Columns[tuple[str, str]] = {"not testable": lambda each: each[0], "needs": lambda each: Cell(each[1], "text")}
NOISE: Columns[NoiseFinding] = {
    "finding": lambda found: found.name,
    "meaning": lambda found: Cell(NOISE_MEANING.get(found.name, ""), "text"),
    "parameters (95 %)": lambda found: Cell(intervals(found.parameters), "text"),
    "p, adjusted": lambda found: p_value(found.p),
}


def _combined(known: Combination) -> str:
    """What is known of a lever arm and a clock together."""
    value, low, high = known.value
    sign = "-" if known.speed > 0.0 else "+"
    return (
        f"Known of both is lever_arm {known.parameter} {sign} {abs(known.speed):.2f} m/s · {known.clock} = "
        f"{value:.2f} m ({low:.2f} to {high:.2f})."
    )


def diagnosis(d: Diagnosis) -> Document:
    """Where the DVL differs from what calibration leads to expect, which effect makes it, and what cannot be told."""
    found = [
        f"{' or '.join((e.name, *e.equivalent_to))}: {intervals(e.parameters, _units(e.name))}." for e in d.effects
    ]
    untestable = [table_by(NEEDS, d.untestable.items())] if d.untestable else []
    detectable = [_detectable_table(d)] if d.minimum_detectable else []
    following = Sentence(f"Next: {d.next_manoeuvre}.")
    series = d.series
    followed = (
        [figures("twin_section.followed_picture", series.followed, _axes(series))] if series and series.followed else []
    )
    more = [f"The first {MAX_PLACES} of {len(d.where)} places; --json holds all."] if len(d.where) > MAX_PLACES else []
    of_each = [
        (effect.name, recording, intervals(parameters, _units(effect.name)))
        for effect in d.effects
        for recording, parameters in effect.by_recording.items()
    ]
    cannot = "This data cannot tell {} from {}; each explains it as well."
    alike = [Sentence(cannot.format(e.name, " or ".join(e.equivalent_to))) for e in d.effects if e.equivalent_to]
    alike += [Sentence(_combined(e.combination)) for e in d.effects if e.combination is not None]
    has_closure = bool(d.effects) and math.isfinite(d.gap.closure)
    return Document(
        title="Sim-to-real gap of the DVL",
        subtitle="" if d.series is None else ", ".join(d.series.recordings),
        answer=Answer(d.verdict.value, d.reasons[0].severity, [d.sentence, *found]),
        warnings=d.notes,
        sections=[
            Section("", [Numbers(_numbers(d))] if math.isfinite(d.gap.before) else []),
            Section("", [Facts(_facts(series))] if series else [], Where.PAGE),
            Section("", [Warned()], Where.PAGE),
            Section("Where the gap lies", [table_by(WHERE, d.where[:MAX_PLACES], (PLACES, *more))] if d.where else []),
            Section(
                "" if d.where else "Regimes of motion",
                [figures("diagnosis_pictures.regime_picture", series, bool(d.effects))] if series else [],
                Where.PAGE,
            ),
            Section("Which effects make it", [table_by(FOUND, d.effects, (EFFECTS_NOTE,))] if d.effects else []),
            Section("", [Table(("effect", "recording", "parameters (95 %)"), of_each, words=3)] if of_each else []),
            Section("", [figures("diagnosis_pictures.closure_picture", d)] if has_closure else [], Where.PAGE),
            *(_traces(d, series) + _twins(d, series) if series else []),
            Section("What is left", [Sentence(_left(d)), *followed], Where.PAGE),
            Section("What this data cannot tell", [*alike, following, *untestable, *detectable]),
            Section("The noise", [table_by(NOISE, d.noise)] if d.noise else []),
        ],
    )


# ------------------------------------------------------------------ figures


def _traces(d: Diagnosis, series: DiagnosisSeries) -> list[Section]:
    note = (
        "Measured: the residual without the other effects. From both, what misalignment and scale take in has been "
        "left out, so only that is shown which speaks for the effect."
    )
    return [
        Section(
            f"{each.name}: measured and as the effect says",
            [figures("diagnosis_pictures.trace_pictures", each.name, series, _axes(series)), Sentence(note, soft=True)],
            Where.PAGE,
        )
        for each in d.effects
        if series.traces[each.name].any()
    ]


def _twins(d: Diagnosis, series: DiagnosisSeries) -> list[Section]:
    axes, has_effects = _axes(series), bool(d.effects)
    note = (
        "The twin is a simulated DVL on the recorded motion, without and with what was found. What is shown is what "
        "was recorded less what the twin measured, on stretches that its parameters had not seen."
    )
    first: list[Item] = [Sentence(note, soft=True), twin_table(series.twins, has_effects)]
    return [
        Section("Recorded against the simulated twin", first, Where.PAGE),
        *(
            Section(each.name, [figures("twin_section.twin_pictures", each, axes, has_effects)], Where.PAGE)
            for each in series.twins
        ),
    ]


# ------------------------------------------------------------------ sentences


def _units(effect: str) -> dict[str, str]:
    """Units by parameter; of an effect that was found with another library than the installed one, none."""
    return {spec.name: spec.unit for spec in EFFECTS[effect].parameters} if effect in EFFECTS else {}


def _mm(value: float) -> str:
    return f"{1e3 * value:.1f} mm/s"


def _numbers(d: Diagnosis) -> list[Number]:
    gap = d.gap
    found = [Number("error", _mm(gap.before), note="held-out rms, noise included")]
    if d.effects:
        low, high = gap.interval
        found.append(Number("with the effects", _mm(gap.after), note="held-out rms, noise included"))
        told = f"of the gap beyond the noise, {share(low)} to {share(high)} (95 %)"
        found.append(Number("closed", share(gap.closure), note=told))
    claimed = "" if gap.reported is None else f"; the messages claim {_mm(gap.reported)}"
    found.append(Number("noise", _mm(gap.noise_floor), note=f"as high frequencies show it{claimed}"))
    return [*found, Number("not explained", _mm(gap.not_explained), note="left beyond the noise")]


def _facts(series: DiagnosisSeries) -> list[tuple[str, str]]:
    lengths = [float(np.ptp(series.time[series.recording_of == i])) for i in range(len(series.recordings))]
    angle_std, scale_std = np.split(series.calibration_std, 2)
    angles, scales = (
        ", ".join(
            f"{axis} {with_std(*each, signed=True)}{unit}" for axis, *each in zip("xyz", values, std, strict=True)
        )
        for values, std, unit in (
            (np.degrees(series.phi), np.degrees(angle_std), "°"),
            (100.0 * series.scale, 100.0 * scale_std, " %"),
        )
    )
    held = "whole recordings in turn" if len(series.recordings) > 1 else "a fifth of the run in turn"
    return [
        ("Recordings", ", ".join(f"{n} ({s:.0f} s)" for n, s in zip(series.recordings, lengths, strict=True))),
        ("Samples compared", f"{len(series.time)}, on the axes {''.join(_axes(series))}"),
        ("Held out", held),
        ("Calibration beside", f"misalignment {angles}; scale error {scales} (1σ)"),
    ]


def _axes(series: DiagnosisSeries) -> dict[str, str]:
    """Axes that the reference measures, with what they are called."""
    return {axis: where for (axis, where), measured in zip(BODY_AXES.items(), series.measured, strict=True) if measured}


def _left(d: Diagnosis) -> str:
    gap, series = d.gap, d.series
    if not math.isfinite(gap.after):
        return "Not known: this data says nothing of the gap."
    amount = (
        f"{_mm(gap.after)} rms, noise of {_mm(gap.noise_floor)} included, on held-out data: {_mm(gap.not_explained)} "
        "are not explained."
    )
    if series is None:
        return amount
    rest = series.rest
    if rest.found:
        said = rest.follows.full_sentence.removesuffix(".")
    else:
        said = "Nothing in it follows motion or time more than chance would"
    return f"{amount} {said} (p = {p_value(math.exp(rest.log_p))})."


# ------------------------------------------------------------------ tables


def _detectable_table(d: Diagnosis) -> Table:
    rows: list[tuple[str | Cell, ...]] = []
    for name, sizes in d.minimum_detectable.items():
        specs = {spec.name: spec for spec in EFFECTS[name].parameters} if name in EFFECTS else {}
        for i, (parameter, size) in enumerate(sizes.items()):
            spec = specs.get(parameter)
            unit = "" if spec is None else f" {spec.unit}"
            worth = "–" if spec is None else f"{spec.typical:g}{unit}"
            kind = "text" if spec is None else "text good" if size <= spec.typical else "text far"
            rows.append((name if i == 0 else "", Cell(f"{parameter} {three(size)}{unit}", kind), worth))
    return Table(
        ("effect", Cell("smallest size found", "text"), "worth knowing of"),
        rows,
        notes=(
            "The size that this data would show four times in five at the level of the tests; green where that is no "
            "more than the size worth knowing of.",
        ),
    )
