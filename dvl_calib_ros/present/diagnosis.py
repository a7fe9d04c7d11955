"""Documents of a diagnosis, and of a comparison of a simulator's DVL with the vehicle's."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..calibration.assessment.dead_reckoning import metres
from ..calibration.numerics.frames import Array
from ..diagnosis.answer.gap_location import GapPlace
from ..diagnosis.answer.noise_findings import NoiseFinding
from ..diagnosis.answer.plotted_series import BODY_AXES, DiagnosisSeries, HeldOutTwin
from ..diagnosis.answer.results import Diagnosis, FoundEffect
from ..effects.base import EffectParameter
from ..effects.registry import EFFECTS
from ..unpaired.results import (
    ComparedEffect,
    ComparedNoise,
    ComparisonStatus,
    Rung,
    SimulatorVerdict,
    UnpairedComparison,
)
from ..verdict.kinds import Severity
from .document import (
    Answer,
    Cell,
    Columns,
    Document,
    Item,
    Number,
    Numbers,
    Section,
    Sentence,
    Table,
    Warned,
    Where,
    columns_for,
    facts_by,
    figure,
    figures,
    section,
    table_by,
)
from .numbers import intervals, mm, p_value, quantity, share, three, two, with_std

if TYPE_CHECKING:
    from ..unpaired.simulator_rounds import ClosedGap, Round

NOISE_MEANING = {
    "outliers": "share of samples far outside the noise",
    "stale_samples": "share of samples that repeat the previous one",
    "noise_inflation": "the noise is larger than reported, or grows with speed or turn rate",
    "reported_covariance": "how the noise follows covariances that differ by sample: 1 as claimed, 0 not at all",
    "coloured_reference_noise": "the noise has a memory",
}
ALL = "all of the run"
MAX_PLACES = 12
# effects on the first screen of a terminal
FIRST_EFFECTS = 3
PLACES = "Share: of the gap's energy. Places overlap; only the axes, over the whole run, add up to all of it."
EFFECTS_NOTE = (
    "The calibration is refitted with every effect. p is adjusted for all effects tried. For names joined by "
    "“or”, the parameters are those of the first."
)
TRACES_NOTE = (
    "Measured: the residual without the other effects. The part that misalignment and scale could explain is removed "
    "from both curves, so they show only the evidence for the effect."
)
TWINS_NOTE = (
    "The twin is a simulated DVL on the recorded motion, without and with the effects found. Shown is the recorded "
    "minus the twin's velocity, on stretches that were not used for its parameters."
)


def _calibration_text(series: DiagnosisSeries) -> str:
    """Return misalignment and scale error per axis with 1 σ, as a sentence."""
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
    "Calibration": _calibration_text,
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
    "parameters (95 %)": lambda effect: Cell(intervals(effect.parameters, EFFECTS.get(effect.name)), "text"),
}
NEEDS: Columns[tuple[str, str]] = {"not testable": lambda each: each[0], "needs": lambda each: Cell(each[1], "text")}
NOISE: Columns[NoiseFinding] = {
    "finding": lambda found: found.name,
    "meaning": lambda found: Cell(NOISE_MEANING.get(found.name, ""), "text"),
    "parameters (95 %)": lambda found: Cell(intervals(found.parameters), "text"),
    "p, adjusted": lambda found: p_value(found.p),
}


def first_screen(d: Diagnosis) -> Document:
    """Lay out answer, remedy, cost of the gap and next recording, within 24 rows of a terminal."""
    document, gap = diagnosis(replace(d, effects=d.effects[:FIRST_EFFECTS])), d.gap
    more = len(d.effects) - FIRST_EFFECTS
    further = [f"{more} more effects: --verbose."] if more > 0 else []
    if math.isfinite(gap.before):
        cost = mm(math.sqrt(max(gap.before**2 - gap.noise_floor**2, 0.0)))
        further.append(f"Cost: {cost} mm/s beyond the noise; {mm(gap.not_explained)} mm/s of it are not explained.")
        further += _drift_sentences(d)
    further += [f"Next: {d.next_manoeuvre}.", "Details: --verbose, or --report FILE."]
    return replace(document, sections=[section("", *map(Sentence, further))])


def diagnosis(d: Diagnosis) -> Document:
    """Lay out the gap between DVL and reference: places, effects that explain it, and limits of the data."""
    series, has_effects = d.series, bool(d.effects)
    found = [
        f"{' or '.join((e.name, *e.equivalent_to))}: {intervals(e.parameters, EFFECTS.get(e.name))}." for e in d.effects
    ]
    known = [(each.name, EFFECTS[each.name].remedy) for each in d.effects if each.name in EFFECTS and each.is_certain]
    to_do = [f"To do for {name}: {remedy}." for name, remedy in known if remedy]
    more = [f"The first {MAX_PLACES} of {len(d.where)} places; --json holds all."] if len(d.where) > MAX_PLACES else []
    by_recording = [
        (effect.name, recording, intervals(parameters, EFFECTS.get(effect.name)))
        for effect in d.effects
        for recording, parameters in effect.by_recording.items()
    ]
    regimes = None if series is None else figures("diagnosis_pictures.regime_picture", series, has_effects)
    alone = ", ".join(f"{effect.name} {share(effect.closure)}" for effect in d.effects)
    closed = figure(
        "diagnosis_pictures.closure_bars",
        "Closure",
        f"Share of the gap closed: {alone}; together {share(d.gap.closure)}",
        [effect.name for effect in d.effects],
        np.array([effect.closure for effect in d.effects]),
        (d.gap.closure, *d.gap.interval),
        caption="Line: 95 % interval, from the uncertainty of the parameters.",
    )
    return Document(
        title=f"DVL against the reference: {', '.join(name for name, _ in d.recordings)}",
        subtitle="" if series is None else ", ".join(series.recordings),
        answer=Answer(d.verdict.value, d.reasons[0].severity, [d.sentence, *found, *to_do]),
        warnings=d.notes,
        sections=[
            section("", Numbers(_main_numbers(d)) if math.isfinite(d.gap.before) else None),
            section("", *map(Sentence, _drift_sentences(d)), where=Where.PAGE),
            section("", None if series is None else facts_by(FACTS, series), where=Where.PAGE),
            section("", Warned(), where=Where.PAGE),
            section("Which effects cause it", table_by(FOUND, d.effects, (EFFECTS_NOTE,))),
            section("", Table(("effect", "recording", "parameters (95 %)"), by_recording, words=3)),
            section("", closed if has_effects and math.isfinite(d.gap.closure) else None, where=Where.PAGE),
            section("Where the gap lies", table_by(WHERE, d.where[:MAX_PLACES], (PLACES, *more))),
            section("" if d.where else "Regimes of motion", regimes, where=Where.PAGE),
            *(_sections_over_time(d, series) if series is not None else []),
            section("Residual", *_residual_items(d), where=Where.PAGE),
            section(
                "Limits of this data",
                *_equivalence_sentences(d),
                Sentence(f"Next: {d.next_manoeuvre}."),
                table_by(NEEDS, d.untestable.items()),
                table_by(DETECTABLE, _detectable_sizes(d), (DETECTABLE_NOTE,)),
            ),
            section("The noise", table_by(NOISE, d.noise)),
        ],
    )


def _sections_over_time(d: Diagnosis, series: DiagnosisSeries) -> Iterator[Section]:
    """Yield the sections over time: each effect as measured, and recorded against twin."""
    axes, has_effects = series.axes, bool(d.effects)
    for each in d.effects:
        if series.traces[each.name].any():
            drawn = figures("diagnosis_pictures.trace_pictures", each.name, series, axes)
            title = f"{each.name}: measured and explained"
            yield section(title, drawn, Sentence(TRACES_NOTE, soft=True), where=Where.PAGE)
    errors = [each for twin in series.twins for each in twin_errors(twin, has_effects)]
    heads = {TWIN_HEADS.get(name, "recorded less twin, m/s"): name for name in (errors[0].errors if errors else ())}
    columns: Columns[TwinError] = {
        **TWIN,
        **columns_for(heads, lambda each, name: f"{each.errors[name]:.4f}"),
        "noise, m/s": lambda each: f"{each.twin.level:.4f}",
    }
    table = table_by(columns, errors, (TWIN_NOTE,), words=2)
    yield section("Recorded against the simulated twin", Sentence(TWINS_NOTE, soft=True), table, where=Where.PAGE)
    for twin in series.twins:
        yield section(twin.name, figures("diagnosis_pictures.twin_pictures", twin, axes, has_effects), where=Where.PAGE)


def _equivalence_sentences(d: Diagnosis) -> Iterator[Sentence]:
    """Yield sentences on equivalent effects, and on the known combination of lever arm and clock offset."""
    for each in d.effects:
        if each.equivalent_to:
            others = " or ".join(each.equivalent_to)
            yield Sentence(f"This data cannot distinguish {each.name} from {others}; each explains it equally well.")
    for known in (each.combination for each in d.effects):
        if known is not None:
            value, low, high = known.value
            sign = "-" if known.speed > 0.0 else "+"
            yield Sentence(
                f"Observable is only lever_arm {known.parameter} {sign} {abs(known.speed):.2f} m/s · {known.clock} = "
                f"{value:.2f} m ({low:.2f} to {high:.2f})."
            )


def _drift_sentences(d: Diagnosis) -> list[str]:
    """Return the drift that the errors cause on a straight kilometre, without and with the effects."""
    if d.gap.drift is None:
        return []
    before, after = (f"{metres(each.per_km)} m ({each.percent:.2g} %)" for each in d.gap.drift)
    return [f"Drift per straight km, noise included: {before}" + (f", {after} with the effects." if d.effects else ".")]


def _main_numbers(d: Diagnosis) -> list[Number]:
    """Return error, closed share of the gap, noise level and unexplained error as main quantities."""
    gap = d.gap
    found = [Number("error", f"{mm(gap.before)} mm/s", note="held-out rms, noise included")]
    if d.effects:
        low, high = gap.interval
        found.append(Number("with the effects", f"{mm(gap.after)} mm/s", note="held-out rms, noise included"))
        note = f"of the gap beyond the noise, {share(low)} to {share(high)} (95 %)"
        found.append(Number("closed", share(gap.closure), note=note))
    reported = "" if gap.reported is None else f"; the messages claim {mm(gap.reported)} mm/s"
    found.append(Number("noise", f"{mm(gap.noise_floor)} mm/s", note=f"white plus slow, by likelihood{reported}"))
    return [*found, Number("not explained", f"{mm(gap.not_explained)} mm/s", note="beyond the noise")]


def _residual_items(d: Diagnosis) -> Iterator[Item]:
    """Yield the unexplained residual and the variable that it depends on most."""
    gap, series = d.gap, d.series
    if not math.isfinite(gap.after):
        yield Sentence("Unknown: the gap is not observable in this data.")
        return
    amount = (
        f"{mm(gap.after)} mm/s rms, noise of {mm(gap.noise_floor)} mm/s included, on held-out data: "
        f"{mm(gap.not_explained)} mm/s are not explained."
    )
    if series is None:
        yield Sentence(amount)
        return
    unexplained = series.rest
    if unexplained.found:
        text = unexplained.follows.full_sentence.removesuffix(".")
    else:
        text = "Nothing in it follows motion or time more than chance would"
    p = p_value(math.exp(unexplained.log_p))
    yield Sentence(f"{amount} {text} (p {p if p.startswith('<') else f'= {p}'}).")
    if series.by_regressor:
        where, plotted = series.axes[series.by_regressor.axis], series.by_regressor
        yield figure(
            "diagnosis_pictures.residual_over_regressor",
            f"Residual {where}, against {plotted.label.partition(',')[0]}",
            f"Residual of the fit {where} against {plotted.label}, with means of groups and their standard deviations",
            plotted,
            f"residual {where}, mm/s",
            caption="Dots: residual, averaged over two samples of the slower stream. Band: standard deviation of a "
            "group about its mean; bars: of the mean, twice.",
        )


class Detectable(NamedTuple):
    """Smallest detectable size of a parameter. effect: only in the first row of each effect.

    spec: None for an effect that is not in the library.
    """

    effect: str
    parameter: str
    size: float
    spec: EffectParameter | None

    @property
    def sizes(self) -> tuple[list[float], str]:
        """Detectable and typical size, and their common unit."""
        return quantity((self.size, self.spec.typical), self.spec.unit) if self.spec else ([self.size], "")


DETECTABLE_NOTE = (
    "An effect of this size would be found in four of five recordings like this one. Green: at most the relevant size."
)
DETECTABLE: Columns[Detectable] = {
    "effect": lambda each: each.effect,
    "smallest size found": lambda each: Cell(
        f"{each.spec.display_name if each.spec else each.parameter} {three(each.sizes[0][0])} {each.sizes[1]}".strip(),
        "text" if each.spec is None else "text good" if each.size <= each.spec.typical else "text far",
    ),
    "relevant size": lambda each: f"{two(each.sizes[0][1])} {each.sizes[1]}" if each.spec else "–",
}


def _detectable_sizes(d: Diagnosis) -> Iterator[Detectable]:
    """Yield the smallest detectable size of each parameter of each tested effect."""
    for name, sizes in d.minimum_detectable.items():
        specs = {spec.name: spec for spec in EFFECTS[name].parameters} if name in EFFECTS else {}
        for i, (parameter, size) in enumerate(sizes.items()):
            yield Detectable(name if i == 0 else "", parameter, size, specs.get(parameter))


def rms(values: Array) -> float:
    """Return the rms length of vectors (N, 3), m/s."""
    return float(np.sqrt((values**2).sum(axis=1).mean())) if len(values) else float("nan")


class TwinError(NamedTuple):
    """Difference between recording and twin in a regime of motion, m/s rms, by the effects of the twin."""

    twin: HeldOutTwin
    regime: str
    share: float
    errors: Mapping[str, float]


def twin_errors(twin: HeldOutTwin, has_effects: bool) -> list[TwinError]:
    """Return the errors over the whole run, then in each regime."""
    found = twin.errors(has_effects)
    regimes = {ALL: np.ones(len(twin.time), dtype=bool), **twin.regimes}
    return [
        TwinError(twin, regime, float(mask.mean()), {name: rms(values[mask]) for name, values in found.items()})
        for regime, mask in regimes.items()
    ]


TWIN_HEADS = {"without": "without, m/s", "with": "with, m/s"}
TWIN_NOTE = (
    "Rms of the vector, with the noise of the DVL and, if present, of the reference. The error and the noise at "
    "the top are for all recordings together. The twin follows the motion of the reference."
)
TWIN: Columns[TwinError] = {
    "recording": lambda each: each.twin.name if each.regime == ALL else "",
    "regime": lambda each: each.regime,
    "share": lambda each: f"{100.0 * each.share:.0f} %",
}


# Comparison of a simulator's DVL with the vehicle's, once or by round.

SEVERITIES = {
    SimulatorVerdict.NO_DIFFERENCE: Severity.ACCEPT,
    SimulatorVerdict.ONLY_NOISE: Severity.MARGINAL,
    SimulatorVerdict.CANNOT_TELL: Severity.MARGINAL,
    SimulatorVerdict.DIFFERENT: Severity.REJECT,
}
CELLS = {ComparisonStatus.MISSING: "bad", ComparisonStatus.OTHER_SIZE: "off", ComparisonStatus.ONLY_SIMULATOR: "off"}
COMPARED_EFFECTS: Columns[ComparedEffect] = {
    "effect": lambda each: " or ".join((each.name, *each.equivalent_to)),
    "": lambda each: Cell(each.status.words, CELLS.get(each.status, "")),
    "vehicle (95 %)": lambda each: Cell(intervals(each.vehicle, EFFECTS.get(each.name)), "text"),
    "simulator (95 %)": lambda each: Cell(intervals(each.simulator, EFFECTS.get(each.name)), "text"),
    "adds, mm/s": lambda each: mm(each.adds_mps),
    "mostly on": lambda each: Cell(str(each.lies or "–"), "text"),
    "p, adjusted": lambda each: p_value(each.p),
}
COMPARED_EFFECTS_NOTE = (
    "Each effect is fitted to both logs, even if only one has it. p: that both have the same size, adjusted for "
    "all claims of this page. Adds: without the part that misalignment and scale absorb."
)
LEVELS = ("noise of the DVL by regime, mm/s", "vehicle", "simulator")
RUNGS: Columns[Rung] = {
    "simulator": lambda r: r.name,
    "error, mm/s": lambda r: mm(r.error_mps),
    "energy distance": lambda r: f"{r.distance:.2f}",
    "alike: below": lambda r: f"{r.null95:.2f}",
    "p": lambda r: p_value(r.p),
}
RUNGS_NOTE = (
    "On held-out stretches of the vehicle's own motion; the error includes noise of {} mm/s. Energy "
    "distance: between windows of recorded and simulated velocity, each minus an ideal DVL's, by their means and "
    "scatter on the axes."
)
ROUNDS: Columns[tuple[int, Round]] = {
    "round": lambda each: str(each[0]),
    "the simulator's DVL has": lambda each: ", ".join(each[1].effects) or ("nothing" if each[0] else "as recorded"),
    "still differs in": lambda each: ", ".join(each[1].claims) or "nothing",
    "error, mm/s": lambda each: mm(each[1].error_mps),
    "energy distance": lambda each: f"{each[1].comparison.rungs[0].distance:.2f}",
    "alike: below": lambda each: f"{each[1].comparison.rungs[0].null95:.2f}",
}
ROUNDS_NOTE = (
    "Error: recorded minus simulated on the vehicle's own motion, held out, with noise of {} mm/s. In each round "
    "effects, noise and rate are changed by their difference in the previous one. The rest is about round {}."
)
COMPARED_NOISE: Columns[ComparedNoise] = {
    "property": lambda each: each.name,
    "": lambda each: Cell(each.status.words, CELLS.get(each.status, "")),
    "vehicle (95 %)": lambda each: intervals({"": each.vehicle}),
    "simulator (95 %)": lambda each: intervals({"": each.simulator}),
    "unit": lambda each: each.unit,
    "p, adjusted": lambda each: p_value(each.p),
    "remarks": lambda each: each.note,
}


def unpaired(found: UnpairedComparison | ClosedGap) -> Document:
    """Lay out what the simulator's DVL lacks, the reduction of the gap, and the unobservable effects.

    With rounds, the gap by round comes first, and the rest is about the best round.
    """
    from ..unpaired.simulator_rounds import ClosedGap, Round  # slow: scipy.stats

    closed = found if isinstance(found, ClosedGap) else ClosedGap((Round(found),))
    c, reasons = closed.rounds[closed.best].comparison, found.reasons
    compared = [each for each in enumerate(closed.rounds) if each[1].comparison.rungs]
    by_round = table_by(ROUNDS, compared, (ROUNDS_NOTE.format(mm(c.floor_mps), closed.best),), words=3)
    effects = table_by(COMPARED_EFFECTS, c.effects, (COMPARED_EFFECTS_NOTE,), words=len(COMPARED_EFFECTS))
    rungs = table_by(RUNGS, c.rungs, (RUNGS_NOTE.format(mm(c.floor_mps)),))
    levels = [(name, *map(mm, values)) for name, values in c.levels.items()]
    sides = {"vehicle": c.vehicle, "simulator": c.simulator}
    names = sorted({name for side in c.not_shown.values() for name in side})
    unseen = [(name, *(side.get(name, "would have shown") for side in c.not_shown.values())) for name in names]
    return Document(
        title="A simulator's DVL against the vehicle's",
        subtitle="; ".join(f"{side}: {', '.join(name for name, _ in d.recordings)}" for side, d in sides.items()),
        answer=Answer(c.verdict.value, SEVERITIES[c.verdict], [each.full_sentence for each in reasons]),
        warnings=c.notes,
        sections=[
            section("The gap by round", by_round if isinstance(found, ClosedGap) else None),
            section(
                "Effect by effect",
                effects,
                *(Sentence(f"To tell {each.name}: {each.needs}.") for each in c.effects if each.needs),
            ),
            section(
                "How far the gap shrinks", rungs, figures("diagnosis_pictures.shrink_pictures", c) if c.rungs else None
            ),
            section("Noise and stream", table_by(COMPARED_NOISE, c.noise, words=len(COMPARED_NOISE))),
            section("", Table(LEVELS, levels), where=Where.TERMINAL),
            section("", figures("diagnosis_pictures.noise_pictures", c), where=Where.PAGE),
            section(
                "Effects not observable from the motions",
                Table(("effect", *c.not_shown), unseen, words=1 + len(sides)),
            ),
            section(
                "Each side by itself",
                *(Sentence(f"{side}: {d.verdict.value.replace('_', ' ')}. {d.sentence}") for side, d in sides.items()),
                where=Where.PAGE,
            ),
        ],
    )
