"""Document of a comparison of a simulator's DVL with the vehicle's, once or by round."""

from __future__ import annotations

from ..effects.registry import EFFECTS as LIBRARY
from ..unpaired.results import (
    ComparedEffect,
    ComparedNoise,
    ComparisonStatus,
    Rung,
    SimulatorVerdict,
    UnpairedComparison,
)
from ..unpaired.simulator_rounds import ClosedGap, Round
from ..verdict.kinds import Severity
from .document import Answer, Cell, Columns, Document, Sentence, Table, Where, figures, section, table_by
from .numbers import intervals, mm, p_value

SEVERITIES = {
    SimulatorVerdict.NO_DIFFERENCE: Severity.ACCEPT,
    SimulatorVerdict.ONLY_NOISE: Severity.MARGINAL,
    SimulatorVerdict.CANNOT_TELL: Severity.MARGINAL,
    SimulatorVerdict.DIFFERENT: Severity.REJECT,
}
CELLS = {ComparisonStatus.MISSING: "bad", ComparisonStatus.OTHER_SIZE: "off", ComparisonStatus.ONLY_SIMULATOR: "off"}
EFFECTS: Columns[ComparedEffect] = {
    "effect": lambda each: " or ".join((each.name, *each.equivalent_to)),
    "": lambda each: Cell(each.status.words, CELLS.get(each.status, "")),
    "vehicle (95 %)": lambda each: Cell(intervals(each.vehicle, LIBRARY.get(each.name)), "text"),
    "simulator (95 %)": lambda each: Cell(intervals(each.simulator, LIBRARY.get(each.name)), "text"),
    "adds, mm/s": lambda each: mm(each.adds_mps),
    "mostly on": lambda each: Cell(str(each.lies or "–"), "text"),
    "p, adjusted": lambda each: p_value(each.p),
}
EFFECTS_NOTE = (
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
NOISE: Columns[ComparedNoise] = {
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
    closed = found if isinstance(found, ClosedGap) else ClosedGap((Round(found),))
    c, reasons = closed.rounds[closed.best].comparison, found.reasons
    compared = [each for each in enumerate(closed.rounds) if each[1].comparison.rungs]
    by_round = table_by(ROUNDS, compared, (ROUNDS_NOTE.format(mm(c.floor_mps), closed.best),), words=3)
    effects = table_by(EFFECTS, c.effects, (EFFECTS_NOTE,), words=len(EFFECTS))
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
            section("Noise and stream", table_by(NOISE, c.noise, words=len(NOISE))),
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
