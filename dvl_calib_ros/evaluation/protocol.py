"""The published validation procedure: what is added to a recorded velocity, on which sets, and what was published.

Source: Yampolsky and Klein, "Information-Aided DVL Calibration"; the paper publishes neither P0, R nor its noise
seeds. Errors and beams are those of the recorded frame (forward-right-down); what comes out is forward-left-up.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import product
from zlib import crc32

import numpy as np

from ..calibration.numerics.frames import FLU_FROM_FRD, Array
from ..simulation.sensors import DvlErrors, equivalent_error_terms, measure_dvl, measure_gnss
from .results import UNCALIBRATED, CalibrationSet

MISALIGNMENTS_DEG = ((5.0, -0.5, 2.5), (0.5, 1.0, -1.5), (-2.5, 1.8, 4.0), (-1.0, -2.5, -3.0), (2.0, 0.5, 4.2))
SCALES_PERCENT = ((0.5, 0.3, 0.7), (0.2, 0.7, 0.6), (0.9, 0.5, 0.1))
BEAM_BIAS = (0.007, 0.001, 0.003, 0.009)
BEAM_STD = 0.005
GNSS_STD = 0.2

SETS = (
    CalibrationSet("E1", "T12", 200.0),
    CalibrationSet("E2", "T13", None),
    CalibrationSet("E3", "T14", None),
    CalibrationSet("E4", "T15", None),
)
WINDOWS_S: tuple[float | None, ...] = (50.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0, None)
# Runs that the models with attitude are judged on: manoeuvres, none of them a calibration run of the paper
MANOEUVRING = tuple(f"T{number:02d}" for number in range(1, 11))
TRAJECTORIES = tuple(f"T{number:02d}" for number in range(1, 16))

_COLUMNS = (UNCALIBRATED, "M1", "M2", "M3", "M4", "M5", "M6", "M7")
_ROWS = {
    "E1": (0.1185, 0.0522, 0.0421, 0.0342, 0.0400, 0.0665, 0.0646, 0.0625),
    "E2": (0.1173, 0.0416, 0.0396, 0.0294, 0.0371, 0.0893, 0.0945, 0.0739),
    "E3": (0.1197, 0.0550, 0.0391, 0.0304, 0.0328, 0.0634, 0.0625, 0.0798),
    "E4": (0.1197, 0.0529, 0.0411, 0.0564, 0.0413, 0.1058, 0.1229, 0.0888),
}
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    name: dict(zip(_COLUMNS, row, strict=True)) for name, row in _ROWS.items()
}


def _errors(angles_deg: tuple[float, float, float], percent: tuple[float, float, float]) -> DvlErrors:
    roll, pitch, yaw = np.deg2rad(angles_deg).tolist()
    x, y, z = (0.01 * value for value in percent)
    return DvlErrors((roll, pitch, yaw), (x, y, z), BEAM_BIAS, BEAM_STD)


COMBINATIONS: tuple[DvlErrors, ...] = tuple(
    _errors(angles, percent) for angles, percent in product(MISALIGNMENTS_DEG, SCALES_PERCENT)
)


def combination_in_words(index: int) -> str:
    """A combination as a reader wants it."""
    angles, percent = list(product(MISALIGNMENTS_DEG, SCALES_PERCENT))[index]
    return f"misalignment {angles} °, scale {percent} %, forward-right-down"


@cache
def truth() -> Array:
    """φ (rad) and δk (B, 6) of every combination, as an estimate in forward-left-up should find them.

    The beam biases are in no model's state.
    """
    pairs = [equivalent_error_terms(errors) for errors in COMBINATIONS]
    return np.array([[*FLU_FROM_FRD @ misalignment, *scale] for misalignment, scale in pairs])


def unit_under_test(velocity_flu: Array, errors: DvlErrors, rng: np.random.Generator) -> Array:
    """What the DVL with these errors measures (N, 3) m/s of a velocity over ground, both forward-left-up."""
    return measure_dvl(velocity_flu @ FLU_FROM_FRD, errors, np.eye(3), rng) @ FLU_FROM_FRD


def reference(velocity_flu: Array, rng: np.random.Generator, gnss_std: float = GNSS_STD) -> Array:
    """The GNSS velocity (N, 3) m/s of a velocity over ground, body frame."""
    return measure_gnss(velocity_flu, gnss_std, rng)


def random_stream(sensor: str, seed: int, trajectory: str, combination: int) -> np.random.Generator:
    """Generator of one sensor's noise.

    Keyed by what it is for, so that no result depends on the order or the number of workers.
    """
    return np.random.default_rng([seed, combination, crc32(f"{sensor} {trajectory}".encode())])
