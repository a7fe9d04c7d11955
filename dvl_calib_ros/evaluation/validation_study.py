"""The published procedure over many noise seeds, with hold-out verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.models import BY_VELOCITY, MODELS
from ..calibration.models.parameters import SCHEMA, Parameters
from ..calibration.results.results import Result, Verification
from ..errors import InputError
from ..parallel import Workers, run_all
from ..version import __version__
from . import protocol
from .convergence import curves
from .estimation import SensorData, streams_of, true_prior
from .metrics import BASELINES, coverage
from .procedure import (
    Procedure,
    RunOutcome,
    SeedOutcome,
    each_runs,
    seed_or_failure,
    sensor_data,
    single_headings,
)
from .protocol import SCALES_PERCENT, load_folder, own_trajectories
from .results import (
    CalibrationRun,
    CalibrationSet,
    Coverage,
    EachStudy,
    Evaluation,
    Failure,
    HeldOut,
    mean_of_known,
)

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
        each=_each_study(procedure, each_runs(runs), [each.each for each in outcomes]),
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
    procedure: Procedure, runs: tuple[CalibrationRun, ...], outcomes: Sequence[Sequence[RunOutcome]]
) -> EachStudy | None:
    """Summarise a study. outcomes: per seed, one per run."""
    if not runs:
        return None
    return EachStudy(
        runs=runs,
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
    stretch = SensorData(data.run.part(0, end), data.velocity_dvl[:, :end], data.reference[:, :end])
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
        uncorrected=rms("uncorrected"),
        corrected=rms("corrected"),
        predicted=rms("predicted"),
        verdicts=dict(verdicts),
    )
