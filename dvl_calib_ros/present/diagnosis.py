"""What a diagnosis says.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math

import numpy as np

from ..calibration.frames import Array
from ..diagnosis.results import Diagnosis
from ..diagnosis.series import DiagnosisSeries
from ..effects.registry import EFFECTS
from .document import (
    Answer,
    Cell,
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
    signed,
    three,
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


def diagnosis(d: Diagnosis) -> Document:
    """Where the DVL differs from what calibration leads to expect, which effect makes it, and what cannot be told."""
    found = [
        f"{' or '.join((e.name, *e.equivalent_to))}: {intervals(e.parameters, _units(e.name))}." for e in d.effects
    ]
    untestable = [_untestable_table(d)] if d.untestable else []
    detectable = [_detectable_table(d)] if d.minimum_detectable else []
    following = Sentence(f"Next: {d.next_manoeuvre}.")
    series = d.series
    followed = (
        [figures("twin_section.followed_picture", series.followed, _axes(series))] if series and series.followed else []
    )
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
            Section("Where the gap lies", [_where_table(d)] if d.where else []),
            Section(
                "" if d.where else "Regimes of motion",
                [figures("diagnosis_pictures.regime_picture", series, bool(d.effects))] if series else [],
                Where.PAGE,
            ),
            Section("Which effects make it", [_effect_table(d)] if d.effects else []),
            Section("", [_by_recording(d)] if any(e.by_recording for e in d.effects) else []),
            Section("", [figures("diagnosis_pictures.closure_picture", d)] if has_closure else [], Where.PAGE),
            *(_traces(d, series) + _twins(d, series) if series else []),
            Section("What is left", [Sentence(_left(d)), *followed], Where.PAGE),
            Section("What this data cannot tell", [*_alternatives(d), following, *untestable, *detectable]),
            Section("The noise", [_noise_table(d)] if d.noise else []),
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
    angles = _with_std(np.degrees(series.phi), np.degrees(angle_std), "°")
    scales = _with_std(100.0 * series.scale, 100.0 * scale_std, " %")
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


def _with_std(values: Array, std: Array, unit: str) -> str:
    triples = zip("xyz", values, std, strict=True)
    return ", ".join(f"{axis} {signed(value)} ± {sigma:.2f}{unit}" for axis, value, sigma in triples)


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
        return f"{amount} It still follows {rest.about} (p = {p_value(math.exp(rest.log_p))})."
    return (
        f"{amount} Nothing in it follows motion or time more than chance would (p = {p_value(math.exp(rest.log_p))})."
    )


def _alternatives(d: Diagnosis) -> list[Item]:
    return [
        Sentence(f"This data cannot tell {each.name} from {' or '.join(each.equivalent_to)}; each explains it as well.")
        for each in d.effects
        if each.equivalent_to
    ]


# ------------------------------------------------------------------ tables


def _where_table(d: Diagnosis) -> Table:
    rows = [
        (
            f"{place.axis} ({BODY_AXES[place.axis]})", place.regime, "{:.0f} to {:.0f}".format(*place.segment_s),
            "{:.2g} to {:.2g}".format(*place.band_hz), share(place.share), p_value(place.p),
        )
        for place in d.where[:MAX_PLACES]
    ]  # fmt: skip
    notes = ["Share: of the gap's energy. Places overlap: only the axes over all of the run add up."]
    if len(d.where) > MAX_PLACES:
        notes.append(f"The first {MAX_PLACES} of {len(d.where)} places; --json holds all.")
    return Table(("axis", "regime", "time, s", "band, Hz", "share", "p, adjusted"), rows, notes=notes)


def _effect_table(d: Diagnosis) -> Table:
    rows = [
        (
            " or ".join((effect.name, *effect.equivalent_to)), share(effect.closure), p_value(effect.p),
            Cell(intervals(effect.parameters, _units(effect.name)), "text"),
        )
        for effect in d.effects
    ]  # fmt: skip
    return Table(
        ("effect", "closes alone", "p, adjusted", Cell("parameters (95 %)", "text")),
        rows,
        notes=(
            "The calibration is refitted with every effect. p is adjusted for all effects that were tried. "
            "Of names joined by “or”, the parameters are those of the first.",
        ),
    )


def _untestable_table(d: Diagnosis) -> Table:
    return Table(
        ("not testable", Cell("needs", "text")), [(name, Cell(needs, "text")) for name, needs in d.untestable.items()]
    )


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


def _noise_table(d: Diagnosis) -> Table:
    rows = [
        (
            finding.name, Cell(NOISE_MEANING.get(finding.name, ""), "text"),
            Cell(intervals(finding.parameters), "text"),
            p_value(finding.p),
        )
        for finding in d.noise
    ]  # fmt: skip
    return Table(("finding", Cell("meaning", "text"), Cell("parameters (95 %)", "text"), "p, adjusted"), rows)


def _by_recording(d: Diagnosis) -> Table:
    rows = [
        (effect.name, recording, intervals(parameters, _units(effect.name)))
        for effect in d.effects
        for recording, parameters in effect.by_recording.items()
    ]
    return Table(("effect", "recording", "parameters (95 %)"), rows, words=3)
