"""Interface of an estimator, its implementation for linear filters, and workers.

`Calibrator` has one estimator per model. A nonlinear estimator learns of new aligned rows by `advance`, and may make
the aligner hold rows until it has copied them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...verdict.reasons import Reason
from ..assessment.dead_reckoning import Navigation, SlowNoise
from ..assessment.model_selection import NO_EVIDENCE, Evidence
from ..checks.beam_faults import BeamFault
from ..filters.cross_validation import HeldOutError, Moments, held_out_error
from ..filters.filter_bank import Group, ModelCounts
from ..filters.state_history import Numbers, PastStates, StateTrace
from ..models import Model
from ..models.parameters import ParameterError, Parameters
from ..models.plugins import load
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.samples import Index, Stamps
from ..registration.registration import Registration
from ..results.results import BiasCovariance, Day
from ..results.thinned_recording import Terms, ThinnedRecording
from ..streams.aligner import Aligner

NEVER = 2**63 - 1  # number of a row that never comes
# From the last data of a solution until it takes effect, in stamps, ns. A worker needs a hundredth of it; when a
# recording is played fast, the node waits for the worker.
SOLVED_WITHIN_NS = 1_000_000_000


@dataclass(frozen=True)
class EstimatorSetup:
    """Arguments for making an estimator.

    initial: initial state of the model.
    on_evidence: called when a result takes effect, with the stamp of the first DVL sample that it may affect.
    verified: keep what hold-out verification needs.
    worker: runs slow work in order, in one thread, so that live messages do not wait; None runs it immediately.
    together: number of blocks gathered before they are solved, unless a result is requested.
    """

    model: Model
    parameters: Parameters
    aligner: Aligner
    initial: GaussianState | None
    on_evidence: Callable[[int], None]
    verified: bool
    worker: Executor | None
    together: int


class Estimator(ABC):
    """States of one model. The methods that are not abstract have defaults for the linear filter."""

    @property
    def claims(self) -> bool:
        """Return whether it has used any data."""
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
        """Return whether the reference's noise comes from its messages instead of a parameter."""
        return False

    @property
    def doubt(self) -> Reason | None:
        """Reason against models that assume what this one estimates."""
        return None

    @property
    def heading_deviation(self) -> GaussianState | None:
        """Heading deviation x (4,), P (4, 4), see `Estimate.heading_deviation`; None if not estimated."""
        return None

    @property
    def suggestion(self) -> Reason | None:
        """Configuration that fits the data, if the given one is grossly wrong."""
        return None

    @property
    def is_level(self) -> bool:
        """Return whether the attitude is a heading only, without roll and pitch."""
        return False

    @property
    def is_horizontal(self) -> bool:
        """Return whether no reference measures the vertical."""
        return False

    @property
    def arm_effect(self) -> float | None:
        """Velocity error by an unknown arm without turn rates, σ as a share of the speed; None if rates are known."""
        return None

    @property
    def left_open(self) -> Array:
        """Part (n, n) of `of_recording`'s covariance due to the uncertain clock offset of the reference."""
        n = len(self.state().x)
        return np.zeros((n, n))

    @property
    def of_bias(self) -> BiasCovariance:
        """Part of `of_recording`'s covariance due to a bias of the DVL."""
        return BiasCovariance.none(len(self.state().x))

    @property
    def registration(self) -> Registration | None:
        """Registration of clocks and frames from the data alone; None if not computed."""
        return None

    @property
    def slow_noise(self) -> SlowNoise | None:
        """Slow errors of reference and attitude as estimated; None if not estimated."""
        return None

    @property
    def dvl_bias(self) -> GaussianState | None:
        """DVL's bias x (3,) m/s, P (3, 3), DVL axes, by the data alone; None if not estimated."""
        return None

    @property
    def beam_fault(self) -> BeamFault | None:
        """Most significant fault of one beam of the DVL; None if not tested."""
        return None

    def residuals(self, *, fresh: bool) -> Residuals | None:
        """Return the calibration's residuals, evaluated now if `fresh`, else the latest; None if not available."""
        return None

    @property
    def registration_so_far(self) -> Registration | None:
        """`registration` by the latest evaluation, without waiting."""
        return None

    @property
    def n_results(self) -> int:
        """Counter that grows when there may be new results besides the state."""
        return self.counts.used

    @property
    def suggestion_so_far(self) -> Reason | None:
        """`suggestion` by the latest evaluation, without waiting."""
        return self.suggestion

    @property
    def evidence(self) -> Evidence:
        """Evidence for the model selection."""
        return NO_EVIDENCE

    @property
    def affected_from_ns(self) -> int | None:
        """Stamp of the first DVL sample that gathered blocks may still affect; None without any."""
        return None

    @property
    def recording(self) -> tuple[ThinnedRecording, int] | None:
        """Streams kept for verification, and the stamp (ns) of their time 0; None if nothing was kept."""
        return None

    @abstractmethod
    def state(self) -> GaussianState:
        """Return x (n,) and P (n, n) from all rows so far."""

    @property
    @abstractmethod
    def counts(self) -> ModelCounts:
        """Counts of samples used and rejected."""

    @abstractmethod
    def of_recording(self) -> GaussianState:
        """Return `state` with σ from the scatter of time blocks."""

    @property
    def filter_covariance(self) -> Array:
        """P (n, n) that the filter alone claims; by default of `state`."""
        return self.state().p

    @abstractmethod
    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> PastStates:
        """Return the states after E rows of a trace.

        trace: history of the linear filters. numbers, stamps_ns: (E,) of the rows.
        """

    @abstractmethod
    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """Return the velocity error on every fold, each by the state without it; None for too few samples."""

    def navigation(self) -> Navigation | None:
        """Return the drift of dead reckoning if the estimator judges it itself; None to judge it by velocities."""
        return None

    @abstractmethod
    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """Return, per fold and day, the corrections estimated without that fold."""

    def advance(self) -> None:
        """Take note that rows may have been added or decided."""
        return None

    def take_rows(self) -> None:
        """Copy the judged rows before they are forgotten."""
        return None

    def take_fix(self, stamp_ns: int, position: Array, variance: Array) -> None:
        """Take a position (3,) m of the reference point, ENU, and variances (3,) m², nan if unknown."""
        return None

    def settle(self) -> None:
        """Solve for the gathered data, and let the solution take effect."""
        return None

    @contextmanager
    def settled(self) -> Iterator[None]:
        """Let all complete blocks take effect inside this context."""
        yield

    def finish(self) -> None:
        """Process what is gathered after the last sample."""
        return None

    def remember(self, from_ns: int) -> None:
        """Keep the current state for `states_at`."""
        return None

    def day_of(self, stamps_ns: Stamps) -> Index:
        """Return the day (N,), from 0, of each stamp."""
        return np.zeros(len(stamps_ns), dtype=np.intp)

    def days_from(self, first_ns: Sequence[int]) -> tuple[Day, ...]:
        """Return per-day values, by the days' first stamps; empty with one day."""
        return ()


class Remembered(NamedTuple):
    """State of an estimator from a stamp on. used, nis_sum: samples used until then, and their Σ νᵀS⁻¹ν."""

    from_ns: int
    state: GaussianState
    used: int
    nis_sum: float


def states_in_effect(remembered: Sequence[Remembered], stamps_ns: Stamps) -> PastStates:
    """Return the states in effect at stamps (E,). remembered: in order; the first one is from the beginning on."""
    at = np.searchsorted([past.from_ns for past in remembered], stamps_ns, side="right") - 1
    in_effect = [remembered[index] for index in at.tolist()]
    x, p = np.array([past.state.x for past in in_effect]), np.array([past.state.p for past in in_effect])
    used = np.array([past.used for past in in_effect], dtype=np.int64)
    return PastStates(GaussianState(x, p), used, np.array([past.nis_sum for past in in_effect]))


class LinearEstimator(Estimator):
    """A model in a group of linear filters."""

    def __init__(self, model: Model, group: Group, update: Callable[[Group], None]) -> None:
        """Wrap a model of a group. update: gives the group the rows since its last update."""
        self._model, self._group, self._update = model, group, update

    def state(self) -> GaussianState:
        """See `Estimator`."""
        self._update(self._group)
        return self._group.state(self._model.name)

    @property
    def counts(self) -> ModelCounts:
        """See `Estimator`."""
        return self._group.counts(self._model.name)

    def of_recording(self) -> GaussianState:
        """See `Estimator`."""
        self._update(self._group)
        return self._group.of_recording(self._model.name)

    def states_at(self, trace: StateTrace, numbers: Numbers, stamps_ns: Stamps) -> PastStates:
        """See `Estimator`."""
        return self._group.states_at(self._model.name, trace.snapshot(self._group, numbers))

    def held_out_error(self, judge: Moments, rotation_dvl_from_body: Array) -> HeldOutError | None:
        """See `Estimator`."""
        states = self._group.states_without_folds(self._model.name)
        return held_out_error(self._model, states, judge, rotation_dvl_from_body)

    def held_out_terms(self, n_days: int) -> list[list[Terms]]:
        """See `Estimator`."""
        terms = self._model.error_terms_from_state
        states = self._group.states_without_folds(self._model.name)
        return [[Terms(terms @ state.x, np.zeros(3), 0.0)] * n_days for state in states]


def kind_of(model: Model) -> Callable[[EstimatorSetup], Estimator]:
    """Return the maker of the estimator that a model names; a faulty plugin raises ParameterError when called."""
    name = model.estimator
    try:
        kind = load(name)
        if not (isinstance(kind, type) and issubclass(kind, Estimator)):
            raise TypeError(f"{name} is no subclass of Estimator")
    except Exception as error:  # a plugin may raise anything
        says = f"model {model.name}: its estimator {name} cannot be used ({type(error).__name__}: {error}); repair or "

        def refuse(_: EstimatorSetup) -> Estimator:
            raise ParameterError(f"{says}uninstall that package")

        return refuse
    make: Callable[[EstimatorSetup], Estimator] = kind
    return make


class AtOnce(Executor):
    """Worker that runs work immediately in the calling thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run the work now."""
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Residuals(NamedTuple):
    """Residuals of a calibration.

    held_out: velocity error on held-out data.
    typical: m/s rms with the state from all data, without outliers; None without any.
    judged: samples and velocity products, see `calibration_error`.
    navigation: held-out drift of dead reckoning, with heading deviation.
    in_earth: whether the reference is in an earth frame.
    """

    held_out: HeldOutError | None
    typical: float | None
    judged: tuple[float, Array]
    navigation: Navigation | None
    in_earth: bool
