"""Convergence of the misalignment: its error over calibration time, from ten seconds on.

Shapes: B combinations of errors, N samples, T points of time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..calibration.models.parameters import Parameters
from ..calibration.numerics.frames import Array
from . import protocol
from .estimation import SensorData, estimate
from .protocol import Trajectory
from .results import BASELINES, ConvergenceCurve, Failure, mean_of_known

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
        for name, align in BASELINES.items():
            try:
                rotations = [
                    align(data.run.time[:end], data.velocity_dvl[:, :end], data.reference[:, :end]) for end in ends
                ]
                errors = np.stack([_rotation_errors(each, truth) for each in rotations])
            except Exception as error:  # only this curve's share of the run is lost
                failures.append(Failure.of(error, name, run.name))
                continue
            by_key[name, std] = (errors**2).mean(axis=1)
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
