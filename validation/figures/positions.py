"""What D1 makes of positions: yaw and scale of simulated half hours, and how often their σ holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..positions import NOISES, drawn, driven, errors_of, fitted
from .registry import LONG, Found, measurement

RUNS, SECONDS = 100, 1800.0


@measurement(
    cost=LONG,
    command="half hours of a lawnmower's lines at 1.5 m/s, a position each second",
    seeds=f"seeds 0 to {RUNS - 1} for each noise",
    tolerances={"*.inside": 4.0, "*": "15%"},
)
def positions(folder: Path) -> Found:
    """By noise: median σ and rms of the error of yaw (degrees) and scale (per cent); per cent of them within 2 σ."""
    found: dict[str, float] = {}
    for kind, noise in NOISES.items():
        errors, stds = [], []
        for seed in range(RUNS):
            rng = np.random.default_rng(seed)
            truth = drawn(rng)
            error, std = errors_of(fitted(driven(rng, SECONDS, truth=truth, noise=noise)), truth)
            errors.append(error)
            stds.append(std)
        for at, (name, unit) in enumerate((("yaw", np.degrees(1.0)), ("scale", 100.0))):
            error, std = np.array(errors)[:, at] * unit, np.array(stds)[:, at] * unit
            found[f"{kind}.{name}_std"] = float(np.median(std))
            found[f"{kind}.{name}_rms"] = float(np.sqrt((error**2).mean()))
            found[f"{kind}.{name}.inside"] = 100.0 * float((np.abs(error) < 2.0 * std).mean())
    return found
