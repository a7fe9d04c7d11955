"""Replay with checks that the recordings belong together and that `initial_calibration` fits the data.

Several recordings are also calibrated individually and compared, because the average of two mountings is neither.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..calibration.comparison.mounting_change import (
    Comparison,
    between,
    compare,
    contradicts,
    moved_in_words,
    scale_changed,
    suspicious,
)
from ..calibration.models import MODELS
from ..calibration.models.parameters import Parameters
from ..calibration.results.extrinsics import Extrinsics
from ..calibration.results.held_out_verification import shown_misalignment, shown_mounting
from ..calibration.results.results import Result, Verification
from ..calibration.streams.stream_order import DROPOUT_NS
from ..errors import InputError
from ..files.mounting import load_extrinsics
from ..recordings.recording import Recording, open_recording, together
from ..recordings.topics import Topics
from ..verdict.kinds import Severity
from ..verdict.reasons import Reason, finding, is_cause
from .replay import Replayed, extrinsics_of_replay, replay

# longest overlap of the files of one recording, by messages in transit when the next file began
OVERLAP_NS = 10_000_000_000
# pauses between recordings are no dropouts
DROPOUTS = "DVL_DROPOUTS"


@dataclass(frozen=True)
class Recordings:
    """Comparison of several recordings that were calibrated individually.

    comparison: None if fewer than two recordings could be calibrated.
    unchecked: names of recordings that could not be.
    overlapping: names of two with DVL data at the same time.
    pauses_ns: gaps between recordings.
    number: number of recordings, counting bags of the same time as one.
    """

    comparison: Comparison | None
    unchecked: tuple[str, ...]
    overlapping: tuple[str, str] | None
    pauses_ns: tuple[int, ...]
    number: int

    def objections(self, model: str, parted: bool) -> list[Reason]:
        """Return reasons against using a common estimate of all recordings by this model.

        parted: whether the model has a delay per recording.
        """
        found: list[Reason] = []
        if self.overlapping is not None:
            first, second = self.overlapping
            found.append(finding("BAGS_OVERLAP", first=first, second=second))
        if self.comparison is None:
            return found
        for change in (*self.comparison.moved, *self.comparison.suspicious):
            if change in self.comparison.contradicting:
                words = moved_in_words(change.difference)
                found.append(finding("BAGS_MOUNTING_DIFFERS", moved=words, between=between(change)))
            else:
                found.append(suspicious(change))
        if self.comparison.clock_changed and "time_offset" in MODELS[model].state_names and not parted:
            found.append(finding("BAGS_DELAY_CHANGED"))
        return [*found, *map(scale_changed, self.comparison.scale_changed)]


def checked_replay(
    recording: Recording | Sequence[Path],
    parameters: Parameters,
    topics: Topics | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    *,
    merge: bool = False,
    with_history: bool = False,
    mounting_is_guessed: bool = False,
    contradictions: Sequence[Reason] = (),
) -> Replayed:
    """Replay after checking several recordings, or an initial calibration, for consistency.

    merge: calibrate several recordings together even if the mounting moved; the move becomes a note instead of the
      verdict. An `initial_calibration` that the data contradict is not used, with a finding.
    mounting_is_guessed: mounting_rpy was not configured; if the estimate is far from it, the estimate becomes the
      mounting, and the replay is repeated.
    contradictions: findings of discovery; those on frames affect the verdict. Raises InputError.
    """
    topics = topics or Topics()
    if not isinstance(recording, Recording):
        recording = open_recording(recording, topics, parameters)
    recordings = None
    parts = len(recording.each) if len(recording.each) > 1 else 0
    total = parts + 1 + bool(parameters.initial_calibration)

    def progress_of(index: int) -> Callable[[float], None]:
        return lambda share: on_progress((index + share) / total)

    if parts:
        recordings = _calibrated_individually(recording, parameters, topics, progress_of)
    replayed = _replay_from_valid_start(recording, parameters, topics, progress_of, parts, with_history)
    if mounting_is_guessed and (rpy := _mounting_instead_of_guess(replayed.result)) is not None:
        return checked_replay(
            recording, parameters.replace(mounting_rpy=rpy), topics, on_progress, merge=merge,
            with_history=with_history, contradictions=contradictions,
        )  # fmt: skip
    if contradictions:
        result = replayed.result
        judged = {name: _with_frame_doubts(verified, contradictions) for name, verified in result.verifications.items()}
        replayed = replace(replayed, result=replace(result, verifications=judged))
    return replayed if recordings is None else _with_common_verdict(replayed, recordings, merge)


# Findings of discovery that reject a calibration.
DECISIVE = "DVL_SIDE_INVERTED", "DVL_TURNS_WITH_HEADING", "TRAVELS_ASTERN"


def _with_frame_doubts(verification: Verification, contradictions: Sequence[Reason]) -> Verification:
    """Add ambiguous frames to the verdict and, if the calibration is rejected anyway, their likely cause.

    Without a reference nothing else rejects these axes of the DVL or a vehicle that travels astern.
    """
    is_rejected = verification.verdict is Severity.REJECT
    kept = []
    for contradiction in contradictions:
        if contradiction.severity is Severity.MARGINAL:
            kept.append(contradiction)
        elif contradiction.code in DECISIVE or (is_rejected and is_cause(contradiction)):
            kept.append(contradiction.weighed(Severity.REJECT))
    if any(reason.code == "MOUNTING_CONTRADICTED" for reason in kept):  # which says it with the option to type
        without = [reason for reason in verification.reasons if "MOUNTING_FITS" not in [c.code for c in reason.causes]]
        verification = replace(verification, reasons=tuple(without))
    return verification.with_objections(kept) if kept else verification


def _mounting_instead_of_guess(result: Result) -> tuple[float, float, float] | None:
    """Return the mounting (rad, whole degrees) that replaces a guessed one; None if it is close to the guess."""
    parameters, estimate = Parameters.from_mapping(result.parameters), result.estimate
    model, state = MODELS[estimate.model], estimate.of_recording
    about = shown_misalignment(model, state, parameters)
    if math.atan(float(np.linalg.norm(about))) < parameters.reject_misalignment or parameters.initial_calibration:
        return None
    found = np.array(shown_mounting(model, state, parameters))
    # a difference that may be a misalignment remains one
    guessed = np.array(parameters.mounting_rpy)
    is_other = np.cos(found - guessed) < math.cos(0.5 * parameters.reject_misalignment)
    roll, pitch, yaw = np.where(is_other, found, guessed).tolist()
    return roll, pitch, yaw


class _Bag(NamedTuple):
    recording: Recording
    name: str
    from_ns: int
    to_ns: int
    has_dvl: bool


def _calibrated_individually(
    recording: Recording, parameters: Parameters, topics: Topics, progress_of: Callable[[int], Callable[[float], None]]
) -> Recordings:
    """Calibrate with each recording individually, without any initial calibration."""
    bags = _bags(recording, topics)
    alone = parameters.replace(initial_calibration="")
    found: list[Extrinsics] = []
    unchecked: list[str] = []
    groups = _recordings(bags)
    overlapping = next((pair for pair in map(_overlap, groups) if pair is not None), None)
    # bags with DVL data at the same time are calibrated individually
    groups = [part for group in groups for part in ([[bag] for bag in group] if _overlap(group) else [group])]
    for index, group in enumerate(groups):
        name = " + ".join(bag.name for bag in group)
        if len(groups) == 1 or not any(bag.has_dvl for bag in group):
            continue
        try:
            replayed = replay(
                together([bag.recording for bag in group]), alone, topics, progress_of(index), judged=False
            )
        except InputError:  # too little DVL data; the replay of all recordings reports the fault
            unchecked.append(name)
            continue
        extrinsics = extrinsics_of_replay(replayed, name)
        if extrinsics is None or not extrinsics.shown[:3].any():
            unchecked.append(name)
        else:
            found.append(extrinsics)
    aided = [reason for reason in found if MODELS[reason.model].aided]
    found = aided or found  # models without GNSS assume no current, so they are not compared with models with GNSS
    try:
        comparison = compare(found) if len(found) > 1 else None
    except InputError:
        comparison = None
    with_dvl = [bag for bag in bags if bag.has_dvl]
    gaps_ns = (after.from_ns - before.to_ns for before, after in pairwise(with_dvl))
    pauses_ns = tuple(gap_ns for gap_ns in gaps_ns if gap_ns > DROPOUT_NS)
    number = sum(any(bag.has_dvl for bag in group) for group in groups)
    return Recordings(comparison, tuple(unchecked), overlapping, pauses_ns, number)


def _bags(recording: Recording, topics: Topics) -> list[_Bag]:
    """Return the bags in order of time, without empty ones."""
    short = [path.name or str(path) for path in recording.paths]
    names = short if len(set(short)) == len(short) else list(map(str, recording.paths))
    bags = []
    for member, name in zip(recording.each, names, strict=True):
        if member.types:
            has_dvl = member.counts[topics.found_in(member.types).dvl] > 0
            bags.append(_Bag(member, name, *member.span_ns, has_dvl))
    return sorted(bags, key=lambda bag: bag.from_ns)


def _recordings(bags: Sequence[_Bag]) -> list[list[_Bag]]:
    """Group bags that overlap in time: they are parts of one recording."""
    groups: list[list[_Bag]] = []
    until_ns = 0
    for bag in bags:
        if groups and bag.from_ns <= until_ns:
            groups[-1].append(bag)
            until_ns = max(until_ns, bag.to_ns)
        else:
            groups.append([bag])
            until_ns = bag.to_ns
    return groups


def _overlap(group: Sequence[_Bag]) -> tuple[str, str] | None:
    """Return the names of two bags whose DVL data overlap for longer than `OVERLAP_NS`."""
    with_dvl = [bag for bag in group if bag.has_dvl]
    for index, bag in enumerate(with_dvl):
        for other in with_dvl[index + 1 :]:
            if min(bag.to_ns, other.to_ns) - other.from_ns > OVERLAP_NS:
                return bag.name, other.name
    return None


def _with_common_verdict(replayed: Replayed, recordings: Recordings, merge: bool) -> Replayed:
    """Add the verdict and notes from comparing the recordings."""
    result = replayed.result
    verifications = {}
    notes: list[str] = []
    for name, verification in result.verifications.items():
        objections = recordings.objections(name, parted=len(result.days) >= recordings.number)
        if name == result.selected and merge:
            notes += [f"merged as asked: {objection.sentence}" for objection in objections]
        verifications[name] = verification if merge else verification.with_objections(objections)
    if recordings.unchecked:
        names = ", ".join(recordings.unchecked)
        notes.append(f"{names}: too little to be calibrated alone, so its mounting cannot be compared with the others'")
    found, counts = _without_pauses(replayed.findings, result.counts, len(recordings.pauses_ns))
    left_out = {str(reason) for reason in replayed.findings} - {str(reason) for reason in found}
    kept = [note for note in replayed.notes if note not in left_out]
    kept += [str(reason) for reason in found if str(reason) not in kept]
    return replace(
        replayed,
        result=replace(result, verifications=verifications, counts=counts),
        findings=found,
        notes=(*notes, *kept),
        recordings=recordings.comparison,
        pause_s=1e-9 * sum(recordings.pauses_ns),
    )


def _without_pauses(
    findings: tuple[Reason, ...], counts: Mapping[str, Mapping[str, int]], pauses: int
) -> tuple[tuple[Reason, ...], Mapping[str, Mapping[str, int]]]:
    """Remove the pauses between recordings from the dropouts."""
    dropouts = counts["dvl"]["dropouts"]
    remaining = max(dropouts - pauses, 0)
    if remaining == dropouts:
        return findings, counts
    kept = [reason for reason in findings if reason.code != DROPOUTS]
    if remaining:
        kept.append(finding(DROPOUTS, count=remaining))
    return tuple(kept), {**counts, "dvl": {**counts["dvl"], "dropouts": remaining}}


def _replay_from_valid_start(
    recording: Recording,
    parameters: Parameters,
    topics: Topics,
    progress_of: Callable[[int], Callable[[float], None]],
    first: int,
    with_history: bool,
) -> Replayed:
    """Replay from `initial_calibration`, or without it and with a finding if the data contradict it."""
    saved = parameters.initial_calibration
    replayed = replay(recording, parameters, topics, progress_of(first), with_history=with_history)
    if not saved:
        return replayed
    alone = replay(
        recording, parameters.replace(initial_calibration=""), topics, progress_of(first + 1), with_history=with_history
    )
    found = extrinsics_of_replay(alone, "these data")
    contradiction = None if found is None else contradicts(found, load_extrinsics(Path(saved), saved))
    if contradiction is None:
        return replayed
    warning = finding("INITIAL_CONTRADICTED", file=saved, difference=moved_in_words(contradiction))
    return replace(alone, findings=(*alone.findings, warning), notes=(*alone.notes, str(warning)))


class Calibrated(NamedTuple):
    """Calibration with one recording. notes: sentences on damaged or missing data."""

    extrinsics: Extrinsics
    notes: list[str]


def calibrated(
    recording: Recording,
    parameters: Parameters,
    topics: Topics,
    name: str,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Calibrated:
    """Calibrate with a recording, called `name` in messages. Raises InputError."""
    replayed = replay(recording, parameters, topics, on_progress)
    found = extrinsics_of_replay(replayed, name)
    if found is None:
        raise InputError(f"{name}: none of its samples could be used to calibrate; examine it with dvl-calib doctor")
    known = {str(reason) for reason in replayed.findings}
    return Calibrated(found, [note for note in replayed.notes if note not in known])
