"""What a run looked like over time: estimates and velocities, thinned so that a run of any length fits in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..calibration.calibrator import Calibrator
from ..calibration.frames import Array
from ..calibration.models import MODELS
from ..calibration.observations import Observations

Stamps = NDArray[np.int64]
T = TypeVar("T")

# Rows kept of each series at most: a figure shows no more. States are dear, they make the models work in small blocks.
KEPT_STATES, KEPT_VELOCITIES = 300, 800


@dataclass(frozen=True)
class ModelHistory:
    """One model over time, at the N stamps of its `RunHistory`.

    state: (N, n), misalignment in rad in the DVL frame, then as the model's state_names. std: (N, n). nis: (N,) mean
    νᵀS⁻¹ν per measurement row over the samples used since the stamp before (about 1 for a consistent filter), nan
    where it used none.
    """

    state: Array
    std: Array
    nis: Array


@dataclass(frozen=True)
class RunHistory:
    """A run over time.

    stamps_ns: (N,) of the rows of `models` and paired_share. paired_share: (N,) share of the DVL samples since the
    stamp before that had a reference, nan where none was decided.
    dvl_ns (M,), dvl_velocity (M, 3): usable DVL samples, m/s, DVL frame, moved to the reference point.
    paired_ns (P,), paired_velocity (P, 3), reference_velocity (P, 3): those that had a reference, m/s; the DVL's as
    above, the reference in the body frame.
    """

    stamps_ns: Stamps
    models: Mapping[str, ModelHistory]
    paired_share: Array
    dvl_ns: Stamps
    dvl_velocity: Array
    paired_ns: Stamps
    paired_velocity: Array
    reference_velocity: Array


class Thinned(Generic[T]):
    """Keeps evenly spread rows of an endless series: every stride-th, the stride doubles when there are too many.

    limit: rows kept at most. expected: length of the series as far as it is known; with a good guess fewer rows are
    wanted in vain.
    """

    def __init__(self, limit: int, expected: int = 0) -> None:
        self.rows: list[T] = []
        self._limit = limit
        self._stride = max(1, -(-expected // limit))
        self._seen = 0

    def wants_next(self) -> bool:
        """Count one more row; whether it is one to keep."""
        wanted = self._seen % self._stride == 0
        self._seen += 1
        return wanted

    def keep(self, row: T) -> None:
        """Take the row that was wanted."""
        self.rows.append(row)
        if len(self.rows) > self._limit:
            self.rows = self.rows[::2]
            self._stride *= 2


class _Moment(NamedTuple):
    """All models after a DVL sample. paired, decided: DVL samples so far."""

    stamp_ns: int
    models: Mapping[str, _ModelMoment]
    paired: int
    decided: int


class _ModelMoment(NamedTuple):
    """used: samples so far. nis_sum: of νᵀS⁻¹ν over them."""

    state: Array
    std: Array
    used: int
    nis_sum: float


_Velocities = tuple[int, Array, Array | None]  # stamp, DVL at the reference point, reference in the body


class Recorder:
    """Collects a `RunHistory` beside a calibrator, without changing what it computes.

    Give `observe` to the calibrator as its on_block, and call `note` after every DVL sample that it took.
    """

    def __init__(self) -> None:
        self._restarts = 0
        self.expect(0)

    def expect(self, n_samples: int) -> None:
        """Start anew, to be told of about this many DVL samples."""
        self._expected = n_samples
        self._moments: Thinned[_Moment] = Thinned(KEPT_STATES, n_samples)
        self._dvl: Thinned[_Velocities] = Thinned(KEPT_VELOCITIES, n_samples)
        self._paired: Thinned[_Velocities] = Thinned(KEPT_VELOCITIES, n_samples)

    def observe(self, stamps_ns: Sequence[int], seen: Observations) -> None:
        """Take note of the velocities of a block."""
        if seen.reference_body is None and seen.rotation_enu_from_body is not None:
            return  # the same samples once more, now with attitude
        series = self._dvl if seen.reference_body is None else self._paired
        for i, stamp_ns in enumerate(stamps_ns):
            if series.wants_next():
                reference = None if seen.reference_body is None else seen.reference_body[i].copy()
                series.keep((stamp_ns, seen.velocity_at_reference[i].copy(), reference))

    def note(self, calibrator: Calibrator) -> None:
        """Take note of the models' states."""
        if calibrator.restarts != self._restarts:  # the calibration has started anew, so does its history
            self._restarts = calibrator.restarts
            self.expect(self._expected)
        if self._moments.wants_next():
            self._moments.keep(_moment(calibrator))

    def history(self, calibrator: Calibrator) -> RunHistory:
        """What was collected, with the calibrator's state as it is now at its end."""
        moments = [*self._moments.rows, _moment(calibrator)]
        dvl, paired = self._dvl.rows, self._paired.rows
        return RunHistory(
            stamps_ns=np.array([moment.stamp_ns for moment in moments]),
            models={name: _model_history(name, [moment.models[name] for moment in moments]) for name in MODELS},
            paired_share=_share(np.array([(moment.paired, moment.decided) for moment in moments])),
            dvl_ns=np.array([row[0] for row in dvl], dtype=np.int64),
            dvl_velocity=np.array([row[1] for row in dvl]).reshape(-1, 3),
            paired_ns=np.array([row[0] for row in paired], dtype=np.int64),
            paired_velocity=np.array([row[1] for row in paired]).reshape(-1, 3),
            reference_velocity=np.array([row[2] for row in paired]).reshape(-1, 3),
        )


def _moment(calibrator: Calibrator) -> _Moment:
    models = {}
    for name in MODELS:
        estimate = calibrator.estimate(name)
        nis_sum = estimate.used * estimate.mean_nis if estimate.used else 0.0
        models[name] = _ModelMoment(estimate.state, estimate.std, estimate.used, nis_sum)
    pairing = calibrator.counts["pairing"]
    decided = pairing["paired"] + pairing["unpaired"]
    return _Moment(calibrator.last_ns or 0, models, pairing["paired"], decided)


def _model_history(name: str, moments: Sequence[_ModelMoment]) -> ModelHistory:
    sums = np.array([(moment.nis_sum, moment.used) for moment in moments])
    return ModelHistory(
        state=np.array([moment.state for moment in moments]),
        std=np.array([moment.std for moment in moments]),
        nis=_share(sums) / MODELS[name].n_measurement,
    )


def _share(sums: Array) -> Array:
    """Growing sums (N, 2) -> what the first gained over what the second gained since the row before (N,)."""
    gained = np.diff(sums.astype(float), axis=0, prepend=0.0)
    return np.divide(gained[:, 0], gained[:, 1], out=np.full(len(sums), np.nan), where=gained[:, 1] > 0)
