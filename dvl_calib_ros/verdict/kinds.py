"""Entries of the tables of reasons, and their severities."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial


class Severity(Enum):
    """Severity of a reason.

    Of a finding: after a warning the calibration continues, after an error it learns nothing. Of a verdict: advice on
    the calibration; the worst reason decides the word.
    """

    ERROR = "error"
    WARNING = "warning"
    REJECT = "reject"
    MARGINAL = "marginal"
    ACCEPT = "accept"


# severities of a verdict by its word
VERDICT_WORDS: Mapping[str, Severity] = {
    severity.value: severity for severity in (Severity.ACCEPT, Severity.MARGINAL, Severity.REJECT)
}


@dataclass(frozen=True)
class Kind:
    """Entry of a table of reasons.

    Parameters
    ----------
    code
        Text to search for; its meaning never changes.
    says
        The fact, as a sentence with fields in braces for the values found.
    means
        Cause, for the documentation; '' if the sentence gives it.
    remedy
        What to do, also with fields; '' if there is nothing to do.
    severity
        Default severity.
    page
        Page of docs/ with the heading that explains more.

    Raises
    ------
    ValueError
        For a code that is not one word in capitals, or a finding without a remedy.
    """

    code: str
    says: str
    means: str = ""
    remedy: str = ""
    severity: Severity = Severity.WARNING
    page: str = "troubleshooting.md#all-warnings"

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Z][A-Z_]*[A-Z]", self.code):
            raise ValueError(f"code {self.code!r}: capitals and underscores only")
        if not (self.says and (self.remedy or not self.is_finding)):
            raise ValueError(f"{self.code}: says and a finding's remedy must not be empty")

    @property
    def is_finding(self) -> bool:
        """Whether it is a warning or error, listed with its remedy, rather than a reason of a verdict."""
        return self.severity in (Severity.ERROR, Severity.WARNING)


# Entries of one severity
error = partial(Kind, severity=Severity.ERROR)
warning = partial(Kind, severity=Severity.WARNING)
reject = partial(Kind, severity=Severity.REJECT)
marginal = partial(Kind, severity=Severity.MARGINAL)
accept = partial(Kind, severity=Severity.ACCEPT)


def on_page(page: str, *kinds: Kind) -> tuple[Kind, ...]:
    """Return a table whose entries one page of docs/ explains."""
    return tuple(replace(kind, page=page) for kind in kinds)
