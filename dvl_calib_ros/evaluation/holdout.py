"""Hold-out verdicts of the procedure's calibrations, by the calibrator itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.results import Result
from ..calibration.verification import Verification
from .estimation import SensorData, streams_of, true_prior
from .procedure import Procedure, sensor_data
from .protocol import SCALES_PERCENT
from .results import CalibrationSet, Failure, HeldOut

# One combination of every misalignment: one by one takes ten times longer than many at once
VERIFIED = slice(None, None, len(SCALES_PERCENT))


def verify_set(
    procedure: Procedure, seed: int, calibration_set: CalibrationSet
) -> tuple[tuple[HeldOut, ...], tuple[Failure, ...]]:
    """One entry per model that runs on the set, over `VERIFIED` combinations of errors; and those that raised."""
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
    """Result of every `VERIFIED` combination over the first `end` samples, without those that raise."""
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
