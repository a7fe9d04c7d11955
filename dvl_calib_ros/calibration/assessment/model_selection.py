"""Automatic selection of the model over time, with timeout and hysteresis in stamps."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models import FULL, POSITIONS, UNAIDED
from ..models.parameters import AUTO, IAC, Parameters
from ..numerics.samples import Mask, Stamps
from ..results.results import Segment


class GnssAvailability:
    """Availability of GNSS: paired samples keep arriving, and a change has lasted for the hysteresis.

    Initially GNSS is not available. losses: number of gaps longer than the timeout, even if shorter than the
    hysteresis.
    """

    def __init__(self) -> None:
        self.available = False
        self.losses = 0
        self._fresh = False
        self._last_paired_ns: int | None = None
        self._changing_since_ns: int | None = None

    def update(self, stamp_ns: int, paired: bool, timeout_ns: int, hysteresis_ns: int) -> None:
        """Take one DVL sample, and whether it was paired with a reference."""
        if paired:
            self._last_paired_ns = stamp_ns
        fresh = self._last_paired_ns is not None and stamp_ns - self._last_paired_ns <= timeout_ns
        self.losses += self._fresh and not fresh
        self._fresh = fresh
        if fresh == self.available:
            self._changing_since_ns = None
            return
        if self._changing_since_ns is None:
            self._changing_since_ns = stamp_ns
        if stamp_ns - self._changing_since_ns >= hysteresis_ns:
            self.available = fresh
            self._changing_since_ns = None

    def stays_with(self, stamps_ns: Stamps, paired: Mask) -> bool:
        """Take samples (N,) if they change nothing, and return whether so: reception is steady, or steadily absent."""
        if self._changing_since_ns is not None or self._fresh != self.available:
            return False
        if self.available and paired.all():
            self._last_paired_ns = int(stamps_ns[-1])
            return True
        return not self.available and not paired.any()

    @property
    def reason(self) -> Reason:
        """Availability in words for the operator."""
        if self._changing_since_ns is None:
            return finding("GNSS_AVAILABLE" if self.available else "GNSS_NOT_AVAILABLE")
        return finding("GNSS_GOING" if self.available else "GNSS_COMING")


class Evidence(NamedTuple):
    """Evidence of an estimator for the selection: code and numbers of a reason, '' for none.

    pairs_elsewhere: the estimator finds references that pairing at the uncorrected stamps misses. is_known: its
    calibration holds without further references.
    """

    code: str = ""
    numbers: Mapping[str, Any] = {}
    pairs_elsewhere: bool = False
    is_known: bool = False


NO_EVIDENCE = Evidence()
# Time without references from an estimator, ns, after which there are none; they come with every block of 10 s.
REFERENCED_NS = 12_000_000_000


class Selection:
    """Selected model over time."""

    def __init__(self) -> None:
        self.gnss = GnssAvailability()
        self.segments: list[Segment] = []
        self._referenced_until_ns = 0
        self._is_known = False
        self._by_positions: Evidence | None = None
        self._coming: deque[tuple[int, Evidence]] = deque()  # takes effect when DVL samples reach its stamp

    def take(self, from_ns: int, evidence: Evidence) -> None:
        """Use an estimator's evidence from this stamp on."""
        if evidence is not NO_EVIDENCE:
            insort(self._coming, (from_ns, evidence), key=lambda coming: coming[0])

    def update(self, stamps_ns: Stamps, paired: Mask, parameters: Parameters) -> None:
        """Take DVL samples (N,) in order of stamps, and whether they were paired."""
        while self._coming and len(stamps_ns) and self._coming[0][0] <= stamps_ns[-1]:
            from_ns, evidence = self._coming.popleft()
            at = int(np.searchsorted(stamps_ns, from_ns))
            if at:
                self._update(stamps_ns[:at], paired[:at], parameters)
            stamps_ns, paired = stamps_ns[at:], paired[at:]
            if evidence.code:
                self._by_positions = evidence
            else:
                self._is_known = evidence.is_known
                if evidence.pairs_elsewhere:
                    self._referenced_until_ns = from_ns + REFERENCED_NS
            self.record(int(stamps_ns[0]), parameters)
        if len(stamps_ns):
            self._update(stamps_ns, paired, parameters)

    def _update(self, stamps_ns: Stamps, paired: Mask, parameters: Parameters) -> None:
        """Take samples one by one where GNSS availability changes.

        stamps_ns: (N,) of the DVL samples.
        paired: (N,) whether each has a reference velocity.
        """
        timeout_ns, hysteresis_ns = round(parameters.gnss_timeout * 1e9), round(parameters.gnss_hysteresis * 1e9)
        if parameters.model == AUTO:
            paired = paired | (stamps_ns < self._referenced_until_ns)
        if self.segments and self.gnss.stays_with(stamps_ns, paired):
            return
        for stamp_ns, is_paired in zip(stamps_ns.tolist(), paired.tolist(), strict=True):
            self.gnss.update(stamp_ns, is_paired, timeout_ns, hysteresis_ns)
            self.record(stamp_ns, parameters)

    def record(self, stamp_ns: int, parameters: Parameters) -> None:
        """Start a new segment if the selected model has changed; a segment without duration is replaced."""
        model = self.model(parameters)
        if self.segments and self.segments[-1].from_ns == stamp_ns:
            self.segments.pop()
        if not self.segments or self.segments[-1].model != model:
            self.segments.append(Segment(stamp_ns, model))

    def model(self, parameters: Parameters) -> str:
        """Return the name of the selected model."""
        if parameters.model == IAC:
            return self.iac_model(parameters)
        if parameters.model != AUTO:
            return parameters.model
        if self._by_positions is not None:
            return POSITIONS.name
        return FULL.name if self.gnss.available or self._is_known else UNAIDED.name

    def keeps_full(self, parameters: Parameters) -> bool:
        """Return whether `auto` runs `full` without a reference, because the calibration is known."""
        return self.model(parameters) == FULL.name and parameters.model == AUTO and not self.gnss.available

    def iac_model(self, parameters: Parameters) -> str:
        """Return the model that the paper's selection runs now."""
        return parameters.gnss_model if self.gnss.available else parameters.gnss_free_model

    def reason(self, parameters: Parameters) -> Reason:
        """Return the reason for the selected model."""
        if parameters.model not in (AUTO, IAC):
            return finding("MODEL_NAMED")
        chosen = {"by": parameters.model, "gnss": self.gnss.reason}
        if parameters.model == AUTO and self._by_positions is not None:
            why = finding(self._by_positions.code, **self._by_positions.numbers)
            return finding("MODEL_CHOSEN_AS", **chosen, why=why)
        if self.keeps_full(parameters):
            return finding("MODEL_CHOSEN_AS", **chosen, why=finding("CALIBRATION_KEPT"))
        return finding("MODEL_CHOSEN", **chosen)
