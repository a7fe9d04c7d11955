"""A trial that ends: questions with goals, each asked until it is decided, of one commit, 900 cases at most.

A question is decided by Wald's sequential test between a share that is good enough and one that is not, 5 % wrong
either way; its share is told with exact (Clopper-Pearson) bounds beside it. Cases are balanced: questions that are open
take turns, each in the order of the plan, and a case counts for every question that it belongs to.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dvl_calib_ros.disk.atomic import save_text
from dvl_calib_ros.errors import InputError

from .figures import KNOWN, share
from .plan import Case, Family
from .run import Document, Trial, read_answers
from .scored import Scored, join
from .truth import Category, unseal

MOST_CASES = 900
WRONG = 0.05  # chance that a question is decided wrongly, either way
BATCH = 6  # cases for each process, before what is open is asked again
NULLS = (Category.NULL, Category.HARD_NULL)


@dataclass(frozen=True)
class Question:
    """What is asked of the diagnosis. good, bad: shares that are told apart, met and missed. most: cases at most.

    asks: which cases are run for it. right: of a case and its twin, if that is there; None if it does not count.
    """

    name: str
    goal: str
    good: float
    bad: float
    most: int
    asks: Callable[[Case], bool]
    right: Callable[[Scored, Scored | None], bool | None]
    with_twin: bool = False


def _exact(family: Family) -> Callable[[Scored, Scored | None], bool | None]:
    def right(case: Scored, twin: Scored | None) -> bool | None:
        is_asked = case.truth.family == family.value and case.truth.category in KNOWN
        return case.is_exact if is_asked else None

    return right


def _known_of(family: Family) -> Callable[[Case], bool]:
    return lambda case: case.family is family and case.category in KNOWN


def _no_alarm(case: Scored, twin: Scored | None) -> bool | None:
    return not case.claimed if case.is_null else None


def _is_strong(case: Case, q: float) -> bool:
    return case.family is Family.SIMULATED and case.category is Category.SINGLE and case.q >= q


def _detected(case: Scored, twin: Scored | None) -> bool | None:
    is_asked = case.truth.family == "simulated" and case.truth.category is Category.SINGLE
    return case.claimed if is_asked and case.truth.q_wanted >= 8.0 else None


def _first(case: Scored, twin: Scored | None) -> bool | None:
    is_asked = case.truth.family == "simulated" and case.truth.category is Category.SINGLE and case.separable
    return case.is_right_first if is_asked and case.truth.q_wanted >= 12.0 else None


def _unknown(case: Scored, twin: Scored | None) -> bool | None:
    is_asked = case.truth.category is Category.UNKNOWN and case.truth.q_wanted == 12.0
    return case.verdict == "unknown" if is_asked else None


def _same(case: Scored, twin: Scored | None) -> bool | None:
    return case.agrees_with(twin) if twin is not None else None


QUESTIONS = (
    Question("no false alarm on nulls", "> 98%", 0.998, 0.98, 250, lambda c: c.category in NULLS, _no_alarm),
    Question("detected, q >= 8", ">= 99%", 0.99, 0.95, 110, lambda c: _is_strong(c, 8.0), _detected),
    Question(
        "right effect first, q >= 12, where theory can tell", ">= 95%", 0.95, 0.88, 90,
        lambda c: _is_strong(c, 12.0), _first,
    ),
    Question(
        "unknown called unknown, q = 12", ">= 80%", 0.80, 0.65, 90,
        lambda c: c.category is Category.UNKNOWN and c.q == 12.0, _unknown,
    ),
    Question("exact, half_real", ">= 95%", 0.95, 0.88, 80, _known_of(Family.HALF_REAL), _exact(Family.HALF_REAL)),
    Question("exact, several", ">= 95%", 0.95, 0.88, 80, _known_of(Family.SEVERAL), _exact(Family.SEVERAL)),
    Question("exact, displaced", ">= 95%", 0.95, 0.88, 80, _known_of(Family.DISPLACED), _exact(Family.DISPLACED)),
    Question(
        "same with and without the vertical", ">= 95%", 0.95, 0.88, 120, lambda c: c.family is Family.HORIZONTAL, _same,
        with_twin=True,
    ),
)  # fmt: skip
assert sum(question.most for question in QUESTIONS) <= MOST_CASES


def decided(question: Question, hits: Sequence[bool]) -> str:
    """'met', 'missed', or '' while it is open."""
    k, n = sum(hits), len(hits)
    ratio = k * math.log(question.good / question.bad)
    ratio += (n - k) * math.log((1.0 - question.good) / (1.0 - question.bad))
    limit = math.log((1.0 - WRONG) / WRONG)
    return "met" if ratio >= limit else "missed" if ratio <= -limit else ""


def hits_of(question: Question, scored: Sequence[Scored]) -> list[bool]:
    """What a question's cases were, in their order; a case that broke the diagnosis is none."""
    by_id = {case.truth.id: case for case in scored}
    rights = (question.right(case, by_id.get(case.truth.twin or "")) for case in scored)
    return [right for right in rights if right is not None]


class Sequential:
    """The questions over the cases of a plan, in a trial's folder that is of one commit."""

    def __init__(self, trial: Trial, cases: Sequence[Case], commit: str) -> None:
        self.trial, self.cases, self.commit = trial, cases, commit
        self.queues = {question.name: list(self._queue(question)) for question in QUESTIONS}

    def run(self, on_progress: Callable[[float], None], seconds: float, clock: Callable[[], float]) -> list[Scored]:
        """Ask until all is decided, no case is left, or the time is over. Raises InputError for another commit."""
        self._hold_the_commit()
        until = clock() + seconds
        self.trial.run([])  # its folder is made, or held to be of this seed
        answers = read_answers(self.trial.answers)
        chosen: dict[str, Case] = {}
        while True:
            scored = self._scored(answers)
            batch = self._next(scored, chosen)
            if not batch or clock() >= until:
                return scored
            chosen |= {case.id: case for case in batch}
            answers |= self.trial.run(batch, seconds=max(until - clock(), 0.0))
            on_progress(min(len(chosen) / MOST_CASES, 1.0))

    def lines(self, scored: Sequence[Scored]) -> list[tuple[str, ...]]:
        """A row for each question: goal, share, bounds, n, how it stands; then what is only told."""
        rows = []
        for question in QUESTIONS:
            hits = hits_of(question, scored)
            rows.append(_row(question.name, question.goal, hits, decided(question, hits) or "open"))
        inside = [each.holds for case in scored if case.truth.category in KNOWN for each in case.intervals]
        rows.append(_row("true value in the 95 % interval", "93 .. 97%", inside, "told"))
        rows.append(_row("answers without a failure", "", [case.verdict != "failed" for case in scored], "told"))
        return rows

    def _scored(self, answers: Mapping[str, Document]) -> list[Scored]:
        """In the order in which they were answered: a test that stops has to see them so."""
        by_id = {case.truth.id: case for case in join(unseal(self.trial.sealed), answers)}
        return [by_id[key] for key in answers if key in by_id]

    def _queue(self, question: Question) -> Iterator[Case]:
        asked = (case for case in self.cases if question.asks(case))
        for case in asked:
            yield case
            if question.with_twin:
                yield case.twin

    def _next(self, scored: Sequence[Scored], chosen: Mapping[str, Case]) -> list[Case]:
        """Some cases, open questions in turns."""
        taken = {*chosen, *(case.truth.id for case in scored)}
        room = min(BATCH * max(self.trial.jobs, 1), MOST_CASES - len(taken))
        queues = []
        for question in QUESTIONS:
            queue = self.queues[question.name]
            n = sum(case.id in taken for case in queue)
            if not decided(question, hits_of(question, scored)) and n < question.most:
                queues.append([case for case in queue if case.id not in taken][: question.most - n])
        batch: dict[str, Case] = {}
        for turn in range(max(map(len, queues), default=0)):
            for queue in queues:
                if len(batch) < room and turn < len(queue):
                    batch[queue[turn].id] = queue[turn]
        return list(batch.values())

    def _hold_the_commit(self) -> None:
        path: Path = self.trial.folder / "commit.json"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            save_text(path, json.dumps({"commit": self.commit}) + "\n")
            return
        try:
            found = json.loads(path.read_text(encoding="utf-8"))["commit"]
        except (ValueError, KeyError, TypeError):
            found = "none that can be read"
        if found != self.commit:
            raise InputError(f"{path}: its answers are of commit {found}, not {self.commit}; give another --out")


def _row(name: str, goal: str, hits: Sequence[bool], stands: str) -> tuple[str, ...]:
    figure = share(name, ("", None), hits)
    if not hits:
        return name, goal, "-", "-", "0", stands
    return name, goal, f"{figure.value:.1%}", f"{figure.low:.1%} .. {figure.high:.1%}", str(figure.n), stands
