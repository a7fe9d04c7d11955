"""Estimates and velocities over a run, thinned so that a run of any length fits in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.filters.build_observations import Observer
from ..calibration.filters.state_history import StateTrace
from ..calibration.models import MODELS, Needs
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from ..calibration.numerics.samples import AlignedBlock, Codes, Pairing, Stamps
from ..calibration.results.results import Estimate

# largest number of rows per series; a figure has no finer detail
KEPT_STATES, KEPT_VELOCITIES = 300, 800


@dataclass(frozen=True)
class ModelHistory:
    """One model over time, at the N stamps of its `RunHistory`.

    state: (N, n), misalignment in rad in the DVL frame, then as the model's state_names; std: (N, n).
    misalignment_covariance: (N, 3, 3) rad². nis: (N,) mean νᵀS⁻¹ν per measurement row over the samples used since the
    previous stamp (about 1 for a consistent filter), nan if none was used.
    """

    state: Array
    std: Array
    misalignment_covariance: Array
    nis: Array


@dataclass(frozen=True)
class RunHistory:
    """A run over time.

    stamps_ns: (N,) of the rows of `models` and paired_share; a model's state includes all samples up to the stamp.
    paired_share: (N,) share of the DVL samples since the previous stamp with a reference, nan if none was decided.
    dvl_ns (M,), dvl_velocity (M, 3): usable DVL samples, m/s, DVL frame, corrected to the reference point. paired_ns
    (P,), reference_velocity (P, 3): DVL samples with a reference, and the reference, m/s, body frame.
    """

    stamps_ns: Stamps
    models: Mapping[str, ModelHistory]
    paired_share: Array
    dvl_ns: Stamps
    dvl_velocity: Array
    paired_ns: Stamps
    reference_velocity: Array


class Thinned:
    """Evenly spread rows of an endless series: every stride-th row; the stride doubles at the limit.

    limit: largest number of rows. expected: length of the series, if known.
    """

    def __init__(self, limit: int, expected: int = 0) -> None:
        self._limit = limit
        self._stride = max(1, -(-expected // limit))
        self._seen = 0
        self._rows: list[tuple[Any, ...]] = []

    def add(self, *columns: Array | Stamps) -> None:
        """Add the next rows, as columns (N, ...)."""
        n = len(columns[0])
        at = slice(-self._seen % self._stride, n, self._stride)
        self._seen += n
        self._rows += zip(*(column[at].copy() for column in columns), strict=True)
        while len(self._rows) > self._limit:
            self._rows = self._rows[::2]
            self._stride *= 2

    def columns(self, *shapes: tuple[int, ...]) -> list[Array]:
        """Return the kept rows as columns of rows with these shapes."""
        columns = zip(*self._rows, strict=True) if self._rows else ((),) * len(shapes)
        return [np.array(column).reshape(-1, *shape) for column, shape in zip(columns, shapes, strict=True)]


class Recorder:
    """Collector of a `RunHistory` from a calibrator, whose results it does not change.

    Give `take` to the calibrator as its on_rows, `start` as its on_restart and `trace` as its trace. expected:
    approximate number of DVL samples.
    """

    def __init__(self, parameters: Parameters, expected: int = 0) -> None:
        self._observer = Observer(parameters)
        self._expected = expected
        self.trace = StateTrace(KEPT_STATES, expected)
        self.start()

    def start(self) -> None:
        """Restart together with the calibration."""
        self._stamps_ns: list[Stamps] = []
        self._pairing: list[Codes] = []
        self._dvl = Thinned(KEPT_VELOCITIES, self._expected)
        self._paired = Thinned(KEPT_VELOCITIES, self._expected)

    def take(self, block: AlignedBlock) -> None:
        """Add rows."""
        self._stamps_ns.append(block.stamps_ns)
        self._pairing.append(block.pairing)
        usable, paired = block.part(block.usable), block.part(block.paired)
        if len(usable):
            seen = self._observer.observe(usable, Needs.NOTHING, np.zeros(2))
            self._dvl.add(usable.stamps_ns, seen.velocity_at_reference)
        if len(paired):
            seen = self._observer.observe(paired, Needs.REFERENCE, np.zeros(2))
            assert seen.reference_body is not None
            self._paired.add(paired.stamps_ns, seen.reference_body)

    def history(self, calibrator: Calibrator, estimates: Mapping[str, Estimate]) -> RunHistory:
        """Return the history after `Calibrator.finish`, ending with the estimates of its result."""
        numbers = self.trace.numbers()
        stamps_ns = np.concatenate([*self._stamps_ns, np.zeros(0, dtype=np.int64)])
        pairing = np.concatenate([*self._pairing, np.zeros(0, dtype=np.uint8)])
        numbers = numbers[numbers < len(stamps_ns)]
        decided, paired = np.cumsum(pairing != Pairing.AWAITING), np.cumsum(pairing == Pairing.PAIRED)
        at = np.append(numbers, len(stamps_ns) - 1) if len(stamps_ns) else np.zeros(0, dtype=np.int64)
        dvl_ns, dvl_velocity = self._dvl.columns((), (3,))
        paired_ns, reference_velocity = self._paired.columns((), (3,))
        return RunHistory(
            stamps_ns=np.append(stamps_ns[numbers], calibrator.last_ns or 0),
            models={
                name: _model_history(estimates[name], calibrator, self.trace, numbers, stamps_ns[numbers])
                for name in estimates
            },
            paired_share=_share(np.column_stack([paired[at], decided[at]])) if len(at) else np.full(1, np.nan),
            dvl_ns=dvl_ns.astype(np.int64),
            dvl_velocity=dvl_velocity,
            paired_ns=paired_ns.astype(np.int64),
            reference_velocity=reference_velocity,
        )


def _model_history(
    estimate: Estimate, calibrator: Calibrator, trace: StateTrace, numbers: Stamps, stamps_ns: Stamps
) -> ModelHistory:
    name = estimate.model
    nis_sum = estimate.used * estimate.mean_nis if estimate.used else 0.0
    states, covariances = [estimate.state[None]], [estimate.recording_covariance[None]]
    sums = [[(nis_sum, estimate.used)]]
    if len(numbers):
        state, used, nis_sums = calibrator.states_at(name, trace, numbers, stamps_ns)
        states.insert(0, state.x)
        covariances.insert(0, state.p)
        sums.insert(0, list(zip(nis_sums.tolist(), used.tolist(), strict=True)))
    return ModelHistory(
        state=np.concatenate(states),
        std=np.sqrt(np.concatenate([np.diagonal(each, axis1=1, axis2=2) for each in covariances])),
        misalignment_covariance=np.concatenate([each[:, :3, :3] for each in covariances]),
        nis=_share(np.concatenate(sums)) / MODELS[name].n_measurement,
    )


def _share(sums: Array) -> Array:
    """Divide the increments of cumulative sums (N, 2): first column by second, since the previous row (N,)."""
    gained = np.diff(sums.astype(float), axis=0, prepend=0.0)
    return np.divide(gained[:, 0], gained[:, 1], out=np.full(len(sums), np.nan), where=gained[:, 1] > 0)
