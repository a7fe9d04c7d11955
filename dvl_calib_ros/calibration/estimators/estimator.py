"""The interface of an estimator, the linear filter behind it, and the worker that solves in a thread.

`Calibrator` has one for each model and asks all alike. One that is more than the linear filter is told of the aligned
rows by `advance`, after whatever was fed, and may hold rows back until it has copied them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from ...verdict.reasons import Reason
from ..assessment.dead_reckoning import Navigation
from ..assessment.model_selection import NO_EVIDENCE, Evidence
from ..filters.cross_validation import HeldOutError, Moments, held_out_error
from ..filters.filter_bank import Group, ModelCounts
from ..filters.state_history import Counts, Numbers, StateTrace
from ..models import Model
from ..models.parameter_spec import ParameterError
from ..models.parameters import Parameters
from ..models.plugins import load
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Stamps
from ..registration.registration import Registration
from ..results.bias_covariance import BiasCovariance
from ..results.results import Day
from ..results.thinned_recording import Terms, ThinnedRecording
from ..streams.aligner import Aligner

NEVER = 2**63 - 1


@dataclass(frozen=True)
class EstimatorSetup:
    """What an estimator of a model is made with.

    initial: a state to start from, of the model. on_evidence: to be told, once something new takes effect, of the
    stamp from which on DVL samples may go by it. verified: keep what hold-out needs. worker: does what would hold up
    live messages; None: at once. together: how many blocks of time may be gathered before they are looked at, unless
    somebody asks. registration: how the instruments stand, where that is known.
    """

    model: Model
    parameters: Parameters
    aligner: Aligner
    initial: GaussianState | None
    on_evidence: Callable[[int], None]
    verified: bool
    worker: Worker | None
    together: int
    registration: Registration | None = None


class Estimator(ABC):
    """The states of one model; what is not abstract is for those that know more than the linear filter."""

    @property
    def claims(self) -> bool:
        """Whether there are any data of its own."""
        return True

    @property
    def n_taken(self) -> int:
        """Number of the first aligned row that it has not copied."""
        return NEVER

    @property
    def n_days(self) -> int:
        """Number of days so far."""
        return 1

    @property
    def reference_claims(self) -> bool:
        """Whether it is the reference's messages that say how noisy it is, and no parameter."""
        return False

    @property
    def doubt(self) -> Reason | None:
        """What is known against models that take for granted what this one finds."""
        return None

    @property
    def heading_deviation(self) -> GaussianState | None:
        """Coefficients x (5,), P (5, 5) of how the heading deviates, as `Estimate.heading_deviation`; None."""
        return None

    @property
    def suggestion(self) -> Reason | None:
        """What configuration the data fit, where the one given is grossly wrong."""
        return None

    @property
    def is_level(self) -> bool:
        """Whether the attitude that turns references into the body is a heading alone, without roll and pitch."""
        return False

    @property
    def is_horizontal(self) -> bool:
        """Whether no reference measures the vertical."""
        return False

    @property
    def left_open(self) -> Array:
        """(n, n) of `of_recording`'s covariance, what the clock of the reference leaves open."""
        n = len(self.state().x)
        return np.zeros((n, n))

    @property
    def of_bias(self) -> BiasCovariance:
        """What a bias of the DVL makes of `of_recording`."""
        return BiasCovariance.none(len(self.state().x))

    @property
    def registration(self) -> Registration | None:
        """How the instruments stand, by their data alone; None for one that does not look."""
        return None

    def rest(self, *, fresh: bool) -> Rest | None:
        """What the calibration leaves, by a look at all there is or, not fresh, by one a little ago; None for none."""
        return None

    @property
    def registration_so_far(self) -> Registration | None:
        """`registration` as it was seen a little ago, which nobody has to wait for."""
        return None

    @property
    def n_told(self) -> int:
        """What grows when it may have more to say, beside a state that changes with each sample."""
        return self.counts.used

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion` as it was seen a little ago, which nobody has to wait for."""
        return self.suggestion

    @property
    def evidence(self) -> Evidence:
        """What it has to say to the selection."""
        return NO_EVIDENCE

    @property
    def told_until_ns(self) -> int | None:
        """Stamp of the first DVL sample that may go by something that is only gathered; None."""
        return None

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """What it kept of all streams for verification, and the stamp (ns) of its time 0; None for nothing."""
        return None

    @abstractmethod
    def state(self) -> GaussianState:
        """x (n,) and P (n, n) by all rows so far."""

    @property
    @abstractmethod
    def counts(self) -> ModelCounts:
        """What it did with the samples given to it."""

    @abstractmethod
    def of_recording(self) -> GaussianState:
        """As `state`, with σ as blocks of time show it."""

    @property
    def filter_covariance(self) -> Array:
        """P (n, n) as the filter alone claims it: of an estimator whose `state` is no more than that."""
        return self.state().p

    @abstractmethod
    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> tuple[GaussianState, Counts, Array]:
        """After E rows of a trace, with their stamps (E,): x (E, n), P (E, n, n), samples used (E,), and the sum of
        νᵀS⁻¹ν over them (E,)."""

    @abstractmethod
    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Velocity error on every fold by the state that has not seen it; None if there is too little to judge by."""

    def navigation(self) -> Navigation | None:
        """What it is worth to dead reckoning, of one that judges that itself; None: by velocities, as of all others."""
        return None

    @abstractmethod
    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """For every fold what it corrects on every day, had it not seen that fold."""

    def advance(self) -> None:
        """Rows may have been added, or decided."""
        return None

    def take_rows(self) -> None:
        """Copy the rows that are judged, before they are forgotten."""
        return None

    def take_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """Take a position of the reference point (3,) m, ENU, and its variances (3,) m², nan where not known."""
        return None

    def settle(self) -> None:
        """Let take effect what is only gathered."""
        return None

    @contextmanager
    def settled(self) -> Iterator[None]:
        """All that is complete has taken effect, in here."""
        yield

    def finish(self) -> None:
        """No samples come any more."""
        return None

    def remember(self, from_ns: int) -> None:
        """Keep the state as of now, for `states_at`."""
        return None

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Which day (N,) stamps are of, from 0."""
        return np.zeros(len(stamps_ns), dtype=np.intp)

    def days_from(self, first_ns: Sequence[int]) -> tuple[Day, ...]:
        """What belongs to each of several days, by the stamps that they begin with; none where there is one."""
        return ()


class LinearEstimator(Estimator):
    """A model of a group of linear filters."""

    def __init__(self, model: Model, group: Group, update: Callable[[Group], None]) -> None:
        """update: gives the group the rows that it has not had."""
        self._model, self._group, self._update = model, group, update

    def state(self) -> GaussianState:
        """As `Estimator`."""
        self._update(self._group)
        return self._group.state(self._model.name)

    @property
    def counts(self) -> ModelCounts:
        """As `Estimator`."""
        return self._group.counts(self._model.name)

    def of_recording(self) -> GaussianState:
        """As `Estimator`."""
        self._update(self._group)
        return self._group.of_recording(self._model.name)

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> tuple[GaussianState, Counts, Array]:
        """As `Estimator`."""
        standing = trace.standing(self._group, numbers)
        name = self._model.name
        used, nis_sum = self._group.counts_at(name, standing)
        return self._group.states_at(name, standing), used, nis_sum

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """As `Estimator`."""
        states = self._group.states_without_folds(self._model.name)
        return held_out_error(self._model, states, judge, rotation_dvl_from_body)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """As `Estimator`."""
        terms = self._model.error_terms_from_state
        states = self._group.states_without_folds(self._model.name)
        return [[Terms(terms @ state.x, np.zeros(3), 0.0)] * n_days for state in states]


def kind_of(model: Model) -> Callable[[EstimatorSetup], Estimator]:
    """What makes the estimator that a model names; what another package does wrong is raised when one is made."""
    name = model.estimator
    try:
        kind = load(name)
        if not (isinstance(kind, type) and issubclass(kind, Estimator)):
            raise TypeError(f"{name} is no subclass of Estimator")
    except Exception as error:  # whatever a foreign package does wrong
        says = f"model {model.name}: its estimator {name} cannot be used ({type(error).__name__}: {error}); mend or "

        def refuse(_: EstimatorSetup) -> Estimator:
            raise ParameterError(f"{says}uninstall that package")

        return refuse
    make: Callable[[EstimatorSetup], Estimator] = kind
    return make


Found = TypeVar("Found")
Given = TypeVar("Given", covariant=True)


class Solved(Protocol[Given]):
    """What a worker was given to do, as `concurrent.futures.Future`."""

    def result(self) -> Given:
        """What was found, waited for; raises what the solving raised."""


class Worker(Protocol):
    """Does one thing after the other, as a `concurrent.futures.ThreadPoolExecutor` with one thread."""

    def submit(self, work: Callable[[], Found], /) -> Solved[Found]:
        """Do this after all that was submitted before."""


class _Now(Generic[Found]):
    """What was done at once."""

    def __init__(self, found: Found) -> None:
        self._found = found

    def result(self) -> Found:
        """What was found."""
        return self._found


class AtOnce:
    """A worker that has done what it is given before anything else goes on."""

    def submit(self, work: Callable[[], Found], /) -> Solved[Found]:
        """Do it."""
        return _Now(work())


class Rest(NamedTuple):
    """What a calibration leaves on data held out: the velocity error; with all data, without outliers (m/s rms; None
    for none); what was judged, as of `calibration_error`; the drift of dead reckoning with what is left and how the
    heading deviates; and whether the reference is in the earth's frame."""

    held_out: HeldOutError | None
    typical: float | None
    judged: tuple[float, Array]
    navigation: Navigation | None
    in_earth: bool
