"""Reasons about data, configuration, network and result: a code, its severity and its numbers.

Sentence, remedy and page come from the tables in this room; terminal, report, JSON, /diagnostics and docs all use them.
Codes are stable, because users search for them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from .configurations import CONFIGURATIONS, DISCOVERIES
from .findings import DOCTOR, FINDINGS
from .kinds import Kind, Severity
from .verdicts import COMPARISONS, DIAGNOSES, MANOEUVRES, SELECTIONS, UNPAIRED, VERDICTS

_FIELD = re.compile(r"\{[^{}]*\}")
# tables by name
TABLES: Mapping[str, Sequence[Kind]] = {
    "findings": FINDINGS,
    "doctor": DOCTOR,
    "verdicts": VERDICTS,
    "comparisons": COMPARISONS,
    "configurations": CONFIGURATIONS,
    "selections": SELECTIONS,
    "diagnoses": DIAGNOSES,
    "unpaired": UNPAIRED,
    "discoveries": DISCOVERIES,
    "manoeuvres": MANOEUVRES,
}
KINDS: Mapping[str, Kind] = {kind.code: kind for kinds in TABLES.values() for kind in kinds}
_WORST_FIRST = (Severity.ERROR, Severity.REJECT, Severity.MARGINAL, Severity.WARNING, Severity.ACCEPT)


@dataclass(frozen=True)
class Reason:
    """Instance of a table entry with its values. ``str()`` gives the text for users.

    A value may be a reason, or several; its text is the reasons' sentences.
    """

    code: str
    severity: Severity
    numbers: Mapping[str, Any]

    @property
    def says(self) -> str:
        """The fact, as a sentence."""
        return KINDS[self.code].says.format(**self._words)

    @property
    def remedy(self) -> str:
        """What to do; '' if there is nothing to do."""
        return KINDS[self.code].remedy.format(**self._words)

    @property
    def page(self) -> str:
        """Page of the documentation."""
        return KINDS[self.code].page

    @property
    def sentence(self) -> str:
        """Text as a reason of a verdict. A finding has no remedy here, because it is listed with the warnings."""
        return self.says if KINDS[self.code].is_finding or not self.remedy else f"{self.says}: {self.remedy}"

    @property
    def full_sentence(self) -> str:
        """`sentence` with a capital and a full stop."""
        return full(self.sentence)

    @property
    def _words(self) -> dict[str, Any]:
        return {
            name: " and ".join(cause.sentence for cause in causes) if (causes := _causes(number)) else number
            for name, number in self.numbers.items()
        }

    @property
    def causes(self) -> tuple[Reason, ...]:
        """Reasons among the values."""
        return tuple(cause for number in self.numbers.values() for cause in _causes(number))

    def __str__(self) -> str:
        remedy = self.remedy
        return f"{self.says}; {remedy} [{self.code}]" if remedy else f"{self.says} [{self.code}]"

    def weighed(self, severity: Severity) -> Reason:
        """Return the same reason with another severity."""
        return replace(self, severity=severity)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "code": self.code,
            "severity": self.severity.value,
            "says": self.says,
            "remedy": self.remedy,
            "page": self.page,
            "numbers": {name: _plain(value) for name, value in self._words.items()},
            **({"causes": [cause.as_dict() for cause in self.causes]} if self.causes else {}),
        }


def finding(code: str, **numbers: object) -> Reason:
    """Return the reason of this code with its values. Raises KeyError for an unknown code or a missing value."""
    found = Reason(code, KINDS[code].severity, numbers)
    str(found)  # a missing value raises here rather than when the text is read
    return found


# Causes in causal order, by the beginnings of their codes: frames and signs, clocks, mounting.
_CAUSES = (
    ("DOCTOR_", "DVL_SIDE_INVERTED", "DVL_TURNS_WITH_HEADING", "FRAMES_AMBIGUOUS", "GRAVITY_"),
    ("CLOCK_DRIFTS", "CLOCK_FAR", "CLOCK_LEAPS", "CLOCKS_APART"),
    ("MOUNTING_CONTRADICTED", "MOUNTING_FITS", "TRAVELS_"),
)


def _clock_cost(numbers: Mapping[str, Any]) -> float:
    return 1000.0 * math.radians(numbers["degrees"])


# Drift on a straight leg, m per km, of ambiguities that σ includes; 0 for a deviation within 2 σ. A bias of the DVL
# costs nothing at the speeds driven.
_COST_OF_AMBIGUITY: Mapping[str, Callable[[Mapping[str, Any]], float]] = {
    "CLOCK_ON_TURN": _clock_cost,
    "CLOCK_OR_ARM": _clock_cost,
    "HEADING_DEVIATION": lambda numbers: numbers["cost"] if numbers["rms"] > 2.0 * numbers["std"] else 0.0,
    "ONE_SPEED": lambda _: 0.0,
}


def of_consequence(reasons: Iterable[Reason], target_m_per_km: float) -> list[Reason]:
    """Omit warnings that matter little for an accepted calibration: their drift is below the target."""
    return [
        reason
        for reason in reasons
        if reason.severity is not Severity.WARNING
        or reason.code not in _COST_OF_AMBIGUITY
        or _COST_OF_AMBIGUITY[reason.code](reason.numbers) > target_m_per_km
    ]


def causal_rank(reason: Reason) -> int:
    """Return the place of a reason in causal order, from 0: frames and signs, clocks, mounting, all others."""
    is_wrong = reason.code == "CONFIGURATION_WRONG"
    code = reason.causes[0].code if is_wrong else reason.code
    first_not_listed = 0 if is_wrong else len(_CAUSES)
    return next((rank for rank, codes in enumerate(_CAUSES) if code.startswith(codes)), first_not_listed)


def is_cause(reason: Reason) -> bool:
    """Return whether a reason concerns frames, clocks or the configured mounting, which cause most other reasons."""
    return causal_rank(reason) < len(_CAUSES)


def by_severity(reasons: Iterable[Reason]) -> list[Reason]:
    """Sort by severity, the worst first; within one severity in causal order."""
    return sorted(reasons, key=lambda reason: (_WORST_FIRST.index(reason.severity), causal_rank(reason)))


def lookup(kinds: Iterable[Kind]) -> str:
    """Return a part of docs/troubleshooting.md: cause and remedy under each code, with … for fields."""
    texts = ((kind.code, _cause_and_remedy(kind)) for kind in kinds)
    return "\n".join(f"### {code}\n\n{text}\n" for code, text in texts if text)


def _cause_and_remedy(kind: Kind) -> str:
    remedy = _FIELD.sub("…", re.sub(r"^{\w+}", "", kind.remedy))
    return f"{kind.means} {full(remedy) if remedy else ''}".strip().replace("….", "…")


def _causes(value: object) -> tuple[Reason, ...]:
    found = value if isinstance(value, tuple) else (value,)
    return tuple(reason for reason in found if isinstance(reason, Reason))


def _plain(value: object) -> object:
    """Convert for JSON: numbers and truth values unchanged, all else as text."""
    value = value.item() if hasattr(value, "item") else value
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def full(sentence: str) -> str:
    """Return a sentence with a full stop, and a capital unless it begins with a name, such as a path."""
    first = sentence.split(" ", 1)[0].rstrip(",:;.?'")
    start = sentence[:1].upper() if first.replace("-", "").replace("'", "").isalpha() else sentence[:1]
    return f"{start}{sentence[1:]}" + ("" if sentence.endswith((".", "?")) else ".")
