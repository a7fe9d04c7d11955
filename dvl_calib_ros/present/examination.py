"""Document of an examination (``dvl-calib doctor``)."""

from __future__ import annotations

from collections.abc import Sequence

from ..examination.examine import Content, Examination, Shown
from ..files.parameter_files import as_yaml
from ..recordings.topics import Topics
from ..verdict.kinds import Severity
from .document import Answer, Columns, Commands, Document, FindingLine, Section, Sentence, bar, table_by
from .numbers import options, typed

SHOWN_NOTE = "A full bar is fine (target_drift). Not observable: rows with an entry in 'needs'."
NO_REFERENCE = "Without a reference only pitch is observable, and yaw on opposite headings."
NO_SAMPLE = "Nothing is observable without a usable sample."
ANSWERS = {
    "yes": (Severity.ACCEPT, "This recording can calibrate the DVL."),
    "partly": (Severity.MARGINAL, "This recording can calibrate a part of the DVL's errors."),
    "no": (Severity.REJECT, "This recording cannot calibrate the DVL without changes."),
}


def examination(examined: Examination, is_live: bool = False, named: Sequence[str] = ()) -> Document:
    """Lay out content, faults, observable quantities and the next command.

    is_live: recorded from a running system only for this. named: given options, for the next command.
    """
    severity, answer = ANSWERS[examined.verdict]
    names = ", ".join(path.name or str(path) for path in examined.paths)
    found, discovery = examined.findings, examined.discovery
    found = (*found, *(each for each in examined.against if each.says not in {one.says for one in found}))
    lines = [Sentence(each, soft=True) for each in (*discovery.found[1:], *(note.sentence for note in discovery.notes))]
    nothing = NO_SAMPLE if examined.has_reference else NO_REFERENCE
    return Document(
        title="Examination of a recording",
        subtitle=names,
        answer=Answer(examined.verdict, severity, [f"{answer} {examined.why}".rstrip()]),
        warnings=examined.notes,
        sections=[
            Section(f"{names}: {examined.seconds:.0f} s", [table_by(CONTENTS, examined.contents, words=5), *lines]),
            Section(
                f"Findings: {len(found)}" if found else f"Nothing {'else ' if examined.notes else ''}wrong was found",
                list(map(FindingLine, found)) or [Sentence("")],
            ),
            Section(
                f"Observable from the motion (median speed {examined.speed_mps:.2f} m/s)",
                [table_by(SHOWN, examined.shown, (SHOWN_NOTE,), words=4)] if examined.shown else [Sentence(nothing)],
            ),
            Section("", [Commands(next_commands(examined, is_live, named))]),
        ],
    )


CONTENTS: Columns[Content] = {
    "": lambda each: each.role,
    "topic": lambda each: each.topic,
    "frame": lambda each: each.frame_id,
    "Hz": lambda each: f"{each.rate_hz:.3g}" if each.rate_hz else "–",
    "claimed σ": lambda each: each.covariance.removesuffix(" always"),
}
SHOWN: Columns[Shown] = {
    "": lambda each: each.name,
    "shown": lambda each: bar(each.share, "good" if each.share >= 1.0 else "off" if not each.needs else "bad"),
    "±1σ": lambda each: f"±{each.std:.2f} {each.unit}",
    "needs": lambda each: each.needs,
}


def next_commands(examined: Examination, is_live: bool, named: Sequence[str]) -> list[tuple[str, str]]:
    """Return the commands to type next."""
    if is_live:  # run the node with the discovered topics and parameters
        discovery, default = examined.discovery, Topics()
        names = ((role, getattr(discovery.topics, role)) for role in ("dvl", "gnss", "imu"))
        topics = [(role, name) for role, name in names if name.lstrip("/") not in ("", getattr(default, role))]
        values = {name: list(value) if isinstance(value, tuple) else value for name, value in discovery.values.items()}
        arguments = options(topics, [f"{name}:={as_yaml(value)}" for name, value in values.items()])
        return [("next", typed("run --watch", (), *arguments, "-p", "result_file:=calibration.yaml"))]
    given = [
        word
        for found in (*examined.findings, *examined.against)
        if found.code in ("CLOCKS_APART", "DOCTOR_COVARIANCE")
        for word in found.remedy.partition("for this bag: ")[2].split(" leaves")[0].split()
    ]
    if examined.verdict == "no" and not given:
        return [("next", f"{typed('doctor', (), 'BAG', *named)}   (once it is recorded again)")]
    return [("next", typed("replay", examined.paths, *named, *given, "--save", "calibration.yaml"))]
