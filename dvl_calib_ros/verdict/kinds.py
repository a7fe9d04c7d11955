"""What an entry of a table of reasons is, and how bad a reason can be."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """How bad a reason is.

    Of a finding: with a warning the calibration goes on, with an error it learns nothing. Of a verdict: what to do with
    the calibration; its word is that of its worst reason.
    """

    ERROR = "error"
    WARNING = "warning"
    REJECT = "reject"
    MARGINAL = "marginal"
    ACCEPT = "accept"


# Of a verdict, by its word.
VERDICT_WORDS: Mapping[str, Severity] = {
    each.value: each for each in (Severity.ACCEPT, Severity.MARGINAL, Severity.REJECT)
}


@dataclass(frozen=True)
class Kind:
    """An entry of a table of reasons.

    Parameters
    ----------
    code
        What users search for. Never changes its meaning.
    says
        What is the matter, in a sentence with fields in braces for what is found.
    means
        What is behind it, for the documentation.
    remedy
        What to do, may have fields as well; '' where there is nothing to do.
    severity
        How bad it is, where the call does not say otherwise.
    page
        Where the documentation says more: a page of docs/ with the heading.

    Raises
    ------
    ValueError
        For a code that is not one word in capitals, or an entry that says nothing.

    """

    code: str
    says: str
    means: str
    remedy: str
    severity: Severity = Severity.WARNING
    page: str = "troubleshooting.md#all-warnings"

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Z][A-Z_]*[A-Z]", self.code):
            raise ValueError(f"code {self.code!r}: capitals and underscores only")
        if not (self.says and self.means and (self.remedy or not self.is_finding)):
            raise ValueError(f"{self.code}: says, means and a finding's remedy must not be empty")

    @property
    def is_finding(self) -> bool:
        """Whether it is a warning or error, which is listed with its remedy, and not the word of a verdict."""
        return self.severity in (Severity.ERROR, Severity.WARNING)
