"""Run and score the pairs: compare each blindly, note the answer, go on where it was stopped, count.

The folder holds ``pairs.json`` (the seed), ``sealed/`` (truths, which the comparison is not told of) and
``answers.jsonl``.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics

from .pairs import make_pair, pair_id
from .run import read_answers
from .scored import NOT_SCORED_PARAMETERS

Document = dict[str, Any]
VERSION = 1
# Levels on two sides that are closer than this are no difference that one could be blamed for not claiming, or claiming
SAME_LEVEL = 1.02


def compared(vehicle: Path, simulator: Path, mounting: Mapping[str, Sequence[float]]) -> Document:
    """What `dvl-calib diagnose VEHICLE --simulator SIMULATOR` says, as in its JSON."""
    from dvl_calib_ros.unpaired.both_sides import RecordedSide
    from dvl_calib_ros.unpaired.comparison import compare
    from dvl_calib_ros.unpaired.results import unpaired_document

    def source(side: str, path: Path) -> RecordedSide:
        roll, pitch, yaw = mounting[side]
        return RecordedSide(
            open_recording([path]), Parameters(min_speed=0.0, mounting_rpy=(roll, pitch, yaw)), Topics()
        )

    return unpaired_document(compare(source("vehicle", vehicle), source("simulator", simulator)))


def run_pairs(
    folder: Path,
    seed: int,
    numbers: Iterable[int],
    on_progress: Callable[[float], None] = lambda _: None,
    seconds: float = math.inf,
) -> list[tuple[Document, Document]]:
    """(truth, answer) of pairs; those that the folder has already are not compared again. Raises InputError.

    seconds: no further pair is begun after this time.
    """
    until = time.monotonic() + seconds
    _prepare(folder, seed)
    done = read_answers(folder / "answers.jsonl")
    wanted = list(numbers)
    found = []
    with (folder / "answers.jsonl").open("a", encoding="utf-8") as file:
        for place, number in enumerate(wanted, start=1):
            name = pair_id(number, seed)
            if name not in done and time.monotonic() > until:
                break
            if name not in done:
                done[name] = _answer(number, seed, folder)
                file.write(json.dumps(done[name], sort_keys=True, default=float) + "\n")
                file.flush()
                os.fsync(file.fileno())
            truth = json.loads((folder / "sealed" / f"{name}.json").read_text(encoding="utf-8"))
            found.append((truth, done[name]))
            on_progress(place / len(wanted))
    return found


def _prepare(folder: Path, seed: int) -> None:
    (folder / "sealed").mkdir(parents=True, exist_ok=True)
    header = json.dumps({"pairs of seed": seed, "version": VERSION}) + "\n"
    path = folder / "pairs.json"
    if not path.exists():
        save_text(path, header)
    elif path.read_text(encoding="utf-8") != header:
        raise InputError(f"{path}: holds other pairs; give another folder by --out, or the same seed")


def _answer(number: int, seed: int, folder: Path) -> Document:
    name = pair_id(number, seed)
    bags = folder / "bags" / name
    shutil.rmtree(bags, ignore_errors=True)
    pair = make_pair(number, seed, bags)
    save_text(folder / "sealed" / f"{name}.json", json.dumps(pair.truth.document(), indent=1) + "\n")
    began = time.process_time()
    try:
        document = compared(pair.vehicle, pair.simulator, pair.truth.mounting_rpy)
    except Exception as error:  # one pair that breaks the comparison must not end the trial: it is scored as wrong
        document = {"verdict": "failed", "message": f"{type(error).__name__}: {error}", "effects": [], "noise": []}
    shutil.rmtree(bags)
    return {"id": name, "document": document, "cpu_s": round(time.process_time() - began, 2)}


# ------------------------------------------------------------------ scoring


@dataclass(frozen=True)
class PairScore:
    """One pair. first: whether what is missing was named first, by its name, and by the set of names; None where
    nothing is missing. claimed: effects claimed to differ, wrong: those that do not. noise_claimed, noise_wrong:
    likewise. held, intervals: sizes inside their 95 % intervals, of so many. told_apart: whether the last model of the
    ladder is told from the recording; None where not all was found.
    """

    first: bool | None
    first_in_set: bool | None
    claimed: int
    wrong: tuple[str, ...]
    noise_claimed: int
    noise_wrong: tuple[str, ...]
    held: int
    intervals: int
    failed: bool
    told_apart: bool | None


CLAIMS = ("missing_in_simulator", "other_size", "only_in_simulator")
TOLD_APART = 0.05


def score_pair(truth: Document, answer: Document) -> PairScore:
    """Join a truth with its answer."""
    document = answer["document"]
    real, made = truth["vehicle"], truth["simulator"]
    differing = {name for name in {*real, *made} if real.get(name) != made.get(name)}
    missing = {name for name in real if name not in made}
    claims = [each for each in document["effects"] if each["status"] in CLAIMS]
    wrong = [each["name"] for each in claims if not _names(each) & differing]
    first = in_set = None
    if missing:
        lacking = [each for each in claims if each["status"] == "missing_in_simulator"]
        first = bool(lacking) and lacking[0]["name"] in missing
        in_set = bool(lacking) and bool(_names(lacking[0]) & missing)
    held, intervals = _intervals(document["effects"], {"vehicle": real, "simulator": made})
    noise = [each["name"] for each in document["noise"] if each["status"] in CLAIMS]
    noise_wrong = [name for name in noise if not _noise_differs(name, truth["noise"])]
    return PairScore(
        first, in_set, len(claims), tuple(wrong), len(noise), tuple(noise_wrong), held, intervals,
        document["verdict"] == "failed", _told_apart(document, missing, wrong),
    )  # fmt: skip


def _told_apart(document: Document, missing: Set[str], wrong: Sequence[str]) -> bool | None:
    named = {name for each in document["effects"] if each["status"] == "missing_in_simulator" for name in _names(each)}
    if wrong or not missing <= named or not document.get("shrinks") or document["vehicle"]["verdict"] == "unknown":
        return None
    return bool(document["shrinks"][-1]["p"] < TOLD_APART)


def _names(effect: Document) -> set[str]:
    return {effect["name"], *effect["equivalent_to"]}


def _intervals(effects: Sequence[Document], truth: Mapping[str, Document]) -> tuple[int, int]:
    """Sizes of true effects that were named, and found on the side that has them."""
    held = n = 0
    for effect in effects:
        for side, faults in truth.items():
            there = effect["status"] != ("only_in_simulator" if side == "vehicle" else "missing_in_simulator")
            if effect["name"] not in faults or not there:
                continue
            for parameter, value in effect[side].items():
                if parameter in NOT_SCORED_PARAMETERS or value["value"] is None:
                    continue
                low, high = value["ci95"]
                true = faults[effect["name"]].get(parameter)
                if true is not None and math.isfinite(low) and math.isfinite(high):
                    n += 1
                    held += low <= true <= high
    return held, n


def _noise_differs(name: str, noise: Mapping[str, Mapping[str, float]]) -> bool:
    """Whether a property really differs. Noise that grows, or is slow, changes the level and the tails as well."""
    real, made = noise["vehicle"], noise["simulator"]
    made_growing = made.get("growth", 0.0) > 0.0
    if name.startswith("level"):
        ratio = real[name] / made[name]
        return made_growing or max(ratio, 1.0 / ratio) > SAME_LEVEL
    if name.startswith("growth"):
        return made_growing
    if name == "heavy_tails":
        return made_growing or real["outliers"] > 0.0 or real["repeats"] > 0.0
    if name == "colour":
        return made["colour"] > 0.0
    return real.get(name, 0.0) != made.get(name, 0.0)


@dataclass(frozen=True)
class Figure:
    """A count of n, with a 95 % interval, and what is wanted."""

    name: str
    count: int
    n: int
    target: str

    def __str__(self) -> str:
        if not self.n:
            return f"{self.name}: none to count"
        low, high = binomtest(self.count, self.n).proportion_ci(method="exact")
        share = 100.0 * self.count / self.n
        return (
            f"{self.name}: {share:.1f} % ({self.count} of {self.n}; 95 %: {100 * low:.1f} .. {100 * high:.1f}); "
            f"wanted {self.target}"
        )


def figures(scores: Sequence[PairScore]) -> list[Figure]:
    """Of all pairs."""
    missing = [each for each in scores if each.first is not None]
    all_found = [each for each in scores if each.told_apart is not None]
    return [
        Figure("missing effect named first", sum(bool(s.first) for s in missing), len(missing), ">= 90 %"),
        Figure("the same, by the set of names", sum(bool(s.first_in_set) for s in missing), len(missing), ">= 90 %"),
        Figure("effects claimed to differ that do not", sum(len(s.wrong) for s in scores),
               sum(s.claimed for s in scores), "<= 1 %"),
        Figure("pairs with such a claim", sum(bool(s.wrong) for s in scores), len(scores), "<= 1 %"),
        Figure("noise claimed to differ that does not", sum(len(s.noise_wrong) for s in scores),
               sum(s.noise_claimed for s in scores), "<= 1 %"),
        Figure("sizes inside their 95 % intervals", sum(s.held for s in scores), sum(s.intervals for s in scores),
               "92 .. 98 %"),
        Figure("all found, and the last model not told from the recording", sum(not s.told_apart for s in all_found),
               len(all_found), ">= 95 %"),
        Figure("failed", sum(s.failed for s in scores), len(scores), "0"),
    ]  # fmt: skip


def misses(found: Sequence[tuple[Document, Document]]) -> list[str]:
    """A line on each pair that was not right."""
    lines = []
    for truth, answer in found:
        score = score_pair(truth, answer)
        if score.first is False or score.wrong or score.noise_wrong or score.failed:
            claims = [(e["name"], e["status"]) for e in answer["document"]["effects"] if e["status"] in CLAIMS]
            said = ", ".join(f"{name} ({status})" for name, status in claims) or answer["document"]["verdict"]
            noise = f"; noise, wrongly: {', '.join(score.noise_wrong)}" if score.noise_wrong else ""
            there = [", ".join(truth[side]) or "nothing" for side in ("vehicle", "simulator")]
            lines.append(
                f"{truth['id']} {truth['what']} of {truth['row']} (vehicle {there[0]}, simulator {there[1]}): "
                f"said {said}{noise}"
            )
    return lines


def by_row(found: Sequence[tuple[Document, Document]]) -> dict[str, tuple[int, int]]:
    """Row of the table of simulators -> pairs that were right in every claim on effects, of so many."""
    right: Counter[str] = Counter()
    n: Counter[str] = Counter()
    for truth, answer in found:
        score = score_pair(truth, answer)
        n[truth["row"]] += 1
        right[truth["row"]] += score.first is not False and not score.wrong and not score.failed
    return {row: (right[row], n[row]) for row in n}
