"""The estimators that are more than the linear filter, asked as one: the first that has an answer gives it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TypeVar

import numpy as np

from ..verdict.reasons import Reason
from .delay.clocks import Rest
from .estimator import NEVER, Estimator
from .numerics.samples import Index, Stamps
from .registration.registration import Registration
from .results.thinned_recording import ThinnedRecording

_Answer = TypeVar("_Answer")


class FurtherEstimators:
    """Those of a calibrator, in the order of their models. Names and answers are those of `Estimator`."""

    def __init__(self, estimators: Sequence[Estimator]) -> None:
        self._all = tuple(estimators)

    def __iter__(self) -> Iterator[Estimator]:
        return iter(self._all)

    def _first(self, ask: Callable[[Estimator], _Answer | None]) -> _Answer | None:
        return next((answer for each in self._all if (answer := ask(each)) is not None), None)

    @property
    def n_taken(self) -> int:
        """Number of the first aligned row that one of them has not copied."""
        return min((each.n_taken for each in self._all), default=NEVER)

    @property
    def n_told(self) -> tuple[int, ...]:
        """What grows when one of them may have more to say, by estimator."""
        return tuple(each.n_told for each in self._all)

    @property
    def told_until_ns(self) -> int | None:
        """Stamp of the first DVL sample that may go by something that is only gathered; None."""
        return min((until for each in self._all if (until := each.told_until_ns) is not None), default=None)

    @property
    def reference_claims(self) -> bool:
        """Whether it is the reference's messages that say how noisy it is, and no parameter."""
        return any(each.reference_claims for each in self._all)

    @property
    def is_level(self) -> bool:
        """Whether references were turned into the body by a heading alone: roll and pitch then hold the trim."""
        return any(each.is_level for each in self._all)

    @property
    def is_horizontal(self) -> bool:
        """Whether no reference measures the vertical."""
        return any(each.is_horizontal for each in self._all)

    @property
    def are_clocks_known(self) -> bool:
        """Whether the data show how the clocks stand, in time or not."""
        return any(each.registration is not None and each.registration.are_known for each in self._all)

    @property
    def doubt(self) -> Reason | None:
        """What is known against models that take for granted what these find."""
        return self._first(lambda each: each.doubt)

    @property
    def suggestion(self) -> Reason | None:
        """What configuration the data fit, where the one given is grossly wrong."""
        return self._first(lambda each: each.suggestion)

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion` as it was seen a little ago, which nobody has to wait for."""
        return self._first(lambda each: each.suggestion_so_far)

    @property
    def registration_so_far(self) -> Registration | None:
        """How the instruments stand, as it was seen a little ago; None where that is not known."""
        return self._first(lambda each: each.registration_so_far)

    def rest(self, *, fresh: bool) -> Rest | None:
        """What the calibration leaves, by a look at all there is or, not fresh, by one a little ago; None for none."""
        return self._first(lambda each: each.rest(fresh=fresh))

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """What was kept of all streams for verification, and the stamp (ns) of its time 0; None for nothing."""
        return self._first(lambda each: each.recording)

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return max((each.n_days for each in self._all), default=1)

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Which day (N,) stamps are of, from 0, as far as `recording` goes."""
        days = [each.day_of(stamps_ns) for each in self._all]
        return np.max(days, axis=0) if days else np.zeros(len(stamps_ns), dtype=np.intp)

    @contextmanager
    def settled(self) -> Iterator[None]:
        """All that is complete has taken effect, in here."""
        with ExitStack() as each_settled:
            for each in self._all:
                each_settled.enter_context(each.settled())
            yield
