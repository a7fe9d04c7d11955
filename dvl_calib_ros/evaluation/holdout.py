"""Hold-out verdicts of the procedure's calibrations, by the calibrator itself, fed sample by sample as live."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from ..calibration.calibrator import Calibrator
from ..calibration.frames import quaternion_from_rotation
from ..calibration.results import Result
from ..calibration.samples import DvlSample, ImuSample, ReferenceSample
from ..calibration.verification import Verification
from .estimation import SensorData, prior_sway_heave, usable_samples
from .procedure import Procedure, sensor_data
from .protocol import SCALES_PERCENT
from .results import CalibrationSet, HeldOut

# One combination of every misalignment: sample by sample takes a hundred times longer than many at once
VERIFIED = slice(None, None, len(SCALES_PERCENT))
_BLOCK_SIZE = 512
_START_S = 1_600_000_000


def verify_set(procedure: Procedure, seed: int, calibration_set: CalibrationSet) -> tuple[HeldOut, ...]:
    """One entry per model that runs on the set, over `VERIFIED` combinations of errors."""
    data = sensor_data(procedure.runs[calibration_set.calibration_run], seed)
    results = _calibrate(data, data.run.first(calibration_set.window_s), procedure)
    return tuple(
        _summary(calibration_set.name, name, [result.verifications[name] for result in results])
        for name in procedure.models
        if results[0].estimates[name].used
    )


def _calibrate(data: SensorData, end: int, procedure: Procedure) -> list[Result]:
    """Result of every `VERIFIED` combination over the first `end` samples."""
    parameters = procedure.parameters
    sway_heave, _ = prior_sway_heave(data, usable_samples(data, parameters), parameters)
    stamps_ns = [round((_START_S + t) * 1e9) for t in data.run.time[:end].tolist()]
    imu = _imu_samples(data, stamps_ns)
    results = []
    for measured, reference, (sway, heave) in zip(
        data.velocity_dvl[VERIFIED], data.reference[VERIFIED], sway_heave[VERIFIED].tolist(), strict=True
    ):
        calibrator = Calibrator(parameters, prior_sway_heave=(sway, heave), block_size=_BLOCK_SIZE, verified=True)
        for index, (stamp_ns, (vx, vy, vz), (gx, gy, gz)) in enumerate(
            zip(stamps_ns, measured[:end].tolist(), reference[:end].tolist(), strict=True)
        ):
            if imu:
                calibrator.feed_imu(imu[index])
            calibrator.feed_reference(ReferenceSample(stamp_ns, (gx, gy, gz)))
            calibrator.feed_dvl(DvlSample(stamp_ns, (vx, vy, vz)))
        results.append(calibrator.result())
    return results


def _imu_samples(data: SensorData, stamps_ns: Sequence[int]) -> list[ImuSample]:
    rotations, rates = data.run.rotation_enu_from_body, data.run.angular_velocity
    if rotations is None or rates is None:
        return []
    return [
        ImuSample(stamp_ns, quaternion_from_rotation(rotation), (x, y, z))
        for stamp_ns, rotation, (x, y, z) in zip(stamps_ns, rotations, rates.tolist(), strict=False)
    ]


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
