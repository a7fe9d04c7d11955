"""What a comparison of a simulator's DVL with that of the vehicle says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..unpaired.results import ComparedEffect, ComparedNoise, ComparisonStatus, SimulatorVerdict, UnpairedComparison
from ..verdict.kinds import Severity
from .document import Answer, Cell, Document, Section, Sentence, Table, Where, figures, interval, intervals, p_value

SEVERITIES = {
    SimulatorVerdict.NO_DIFFERENCE: Severity.ACCEPT,
    SimulatorVerdict.ONLY_NOISE: Severity.MARGINAL,
    SimulatorVerdict.CANNOT_TELL: Severity.MARGINAL,
    SimulatorVerdict.DIFFERENT: Severity.REJECT,
}
CELLS = {ComparisonStatus.MISSING: "bad", ComparisonStatus.OTHER_SIZE: "off", ComparisonStatus.ONLY_SIMULATOR: "off"}
MM = 1e3


def unpaired(c: UnpairedComparison) -> Document:
    """What the simulator's DVL lacks, how far the gap shrinks with it, and what could not be told."""
    sides = {"vehicle": c.vehicle, "simulator": c.simulator}
    return Document(
        title="The DVL of a simulator against that of the vehicle",
        subtitle="; ".join(f"{side}: {', '.join(name for name, _ in d.recordings)}" for side, d in sides.items()),
        answer=Answer(c.verdict.value, SEVERITIES[c.verdict], [c.sentence]),
        warnings=c.notes,
        sections=[
            Section("Effect by effect", [_effects(c.effects), *_needs(c.effects)] if c.effects else []),
            Section("How far the gap shrinks", [_rungs(c)] if c.rungs else []),
            Section("", [figures("unpaired_figures.shrink_pictures", c)] if c.rungs else [], Where.PAGE),
            Section("Noise and stream", [_noise(c.noise)] if c.noise else []),
            Section("", [_levels(c)] if c.levels else [], Where.TERMINAL),
            Section("", [figures("unpaired_figures.noise_pictures", c)], Where.PAGE),
            Section("What the motions could not have shown", _not_shown(c)),
            Section(
                "Each side by itself",
                [Sentence(f"{side}: {d.verdict.value.replace('_', ' ')}. {d.sentence}") for side, d in sides.items()],
                Where.PAGE,
            ),
        ],
    )


def _effects(effects: Sequence[ComparedEffect]) -> Table:
    rows = [
        (
            " or ".join((each.name, *each.equivalent_to)), Cell(each.status.words, CELLS.get(each.status, "")),
            Cell(intervals(each.vehicle), "text"), Cell(intervals(each.simulator), "text"),
            f"{MM * each.adds_mps:.1f}", str(each.lies or "–"), p_value(each.p),
        )
        for each in effects
    ]  # fmt: skip
    notes = [
        "Each effect is fitted to both logs, whichever was found to have it. p: that both have the same size, adjusted "
        "for all claims of this page. Adds: beyond what misalignment and scale take in."
    ]
    head = ("effect", "", "vehicle (95 %)", "simulator (95 %)", "adds, mm/s", "mostly on", "p, adjusted")
    return Table(head, rows, notes=notes, words=len(head))


def _needs(effects: Sequence[ComparedEffect]) -> list[Sentence]:
    return [Sentence(f"To tell {each.name}: {each.needs}.") for each in effects if each.needs]


def _rungs(c: UnpairedComparison) -> Table:
    rows = [
        (r.name, f"{MM * r.error_mps:.1f}", f"{r.distance:.2f}", f"{r.null95:.2f}", p_value(r.p)) for r in c.rungs
    ]  # fmt: skip
    notes = [
        f"On stretches of the vehicle's own motion that were held out; noise of {MM * c.floor_mps:.1f} mm/s stays in "
        "the error. Energy distance: between windows of recorded and simulated velocity, each less that of an ideal "
        "DVL, by their means and scatter on the axes."
    ]
    return Table(("simulator", "error, mm/s", "energy distance", "alike: below", "p"), rows, notes=notes)


def _noise(noise: Sequence[ComparedNoise]) -> Table:
    rows = [
        (
            each.name, Cell(each.status.words, CELLS.get(each.status, "")), interval(each.vehicle),
            interval(each.simulator), each.unit, p_value(each.p), each.note,
        )
        for each in noise
    ]  # fmt: skip
    head = ("property", "", "vehicle (95 %)", "simulator (95 %)", "unit", "p, adjusted", "")
    return Table(head, rows, words=len(head))


def _levels(c: UnpairedComparison) -> Table:
    rows = [(name, *(f"{MM * each:.1f}" for each in both)) for name, both in c.levels.items()]
    return Table(("noise of the DVL by regime, mm/s", "vehicle", "simulator"), rows)


def _not_shown(c: UnpairedComparison) -> list[Table]:
    names = sorted({name for side in c.not_shown.values() for name in side})
    if not names:
        return []
    sides: Mapping[str, Mapping[str, str]] = c.not_shown
    rows = [(name, *(sides[side].get(name, "would have shown") for side in sides)) for name in names]
    return [Table(("effect", *sides), rows, words=1 + len(sides))]
