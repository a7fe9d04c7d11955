"""Errors of recorded less simulated, by recording and regime of motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..calibration.frames import Array
from ..diagnosis.series import HeldOutTwin
from .document import Table

ALL = "all of the run"


def rms(values: Array) -> float:
    """m/s of the vector, of values (N, 3)."""
    return float(np.sqrt((values**2).sum(axis=1).mean())) if len(values) else float("nan")


def twin_table(twins: Sequence[HeldOutTwin], has_effects: bool) -> Table:
    """Error of every recording in every regime of motion, m/s."""
    rows = []
    for twin in twins:
        noise = float(np.sqrt((twin.noise**2).sum()))
        for regime, mask in {ALL: np.ones(len(twin.time), dtype=bool), **twin.regimes}.items():
            errors = [f"{rms(values[mask]):.4f}" for values in twin.errors(has_effects).values()]
            rows.append(
                (twin.name if regime == ALL else "", regime, f"{100.0 * mask.mean():.0f} %", *errors, f"{noise:.4f}")
            )
    heads = ("without, m/s", "with, m/s") if has_effects else ("recorded less twin, m/s",)
    return Table(
        ("recording", "regime", "share", *heads, "noise, m/s"),
        rows,
        notes=(
            "Rms of the vector, noise of DVL and reference included, where there is a reference: the error and the "
            "noise at the top are these, of all recordings. The twin moves as the reference says, and its parameters "
            "had not seen the samples that it is compared with.",
        ),
    )
