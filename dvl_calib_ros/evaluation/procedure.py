"""One noise seed of the published procedure and of the studies around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibration.filters.observability import OBSERVED_SHARE
from ..calibration.models import MODELS, Model
from ..calibration.models.parameters import Parameters
from ..calibration.numerics.error_model import correction_matrix
from ..calibration.numerics.frames import Array
from ..calibration.numerics.kalman import GaussianState
from . import protocol
from .convergence import REFERENCE_STD, TIMES_S, curve_keys, squared_errors
from .estimation import SensorData, estimate
from .metrics import BASELINES, RunMoments, heading_spread, vrmse
from .protocol import Trajectory
from .results import CalibrationRun, CalibrationSet, Failure, mean_of_known

# largest heading range of a leg of a single heading, and smallest length for a calibration
LEG_HEADING_RANGE = np.deg2rad(25.0)
LEG_SAMPLES = 60


@dataclass(frozen=True)
class Procedure:
    """Configuration of a run. runs: trajectories by name. studies: False for the published procedure only."""

    runs: Mapping[str, Trajectory]
    models: tuple[str, ...]
    sets: tuple[CalibrationSet, ...]
    parameters: Parameters
    studies: bool = True

    @property
    def studied(self) -> tuple[str, ...]:
        """Models of the studies: filters alone, because an estimator needs a calibration per error combination."""
        return tuple(name for name in self.models if not MODELS[name].estimator)

    @property
    def n_columns(self) -> int:
        """Number of columns: uncalibrated and the models."""
        return 1 + len(self.models)


@dataclass(frozen=True)
class RunOutcome:
    """Result of calibrating on one run (B combinations); nan for unusable models.

    by_time: (E, C) Avg.VRMSE m/s after each window. The others are after the run's own window: avg_vrmse (C,). errors,
    std: model -> (B, n) estimate - truth of the error states, and the claimed σ. yaw_observed: (M,) share of
    combinations.
    """

    by_time: Array
    avg_vrmse: Array
    errors: Mapping[str, Array]
    std: Mapping[str, Array]
    yaw_observed: Array


@dataclass(frozen=True)
class SeedOutcome:
    """Result of one seed. by_set: one per set, E are the windows of `protocol.WINDOWS_S`.

    each, single_heading: one per run of `each_runs` and `single_headings`. baselines: (S, K) Avg.VRMSE of
    `baselines.BASELINES`. convergence: (L, curves, T, 3) squared errors of the misalignment over time on each run, see
    `convergence`. failures: exceptions, whose results are nan.
    """

    by_set: tuple[RunOutcome, ...]
    each: tuple[RunOutcome, ...]
    single_heading: tuple[RunOutcome, ...]
    baselines: Array
    convergence: Array
    failures: tuple[Failure, ...] = ()


def run_seed(procedure: Procedure, seed: int) -> SeedOutcome:
    """Run the whole procedure with one noise seed."""
    measured = {name: dvl_velocities(run, seed) for name, run in procedure.runs.items()}
    moments = {name: RunMoments.of(measured[name], run.velocity) for name, run in procedure.runs.items()}
    failures: list[Failure] = []

    def data(name: str) -> SensorData:
        return SensorData(procedure.runs[name], measured[name], references(procedure.runs[name], seed))

    def outcome(
        models: Sequence[str], stretch: SensorData, windows: Sequence[float | None], own_window: float | None
    ) -> RunOutcome:
        others = _others(moments, stretch.run.name)
        ends = [stretch.run.first(window) for window in windows]
        return _calibrate(models, stretch, ends, windows.index(own_window), others, procedure, failures)

    by_set = tuple(
        outcome(procedure.models, data(each.calibration_run), protocol.WINDOWS_S, each.window_s)
        for each in procedure.sets
    )
    baselines = np.array(
        [
            [
                float(vrmse(_others(moments, each.calibration_run), matrices).mean())
                for matrices in _baselines(data(each.calibration_run), each.window_s, failures)
            ]
            for each in procedure.sets
        ]
    )
    if not procedure.studies:
        none = np.empty((0, len(curve_keys(procedure.studied)), len(TIMES_S), 3))
        return SeedOutcome(by_set, (), (), baselines, none, _of_seed(failures, seed))
    with_attitude = runs_with_attitude(procedure.runs)
    legs = [leg for name in with_attitude for leg in _legs(procedure.runs[name])]
    outcome_of_seed = SeedOutcome(
        by_set=by_set,
        each=tuple(outcome(procedure.studied, data(name), [None], None) for name in with_attitude),
        single_heading=tuple(
            outcome(procedure.studied, _part(data(name), start, end), [None], None) for name, start, end in legs
        ),
        baselines=baselines,
        convergence=np.stack(
            [
                squared_errors(
                    procedure.runs[name],
                    measured[name],
                    {std: references(procedure.runs[name], seed, std) for std in REFERENCE_STD},
                    procedure.studied,
                    procedure.parameters,
                    failures,
                )
                for name in with_attitude
            ]
            or [np.full((len(curve_keys(procedure.studied)), len(TIMES_S), 3), np.nan)]
        ),
    )
    return replace(outcome_of_seed, failures=_of_seed(failures, seed))


def seed_or_failure(procedure: Procedure, seed: int) -> SeedOutcome | Failure:
    """Return `run_seed`, or its exception."""
    try:
        return run_seed(procedure, seed)
    except Exception as error:
        return replace(Failure.of(error, "everything"), seed=seed)


def _of_seed(failures: Sequence[Failure], seed: int) -> tuple[Failure, ...]:
    return tuple(replace(each, seed=seed) for each in failures)


def _others(moments: Mapping[str, RunMoments], name: str) -> RunMoments:
    return RunMoments.stack([each for other, each in moments.items() if other != name])


def _baselines(data: SensorData, window_s: float | None, failures: list[Failure]) -> list[Array]:
    """Return corrections (B, 3, 3) by each baseline; nan if it raises."""
    end = data.run.first(window_s)
    found = []
    for name, align in BASELINES.items():
        try:
            found.append(align(data.run.time[:end], data.velocity_dvl[:, :end], data.reference[:, :end]))
        except Exception as error:
            failures.append(Failure.of(error, name, data.run.name))
            found.append(np.full((len(data.velocity_dvl), 3, 3), np.nan))
    return found


def sensor_data(run: Trajectory, seed: int) -> SensorData:
    """Simulate the sensors of a run with every combination of errors."""
    return SensorData(run, dvl_velocities(run, seed), references(run, seed))


def dvl_velocities(run: Trajectory, seed: int) -> Array:
    """Simulate DVL velocities (B, N, 3) m/s with every combination of errors."""
    return np.stack(
        [
            protocol.unit_under_test(run.velocity, errors, protocol.random_stream("dvl", seed, run.name, index))
            for index, errors in enumerate(protocol.COMBINATIONS)
        ]
    )


def references(run: Trajectory, seed: int, gnss_std: float = protocol.GNSS_STD) -> Array:
    """Simulate GNSS velocities (B, N, 3) m/s, with independent noise per combination."""
    return np.stack(
        [
            protocol.reference(run.velocity, protocol.random_stream("gnss", seed, run.name, index), gnss_std)
            for index in range(len(protocol.COMBINATIONS))
        ]
    )


def _part(data: SensorData, start: int, end: int) -> SensorData:
    return SensorData(data.run.part(start, end), data.velocity_dvl[:, start:end], data.reference[:, start:end])


def corrections(model: Model, state: GaussianState) -> Array:
    """Return correction matrices (..., 3, 3) of states x (..., n)."""
    terms = state.x @ model.error_terms_from_state.T
    return correction_matrix(terms[..., :3], terms[..., 3:], np.eye(3))


def true_state(model: Model) -> Array:
    """Return the true error states (B, n) of a model; a scale common to several axes is their mean."""
    from_state = model.error_terms_from_state[:, : model.n_errors]
    return protocol.truth() @ np.linalg.pinv(from_state).T


def _calibrate(
    models: Sequence[str],
    data: SensorData,
    ends: Sequence[int],
    own: int,
    others: RunMoments,
    procedure: Procedure,
    failures: list[Failure],
) -> RunOutcome:
    """Calibrate some of the procedure's models on one run. own: index of the run's own window."""
    states = estimate(models, data, procedure.parameters, ends, failures)
    n_variants = len(data.velocity_dvl)
    matrices = np.full((len(ends), procedure.n_columns, n_variants, 3, 3), np.nan)
    matrices[:, 0] = np.eye(3)
    yaw_observed = np.full(len(procedure.models), np.nan)
    errors, std = {}, {}
    observed_std = OBSERVED_SHARE * procedure.parameters.initial_std_misalignment
    for index, name in enumerate(procedure.models):
        if name not in states:
            continue
        model, state = MODELS[name], states[name]
        matrices[:, 1 + index] = corrections(model, state)
        errors[name] = state.x[own, :, : model.n_errors] - true_state(model)
        std[name] = np.sqrt(np.diagonal(state.p[own], axis1=1, axis2=2)[:, : model.n_errors])
        yaw_std = std[name][:, 2]
        yaw_observed[index] = mean_of_known(np.where(np.isnan(yaw_std), np.nan, yaw_std <= observed_std), 0)
    by_time = mean_of_known(vrmse(others, matrices[:, :, None]), (-1, -2))  # (E, C, others, B) -> (E, C)
    return RunOutcome(by_time, by_time[own], errors, std, yaw_observed)


def runs_with_attitude(runs: Mapping[str, Trajectory]) -> list[str]:
    """Return the names of the trajectories with attitude."""
    return [name for name, run in runs.items() if run.rotation_enu_from_body is not None]


def each_runs(runs: Mapping[str, Trajectory]) -> tuple[CalibrationRun, ...]:
    """Return the calibration runs of `SeedOutcome.each`."""
    return tuple(_described(runs[name], 0, len(runs[name].time)) for name in runs_with_attitude(runs))


def single_headings(runs: Mapping[str, Trajectory]) -> tuple[CalibrationRun, ...]:
    """Return the calibration runs of `SeedOutcome.single_heading`."""
    legs = [leg for name in runs_with_attitude(runs) for leg in _legs(runs[name])]
    return tuple(_described(runs[name], start, end) for name, start, end in legs)


def _described(run: Trajectory, start: int, end: int) -> CalibrationRun:
    rotation = run.rotation_enu_from_body
    assert rotation is not None  # only runs with attitude get here
    from_s, to_s = (float(run.time[at] - run.time[0]) for at in (start, end - 1))
    return CalibrationRun(run.name, from_s, to_s, heading_spread(rotation[start:end]))


def _legs(run: Trajectory) -> list[tuple[str, int, int]]:
    """Return stretches (name, start, end) on one heading, greedily from the start."""
    rotation = run.rotation_enu_from_body
    assert rotation is not None
    heading = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    legs = []
    start = 0
    while start + LEG_SAMPLES <= len(heading):
        stretch = heading[start:]
        has_turned = np.maximum.accumulate(stretch) - np.minimum.accumulate(stretch) > LEG_HEADING_RANGE
        length = int(np.argmax(has_turned)) if has_turned.any() else len(stretch)
        if length >= LEG_SAMPLES:
            legs.append((run.name, start, start + length))
            start += length
        else:
            start += 1
    return legs
