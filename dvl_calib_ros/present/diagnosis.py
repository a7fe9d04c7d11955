"""What a diagnosis says.

(Long, because it is the order of one page.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from ..calibration.frames import Array
from ..diagnosis.noise_findings import NoiseFinding
from ..diagnosis.results import Diagnosis, FoundEffect
from ..diagnosis.series import BODY_AXES, DiagnosisSeries, HeldOutTwin
from ..diagnosis.where import GapPlace
from ..effects.registry import EFFECTS
from .document import (
    Answer,
    Cell,
    Columns,
    Document,
    Number,
    Numbers,
    Said,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    facts_by,
    figures,
    intervals,
    p_value,
    quantity,
    section,
    share,
    table_by,
    three,
    with_std,
)

NOISE_MEANING = {
    "outliers": "samples far outside the noise, as a share",
    "stale_samples": "samples that repeat the one before, as a share",
    "noise_inflation": "the noise is larger than reported, or grows with speed or turn rate",
    "reported_covariance": "how the noise follows covariances that differ by sample: 1 as claimed, 0 not at all",
    "coloured_reference_noise": "the noise has a memory",
}
ALL = "all of the run"
MAX_PLACES = 12
PLACES = "Share: of the gap's energy. Places overlap, so that only the shares of the axes over all of the run add up."
EFFECTS_NOTE = (
    "The calibration is refitted with every effect. p is adjusted for all effects that were tried. Of names joined by "
    "“or”, the parameters are those of the first."
)
TRACES_NOTE = (
    "Measured: the residual without the other effects. From both, what misalignment and scale take in has been left "
    "out, so only that is shown which speaks for the effect."
)
TWINS_NOTE = (
    "The twin is a simulated DVL on the recorded motion, without and with what was found. What is shown is what was "
    "recorded less what the twin measured, on stretches that its parameters had not seen."
)


def _calibration(series: DiagnosisSeries) -> str:
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
    return f"misalignment {angles}; scale error {scales} (1σ)"


FACTS: Mapping[str, Callable[[DiagnosisSeries], str]] = {
    "Recordings": lambda s: ", ".join(
        f"{name} ({np.ptp(s.time[s.recording_of == i]):.0f} s)" for i, name in enumerate(s.recordings)
    ),
    "Samples compared": lambda s: f"{len(s.time)}, on the axes {''.join(s.axes)}",
    "Held out": lambda s: "whole recordings in turn" if len(s.recordings) > 1 else "a fifth of the run in turn",
    "Calibration": _calibration,
}
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
    "parameters (95 %)": lambda effect: Cell(intervals(effect.parameters, said_of(effect.name)), "text"),
}
NEEDS: Columns[tuple[str, str]] = {"not testable": lambda each: each[0], "needs": lambda each: Cell(each[1], "text")}
NOISE: Columns[NoiseFinding] = {
    "finding": lambda found: found.name,
    "meaning": lambda found: Cell(NOISE_MEANING.get(found.name, ""), "text"),
    "parameters (95 %)": lambda found: Cell(intervals(found.parameters), "text"),
    "p, adjusted": lambda found: p_value(found.p),
}


def diagnosis(d: Diagnosis) -> Document:
    """Where the DVL differs from what calibration leads to expect, which effect makes it, and what cannot be told."""
    series, has_effects = d.series, bool(d.effects)
    found = [
        f"{' or '.join((e.name, *e.equivalent_to))}: {intervals(e.parameters, said_of(e.name))}." for e in d.effects
    ]
    more = [f"The first {MAX_PLACES} of {len(d.where)} places; --json holds all."] if len(d.where) > MAX_PLACES else []
    of_each = [
        (effect.name, recording, intervals(parameters, said_of(effect.name)))
        for effect in d.effects
        for recording, parameters in effect.by_recording.items()
    ]
    followed = (
        figures("twin_pictures.followed_picture", series.followed, series.axes) if series and series.followed else None
    )
    regimes = None if series is None else figures("diagnosis_pictures.regime_picture", series, has_effects)
    return Document(
        title="Sim-to-real gap of the DVL",
        subtitle="" if series is None else ", ".join(series.recordings),
        answer=Answer(d.verdict.value, d.reasons[0].severity, [d.sentence, *found, *_to_do(d)]),
        warnings=d.notes,
        sections=[
            section("", Numbers(_numbers(d)) if math.isfinite(d.gap.before) else None),
            section("", None if series is None else facts_by(FACTS, series), where=Where.PAGE),
            section("", Warned(), where=Where.PAGE),
            section("Which effects make it", table_by(FOUND, d.effects, (EFFECTS_NOTE,))),
            section("", Table(("effect", "recording", "parameters (95 %)"), of_each, words=3)),
            section(
                "",
                figures("diagnosis_pictures.closure_picture", d)
                if has_effects and math.isfinite(d.gap.closure)
                else None,
                where=Where.PAGE,
            ),
            section("Where the gap lies", table_by(WHERE, d.where[:MAX_PLACES], (PLACES, *more))),
            section("" if d.where else "Regimes of motion", regimes, where=Where.PAGE),
            *(_of_series(d, series) if series is not None else []),
            section(
                "What is left",
                Sentence(_left(d)),
                followed,
                where=Where.PAGE,
            ),
            section(
                "What this data cannot tell",
                *_alike(d),
                Sentence(f"Next: {d.next_manoeuvre}."),
                table_by(NEEDS, d.untestable.items()),
                _detectable_table(d),
            ),
            section("The noise", table_by(NOISE, d.noise)),
        ],
    )


def _of_series(d: Diagnosis, series: DiagnosisSeries) -> Iterator[Section]:
    """What a page shows over time: each effect as measured, and the recorded against the twin."""
    axes, has_effects = series.axes, bool(d.effects)
    for each in d.effects:
        if series.traces[each.name].any():
            drawn = figures("diagnosis_pictures.trace_pictures", each.name, series, axes)
            title = f"{each.name}: measured and as the effect says"
            yield section(title, drawn, Sentence(TRACES_NOTE, soft=True), where=Where.PAGE)
    table = twin_table(series.twins, has_effects)
    yield section("Recorded against the simulated twin", Sentence(TWINS_NOTE, soft=True), table, where=Where.PAGE)
    for twin in series.twins:
        yield section(twin.name, figures("twin_pictures.twin_pictures", twin, axes, has_effects), where=Where.PAGE)


# ------------------------------------------------------------------ sentences


def _to_do(d: Diagnosis) -> list[str]:
    """What each effect that was found asks for."""
    known = [effect for effect in d.effects if effect.name in EFFECTS]
    return [f"To do for {each.name}: {EFFECTS[each.name].remedy}." for each in known if EFFECTS[each.name].remedy]


def _alike(d: Diagnosis) -> Iterator[Sentence]:
    """Effects that cannot be told apart, and what is known of a lever arm and a clock together."""
    for each in d.effects:
        if each.equivalent_to:
            others = " or ".join(each.equivalent_to)
            yield Sentence(f"This data cannot tell {each.name} from {others}; each explains it as well.")
    for known in (each.combination for each in d.effects):
        if known is not None:
            value, low, high = known.value
            sign = "-" if known.speed > 0.0 else "+"
            yield Sentence(
                f"Known of both is lever_arm {known.parameter} {sign} {abs(known.speed):.2f} m/s · {known.clock} = "
                f"{value:.2f} m ({low:.2f} to {high:.2f})."
            )


def said_of(effect: str) -> dict[str, Said]:
    """How its parameters are said; of an effect that was found with another library than the installed one, none."""
    parameters = EFFECTS[effect].parameters if effect in EFFECTS else ()
    return {each.name: Said(each.spoken, each.unit) for each in parameters}


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
    p = p_value(math.exp(rest.log_p))
    return f"{amount} {said} (p {p if p.startswith('<') else f'= {p}'})."


# ------------------------------------------------------------------ tables


def _detectable_table(d: Diagnosis) -> Table:
    rows: list[tuple[str | Cell, ...]] = []
    for name, sizes in d.minimum_detectable.items():
        specs = {spec.name: spec for spec in EFFECTS[name].parameters} if name in EFFECTS else {}
        for i, (parameter, size) in enumerate(sizes.items()):
            spec = specs.get(parameter)
            typical = math.nan if spec is None else spec.typical
            said = parameter if spec is None else spec.spoken
            (found, worth), unit = quantity((size, typical), "" if spec is None else spec.unit)
            kind = "text" if spec is None else "text good" if size <= typical else "text far"
            worth_knowing = "–" if spec is None else f"{worth:g} {unit}"
            rows.append((name if i == 0 else "", Cell(f"{said} {three(found)} {unit}".strip(), kind), worth_knowing))
    return Table(
        ("effect", Cell("smallest size found", "text"), "worth knowing of"),
        rows,
        notes=(
            "The size that this data would show four times in five at the level of the tests; green where that is no "
            "more than the size worth knowing of.",
        ),
    )


def rms(values: Array) -> float:
    """m/s of the vector, of values (N, 3)."""
    return float(np.sqrt((values**2).sum(axis=1).mean())) if len(values) else float("nan")


def twin_table(twins: Sequence[HeldOutTwin], has_effects: bool) -> Table:
    """Error of every recording in every regime of motion, m/s."""
    rows = []
    for twin in twins:
        noise = float(np.sqrt((twin.noise**2).sum()))
        for regime, mask in {ALL: np.ones(len(twin.time), dtype=bool), **twin.regimes}.items():
            errors = [f"{rms(values[mask]):.4f}" for values in twin.errors(has_effects).values()]
            rows.append(
                (twin.name if regime == ALL else "", regime, f"{100.0 * mask.mean():.0f} %", *errors, f"{noise:.4f}")
            )
    heads = ("without, m/s", "with, m/s") if has_effects else ("recorded less twin, m/s",)
    return Table(
        ("recording", "regime", "share", *heads, "noise, m/s"),
        rows,
        words=2,
        notes=(
            "Rms of the vector, with the noise of DVL and reference, where there is a reference. The error and the "
            "noise at the top are those of all recordings together. The twin moves as the reference says.",
        ),
    )
