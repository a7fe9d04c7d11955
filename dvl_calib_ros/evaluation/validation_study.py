"""The published procedure over many noise seeds, with hold-out verdicts and convergence of the misalignment.

Shapes: B combinations of errors, N samples, E calibration times, T points of time, C columns: the uncalibrated DVL and
the models.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.calibrator import Calibrator
from ..calibration.filters.observability import OBSERVED_SHARE
from ..calibration.models import BY_VELOCITY, MODELS, Model
from ..calibration.models.parameters import SCHEMA, Parameters
from ..calibration.numerics.error_model import correction_matrix
from ..calibration.numerics.frames import FLU_FROM_FRD, Array
from ..calibration.numerics.kalman import GaussianState
from ..calibration.results.results import Result, Verification
from ..errors import InputError
from ..parallel import Workers, run_all
from ..simulation.sensors import measure_dvl, measure_gnss
from ..version import __version__
from . import protocol
from .estimation import SensorData, estimate, streams_of, true_prior
from .protocol import SCALES_PERCENT, Trajectory, load_folder, own_trajectories
from .results import (
    BASELINES,
    CalibrationRun,
    CalibrationSet,
    ConvergenceCurve,
    Coverage,
    EachStudy,
    Evaluation,
    Failure,
    HeldOut,
    RunMoments,
    coverage,
    heading_spread,
    mean_of_known,
    vrmse,
)

TIMES_S = (10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 75.0, 100.0, 150.0, 200.0)
# noise of the reference, m/s per axis: the procedure's, and a good receiver's
REFERENCE_STD = (protocol.GNSS_STD, 0.02)
# result reported for a published network that aligns a DVL: error in degrees after a time in s
PUBLISHED_DEG, PUBLISHED_S = 0.8, 25.0
_AIDED, _FREE = ("M3",), ("unaided", "M7")


def curve_keys(models: Sequence[str]) -> list[tuple[str, float | None]]:
    """Return names and noise levels of the curves for these models."""
    aided = [*(name for name in _AIDED if name in models), *BASELINES]
    keys: list[tuple[str, float | None]] = [(name, std) for std in REFERENCE_STD for name in aided]
    return keys + [(name, None) for name in _FREE if name in models]


def squared_errors(
    run: Trajectory,
    measured: Array,
    references: Mapping[float, Array],
    models: Sequence[str],
    parameters: Parameters,
    failures: list[Failure],
) -> Array:
    """Return squared errors of φ on one run (curves, T, 3) rad², averaged over combinations; nan for unusable models.

    measured: (B, N, 3) m/s.
    references: noise -> (B, N, 3) m/s.
    failures: receives exceptions.
    """
    ends = [run.first(seconds) for seconds in TIMES_S]
    truth = protocol.truth()[:, :3]
    by_key: dict[tuple[str, float | None], Array] = {}
    for std, reference in references.items():
        data = SensorData(run, measured, reference).part(0, ends[-1])
        aided = [name for name in _AIDED if name in models]
        free = [name for name in _FREE if name in models] if std == REFERENCE_STD[0] else []
        states = estimate([*aided, *free], data, parameters.replace(gnss_aided_std=std), ends, failures)
        for name, state in states.items():
            by_key[name, None if name in free else std] = mean_of_known((state.x[..., :3] - truth) ** 2, 1)
        for name, rotations in _baselines(data, ends, failures).items():
            if np.isfinite(rotations).all():  # else only this curve's share of the run is lost
                by_key[name, std] = np.mean([_rotation_errors(each, truth) ** 2 for each in rotations], axis=1)
    missing = np.full((len(TIMES_S), 3), np.nan)
    return np.stack([by_key.get(key, missing) for key in curve_keys(models)])


def _rotation_errors(body_from_dvl: Array, misalignment: Array) -> Array:
    """Return rotation vectors (B, 3) rad from the rotation of a misalignment φ (B, 3) to rotations (B, 3, 3)."""
    norm = np.linalg.norm(misalignment, axis=-1, keepdims=True)
    truth = Rotation.from_rotvec(misalignment / norm * np.arctan(norm))  # see `error_model.corrected_mounting`
    found = Rotation.from_matrix(np.swapaxes(body_from_dvl, -1, -2))
    return np.asarray((found * truth.inv()).as_rotvec())


def curves(models: Sequence[str], squares: Array) -> tuple[ConvergenceCurve, ...]:
    """Average squared errors (..., curves, T, 3) rad² over seeds and runs; nan if a curve cannot run."""
    mean = mean_of_known(squares, tuple(range(squares.ndim - 3)))
    return tuple(
        ConvergenceCurve(name, std, np.sqrt(each))
        for (name, std), each in zip(curve_keys(models), mean, strict=True)
        if np.isfinite(each).all()
    )


def curves_document(found: Sequence[ConvergenceCurve]) -> dict[str, Any]:
    """Return the curves as plain data for JSON, in degrees."""
    return {
        "times_s": list(TIMES_S),
        "published": {"seconds": PUBLISHED_S, "degrees": PUBLISHED_DEG},
        "curves": [
            {
                "name": each.name,
                "gnss_std": each.gnss_std,
                "angle_deg": each.angle_deg.tolist(),
                "pitch_and_yaw_deg": each.level_deg.tolist(),
            }
            for each in found
        ],
    }


# One noise seed of the published procedure and of the studies around it.

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

    by_time: (E, C) Avg.VRMSE m/s after each window. The others are after the run's own window: avg_vrmse (C,).
    errors, std: model -> (B, n) estimate - truth of the error states, and the claimed σ.
    yaw_observed: (M,) share of combinations.
    """

    by_time: Array
    avg_vrmse: Array
    errors: Mapping[str, Array]
    std: Mapping[str, Array]
    yaw_observed: Array


@dataclass(frozen=True)
class SeedOutcome:
    """Result of one seed. by_set: one per set, E are the windows of `protocol.WINDOWS_S`.

    each, single_heading: one per stretch of `whole_runs` and `single_headings`.
    baselines: (S, K) Avg.VRMSE of `baselines.BASELINES`.
    convergence: (L, curves, T, 3) squared errors of the misalignment over time on each run, see `convergence`.
    failures: exceptions, whose results are nan.
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
        """Calibrate on a stretch after each window, and evaluate on all other runs."""
        others = _moments_of_others(moments, stretch.run.name)
        ends = [stretch.run.first(window) for window in windows]
        return _calibrate_once(models, stretch, ends, windows.index(own_window), others, procedure, failures)

    by_set = tuple(
        outcome(procedure.models, data(each.calibration_run), protocol.WINDOWS_S, each.window_s)
        for each in procedure.sets
    )
    baselines = np.array(
        [
            [
                float(vrmse(_moments_of_others(moments, each.calibration_run), rotations[0]).mean())
                for rotations in _baselines(stretch, [stretch.run.first(each.window_s)], failures).values()
            ]
            for each, stretch in ((each, data(each.calibration_run)) for each in procedure.sets)
        ]
    )
    if not procedure.studies:
        none = np.empty((0, len(curve_keys(procedure.studied)), len(TIMES_S), 3))
        return SeedOutcome(by_set, (), (), baselines, none, _of_seed(failures, seed))
    each, single_heading = (
        tuple(outcome(procedure.studied, data(name).part(start, end), [None], None) for name, start, end in stretches)
        for stretches in (whole_runs(procedure.runs), single_headings(procedure.runs))
    )
    squares = [
        squared_errors(
            procedure.runs[name],
            measured[name],
            {std: references(procedure.runs[name], seed, std) for std in REFERENCE_STD},
            procedure.studied,
            procedure.parameters,
            failures,
        )
        for name, *_ in whole_runs(procedure.runs)
    ]
    convergence = np.stack(squares or [np.full((len(curve_keys(procedure.studied)), len(TIMES_S), 3), np.nan)])
    return SeedOutcome(by_set, each, single_heading, baselines, convergence, _of_seed(failures, seed))


def seed_or_failure(procedure: Procedure, seed: int) -> SeedOutcome | Failure:
    """Return `run_seed`, or its exception."""
    try:
        return run_seed(procedure, seed)
    except Exception as error:
        return replace(Failure.of(error, "everything"), seed=seed)


def _of_seed(failures: Sequence[Failure], seed: int) -> tuple[Failure, ...]:
    return tuple(replace(each, seed=seed) for each in failures)


def _moments_of_others(moments: Mapping[str, RunMoments], name: str) -> RunMoments:
    return RunMoments.stack([each for other, each in moments.items() if other != name])


def _baselines(data: SensorData, ends: Sequence[int], failures: list[Failure]) -> dict[str, Array]:
    """Return rotations (E, B, 3, 3) by each baseline after the first `ends` samples; nan if it raises."""
    found: dict[str, Array] = {}
    for name, align in BASELINES.items():
        try:
            parts = ((data.run.time[:n], data.velocity_dvl[:, :n], data.reference[:, :n]) for n in ends)
            found[name] = np.stack([align(*part) for part in parts])
        except Exception as error:
            failures.append(Failure.of(error, name, data.run.name))
            found[name] = np.full((len(ends), len(data.velocity_dvl), 3, 3), np.nan)
    return found


def sensor_data(run: Trajectory, seed: int) -> SensorData:
    """Simulate the sensors of a run with every combination of errors."""
    return SensorData(run, dvl_velocities(run, seed), references(run, seed))


def dvl_velocities(run: Trajectory, seed: int) -> Array:
    """Simulate DVL velocities (B, N, 3) m/s with every combination of errors."""
    of_dvl = run.velocity @ FLU_FROM_FRD
    return np.stack(
        [
            measure_dvl(of_dvl, errors, np.eye(3), protocol.random_stream("dvl", seed, run.name, index)) @ FLU_FROM_FRD
            for index, errors in enumerate(protocol.COMBINATIONS)
        ]
    )


def references(run: Trajectory, seed: int, gnss_std: float = protocol.GNSS_STD) -> Array:
    """Simulate a GNSS velocity (B, N, 3) m/s, with noise of its own for each combination of misalignment and scale."""
    return np.stack(
        [
            measure_gnss(run.velocity, gnss_std, protocol.random_stream("gnss", seed, run.name, index))
            for index in range(len(protocol.COMBINATIONS))
        ]
    )


def corrections(model: Model, state: GaussianState) -> Array:
    """Return correction matrices (..., 3, 3) of states x (..., n)."""
    terms = state.x @ model.error_terms_from_state.T
    return correction_matrix(terms[..., :3], terms[..., 3:], np.eye(3))


def true_state(model: Model) -> Array:
    """Return the true error states (B, n) of a model; a scale common to several axes is their mean."""
    from_state = model.error_terms_from_state[:, : model.n_errors]
    return protocol.truth() @ np.linalg.pinv(from_state).T


def _calibrate_once(
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


Stretch = tuple[str, int, int]
"""A trajectory's name, the first sample of a part of it, and the one after the last."""


def whole_runs(runs: Mapping[str, Trajectory]) -> list[Stretch]:
    """Return all trajectories with attitude."""
    return [(name, 0, len(run.time)) for name, run in runs.items() if run.rotation_enu_from_body is not None]


def single_headings(runs: Mapping[str, Trajectory]) -> list[Stretch]:
    """Return the stretches of one heading of these trajectories."""
    return [leg for name, *_ in whole_runs(runs) for leg in _legs(runs[name])]


def _calibration_run(run: Trajectory, start: int, end: int) -> CalibrationRun:
    """Return a stretch of samples start .. end - 1 with its times and spread of headings."""
    rotation = run.rotation_enu_from_body
    assert rotation is not None  # only runs with attitude get here
    from_s, to_s = (float(run.time[at] - run.time[0]) for at in (start, end - 1))
    return CalibrationRun(run.name, from_s, to_s, heading_spread(rotation[start:end]))


def _legs(run: Trajectory) -> list[Stretch]:
    """Return stretches on one heading, greedily from the start."""
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


# without models that need a calibration per combination: they take minutes, and run only where they are named
EVALUATED = tuple(name for name in BY_VELOCITY if not MODELS[name].estimator)
# Parameters that differ from a live calibration: the published procedure has no gate, and M5 and M6 match the published
# results with the prior from the reference velocity. Its GNSS measures three axes, also if heave is zero.
DEFAULTS: Mapping[str, Any] = {"gate_probability": 0.0, "prior_source": "reference", "gnss_axes": "xyz"}
# the DVL is mounted without rotation, at the reference point, without delay, and its errors are constant
FIXED = ("mounting_rpy", "lever_arm", "dvl_time_offset", "initial_calibration", "process_std_misalignment",
         "process_std_scale", "max_speed")  # fmt: skip
# number of failures named in a note
NAMED_FAILURES = 5

OWN_NOTES: tuple[str, ...] = ("simulated trajectories: the published figures are for others, so no ratio is given",)


def evaluate(
    folder: Path | None,
    parameters: Parameters,
    *,
    models: Sequence[str] = EVALUATED,
    sets: Sequence[str] = tuple(protocol.PUBLISHED),
    n_seeds: int = 1,
    partial_folder: bool = False,
    workers: Workers = Workers(),  # noqa: B008  (frozen)
    on_progress: Callable[[float], None] = lambda _: None,
) -> Evaluation:
    """Run the procedure on a folder of trajectories, or on simulated ones.

    parameters: as for the node, see `DEFAULTS` and `FIXED`. Estimates that raise are omitted, and listed in
    `Evaluation.failures` and its notes. Raises InputError, also if no result remains.
    """
    runs, notes = (own_trajectories(), OWN_NOTES) if folder is None else load_folder(folder, partial_folder)
    parameters, ignored = _for_procedure(parameters)
    procedure = Procedure(
        runs=runs,
        models=tuple(models),
        sets=tuple(each for each in protocol.SETS if each.name in sets),
        parameters=parameters,
    )
    seeds = tuple(range(n_seeds))
    total = n_seeds + len(procedure.sets)
    by_seed = run_all(partial(seed_or_failure, procedure), seeds, workers, lambda x: on_progress(x * n_seeds / total))
    outcomes = [each for each in by_seed if isinstance(each, SeedOutcome)]
    failures = [each for each in by_seed if isinstance(each, Failure)]
    failures += [failure for each in outcomes for failure in each.failures]
    seeds = tuple(seed for seed, each in zip(seeds, by_seed, strict=True) if isinstance(each, SeedOutcome))
    avg_vrmse = np.array([[run.avg_vrmse for run in each.by_set] for each in outcomes])  # (Q, S, C)
    if not np.isfinite(avg_vrmse[..., 1:]).any():
        why = f"; the first: {failures[0]}" if failures else ""
        raise InputError(f"no model has an estimate on any of the sets, so there is nothing to evaluate{why}")
    verified = run_all(
        partial(verify_set, procedure, seeds[0]),
        procedure.sets,
        workers,
        lambda x: on_progress((n_seeds + x * len(procedure.sets)) / total),
    )
    held_out, failed = zip(*verified, strict=True)
    failures += [failure for of_set in failed for failure in of_set]
    own_generator = folder is None
    return Evaluation(
        source="own generator (simulated trajectories)" if own_generator else f"folder {folder}",
        own_generator=own_generator,
        notes=(*notes, *ignored, *_failure_notes(failures)),
        trajectories=tuple(runs),
        models=procedure.models,
        sets=procedure.sets,
        seeds=seeds,
        n_combinations=len(protocol.COMBINATIONS),
        avg_vrmse=np.moveaxis(avg_vrmse, 0, -1),
        windows_s=protocol.WINDOWS_S,
        avg_vrmse_by_time=np.stack([[run.by_time for run in each.by_set] for each in outcomes], axis=-1),
        published=protocol.PUBLISHED,
        coverage=_coverage(procedure.models, [run for each in outcomes for run in each.by_set]),
        coverage_of_all=_coverage(procedure.models, [run for each in outcomes for run in (*each.by_set, *each.each)]),
        each=_each_study(procedure, whole_runs(runs), [each.each for each in outcomes]),
        single_heading=_each_study(procedure, single_headings(runs), [each.single_heading for each in outcomes]),
        parameters=parameters.as_dict(),
        version=__version__,
        held_out=tuple(each for of_set in held_out for each in of_set),
        baselines=dict(
            zip(BASELINES, mean_of_known(np.array([each.baselines for each in outcomes]), 0).T, strict=True)
        ),
        convergence=curves(procedure.studied, np.stack([each.convergence for each in outcomes])),
        failures=tuple(failures),
    )


def _failure_notes(failures: Sequence[Failure]) -> list[str]:
    """Return a note with the number of failures and the first one."""
    if not failures:
        return []
    named = "; ".join(map(str, failures[:NAMED_FAILURES]))
    more = f"; and {len(failures) - NAMED_FAILURES} more, see failures in --json" * (len(failures) > NAMED_FAILURES)
    return [f"{len(failures)} failed and {'is' if len(failures) == 1 else 'are'} in none of the figures: {named}{more}"]


def _for_procedure(parameters: Parameters) -> tuple[Parameters, tuple[str, ...]]:
    """Return the procedure's parameters, and a note on every parameter that it ignores."""
    defaults = {name: SCHEMA[name].default for name in FIXED}
    ignored = [name for name, default in defaults.items() if getattr(parameters, name) != default]
    notes = tuple(f"{name} is not used by the procedure" for name in ignored)
    return parameters.replace(**defaults), notes


def _coverage(models: Sequence[str], outcomes: Sequence[RunOutcome]) -> tuple[Coverage, ...]:
    """Return the coverage of the intervals of every model, over all runs."""
    found = []
    for name in models:
        ran = [each for each in outcomes if name in each.errors]
        if ran:
            errors, std = (np.concatenate([getattr(each, what)[name] for each in ran]) for what in ("errors", "std"))
            known = np.isfinite(errors).all(axis=1)
            model = MODELS[name]
            if known.any():
                found.append(coverage(name, model.state_names[: model.n_errors], errors[known], std[known]))
    return tuple(found)


def _each_study(
    procedure: Procedure, stretches: Sequence[Stretch], outcomes: Sequence[Sequence[RunOutcome]]
) -> EachStudy | None:
    """Summarise a study of calibrations on each stretch. outcomes: per seed, one per stretch."""
    if not stretches:
        return None
    return EachStudy(
        runs=tuple(_calibration_run(procedure.runs[name], start, end) for name, start, end in stretches),
        avg_vrmse=np.stack([[run.avg_vrmse for run in seed] for seed in outcomes], axis=-1),
        yaw_observed=mean_of_known(np.array([[run.yaw_observed for run in seed] for seed in outcomes]), 0),
        coverage=_coverage(procedure.models, [run for seed in outcomes for run in seed]),
    )


# one scale per misalignment, because individual calibrations take ten times longer than vectorised ones
VERIFIED = slice(None, None, len(SCALES_PERCENT))


def verify_set(
    procedure: Procedure, seed: int, calibration_set: CalibrationSet
) -> tuple[tuple[HeldOut, ...], tuple[Failure, ...]]:
    """Verify each usable model on the set, over `VERIFIED` combinations of errors; also return failures."""
    failures: list[Failure] = []
    data = sensor_data(procedure.runs[calibration_set.calibration_run], seed)
    results = _calibrate(data, data.run.first(calibration_set.window_s), procedure, failures)
    held_out = tuple(
        _summary(calibration_set.name, name, [result.verifications[name] for result in results])
        for name in procedure.models
        if results and results[0].estimates[name].used
    )
    return held_out, tuple(replace(each, seed=seed) for each in failures)


def _calibrate(data: SensorData, end: int, procedure: Procedure, failures: list[Failure]) -> list[Result]:
    """Calibrate every `VERIFIED` combination on the first `end` samples, without those that raise."""
    parameters = procedure.parameters
    prior = true_prior(data, parameters)
    stretch = data.part(0, end)
    results = []
    for variant in range(len(data.velocity_dvl))[VERIFIED]:
        try:
            calibrator = Calibrator(
                parameters, prior_sway_heave=prior, block_size=end, verified=True, models=procedure.models
            )
            calibrator.feed(streams_of(stretch, variant))
            results.append(calibrator.result())
        except Exception as error:
            failures.append(Failure.of(error, "hold-out verification", data.run.name, variant))
    return results


def _summary(set_name: str, model: str, found: Sequence[Verification]) -> HeldOut:
    """Summarize a model's verifications over the runs of a set: most frequent verdict, rms errors."""
    verdicts = Counter(each.verdict.value for each in found)
    errors = [each.held_out for each in found if each.held_out is not None]

    def rms(name: str) -> float:
        return float(np.sqrt(np.mean([getattr(each, name) ** 2 for each in errors]))) if errors else float("nan")

    return HeldOut(
        set_name=set_name,
        model=model,
        verdict=verdicts.most_common(1)[0][0],
        **{kind: rms(kind) for kind in ("uncorrected", "corrected", "predicted")},
        verdicts=dict(verdicts),
    )
