"""Run a trial: record each case, diagnose its bags without the truth, note the answer; go on where it was stopped.

A trial's folder holds ``trial.json`` (its seed), ``sealed/`` (the truth of each case, which the diagnosis is not told
of), ``answers.jsonl`` (one answer a line) and, while a case is worked on, its bags in ``bags/``.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.parallel import Lost, Workers, outcomes_as_done

from .cases import NotDrawnError
from .generator import record
from .scored import parameters_of
from .truth import Truth, seal
from .vehicle import FAULTS, Faults

Document = dict[str, Any]
Answerer = Callable[[Sequence[Path], Parameters], Document]
"""Bags of one vehicle, and what is known of its mounting -> the diagnosis as in its JSON."""


class Identified(Protocol):
    """A case, as far as a trial has to know it: its id, by which its answer is found again."""

    @property
    def id(self) -> str:
        """Says nothing about the case."""


class Recording(Protocol):
    """A recorded case: its bags, its truth, how the DVL is said to be mounted."""

    @property
    def bags(self) -> tuple[Path, ...]:
        """One per recording."""

    @property
    def truth(self) -> Truth:
        """To be sealed."""

    @property
    def mounting_rpy(self) -> tuple[float, float, float]:
        """rad."""

    def left_mps(self, said: Faults) -> float:
        """Error (rms) that is left if some faults are said; NaN where that cannot be told."""


Recorder = Callable[[Any, int, Path], Recording]
"""A case, a seed and a folder that does not exist yet -> the case, recorded there."""

# When a fault is there, of which an answer does not say
AT_ANY_TIME = {
    "water_lock": {"from_s": 0.0, "to_s": math.inf},
    "time_offset_jump": {"at_s": 0.0},
    "mounting_moved": {"from_recording": 1.0},
    "sound_speed_moved": {"from_recording": 1.0},
}
# The draws or the physics of the generator have changed: answers to older cases are answers to others
GENERATOR_VERSION = 7


def diagnose_bags(paths: Sequence[Path], parameters: Parameters) -> Document:
    """What `dvl-calib diagnose` says of the bags."""
    from dvl_calib_ros.diagnosis.diagnose import diagnose, diagnosis_document

    return diagnosis_document(diagnose(paths, parameters))


@dataclass(frozen=True)
class Trial:
    """A trial in a folder. jobs: processes, 0: one per core. keep_bags: leave the bags in the folder.

    beside: others that are asked of the same bags, by name; their answers stand beside the one. recorder: of the cases.
    """

    folder: Path
    seed: int = 0
    jobs: int = 0
    keep_bags: bool = False
    answerer: Answerer = diagnose_bags
    beside: Mapping[str, Answerer] = field(default_factory=dict)
    recorder: Recorder = record

    @property
    def sealed(self) -> Path:
        """Folder of the truths."""
        return self.folder / "sealed"

    @property
    def answers(self) -> Path:
        """File of the answers."""
        return self.folder / "answers.jsonl"

    def run(
        self,
        cases: Sequence[Identified],
        on_progress: Callable[[float], None] = lambda _: None,
        seconds: float = math.inf,
    ) -> dict[str, Document]:
        """Answers to the cases by their id, asked for where they are not in the folder yet. Raises InputError.

        seconds: no further case is begun after this time.
        """
        self.prepare()
        done = read_answers(self.answers)
        until = time.monotonic() + seconds
        left = [case for case in cases if case.id not in done]
        with self.answers.open("a", encoding="utf-8") as file:
            for number, answer in enumerate(self._answered(left, until), start=len(cases) - len(left) + 1):
                done[answer["id"]] = answer
                file.write(json.dumps(answer, sort_keys=True) + "\n")
                file.flush()
                os.fsync(file.fileno())
                on_progress(number / len(cases))
        return {case.id: done[case.id] for case in cases if case.id in done}

    def _answered(self, cases: Sequence[Identified], until: float) -> Iterator[Document]:
        work = partial(_answer, trial=self)
        begun = itertools.takewhile(lambda _: time.monotonic() < until, cases)
        for _, answer in outcomes_as_done(work, begun, Workers(self.jobs)):
            if isinstance(answer, Lost):
                raise InputError("a worker process was killed, perhaps for want of memory; use fewer --jobs")
            yield answer

    def prepare(self) -> None:
        """Make the folder, or check that what is in it is of this trial. Raises InputError."""
        self.sealed.mkdir(parents=True, exist_ok=True)
        header = {"seed": self.seed, "generator": GENERATOR_VERSION}
        path = self.folder / "trial.json"
        if not path.exists():
            save_text(path, json.dumps(header) + "\n")
            return
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            found = None
        if found != header:
            raise InputError(f"{path}: holds a trial of {found}, not {header}; give another folder or the same seed")


def _answer(case: Identified, trial: Trial) -> Document:
    """Record a case, seal its truth, and ask."""
    bags = trial.folder / "bags" / case.id
    shutil.rmtree(bags, ignore_errors=True)  # half written when the trial was stopped
    try:
        recorded = trial.recorder(case, trial.seed, bags)
    except NotDrawnError as error:
        shutil.rmtree(bags, ignore_errors=True)
        return {"id": case.id, "document": {"verdict": "not_drawn", "message": str(error)}, "cpu_s": 0.0}
    seal(recorded.truth, trial.sealed)
    answer = {"id": case.id, **_of(trial.answerer, recorded)}
    if trial.beside:
        answer["beside"] = {name: _of(answerer, recorded) for name, answerer in trial.beside.items()}
    if not trial.keep_bags:
        shutil.rmtree(bags)
    return answer


def _of(answerer: Answerer, recorded: Recording) -> Document:
    """What one says, CPU s that it took, and the error that it leaves."""
    began = time.process_time()
    document = _asked(answerer, recorded.bags, Parameters(mounting_rpy=recorded.mounting_rpy))
    seconds = time.process_time() - began
    return {"document": document, "cpu_s": round(seconds, 2), "left_mps": recorded.left_mps(said(document))}


def said(document: Document) -> Faults:
    """The faults that an answer names, as far as the generator knows such, at the sizes that it gives."""
    faults: dict[str, dict[str, float]] = {}
    for effect in document.get("effects", []):
        if known := FAULTS.get(effect["name"]):
            given = {name: each["value"] for name, each in parameters_of(effect).items()}
            usable = {name: value for name, value in given.items() if value is not None and not math.isnan(value)}
            faults[effect["name"]] = dict.fromkeys(known.typical, 0.0) | AT_ANY_TIME.get(effect["name"], {}) | usable
    return faults


def _asked(answerer: Answerer, bags: Sequence[Path], parameters: Parameters) -> Document:
    try:
        return answerer(bags, parameters)
    except InputError as error:  # it says that the bags cannot tell
        return {"verdict": "insufficient_excitation", "message": str(error)}
    except Exception as error:  # one case that breaks the diagnosis must not end the trial: it is scored as wrong
        return {"verdict": "failed", "message": f"{type(error).__name__}: {error}"}


def read_answers(path: Path) -> dict[str, Document]:
    """Answers of a file by the id of their case; a last line that was cut off is removed from the file."""
    if not path.exists():
        return {}
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        with path.open("r+", encoding="utf-8") as file:
            file.truncate(len(whole.encode()))
    try:
        answers: list[Mapping[str, Any]] = [json.loads(line) for line in whole.splitlines()]
        return {answer["id"]: dict(answer) for answer in answers}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not the answers of a trial ({error}); remove it or give another folder") from error
