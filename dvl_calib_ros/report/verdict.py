"""What a verification on held-out data says, as a report shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class HeldOutError:
    """Velocity error on data that was held back, m/s rms: without correction, with it, and as the σ predicts it.

    label: the model, or model and axis. samples: how many were held back. predicted: None if nothing is predicted.
    """

    label: str
    uncorrected: float
    corrected: float
    predicted: float | None
    samples: int


@dataclass(frozen=True)
class Verdict:
    """word: accept, marginal or reject, or not verified. reasons: sentences, the decisive one first."""

    word: str
    reasons: Sequence[str]
    errors: Sequence[HeldOutError] = ()


NOT_VERIFIED = Verdict("not verified", ("no data was held back to verify the calibration on",))
