"""Recorded bags checked against each other: calibrate on each, correct every other one that has GNSS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..calibration.error_model import correction_matrix
from ..calibration.frames import Array
from ..calibration.models import Needs
from ..calibration.observe import Observer
from ..calibration.parameters import Parameters
from ..calibration.samples import AlignedBlock
from ..errors import InputError
from ..parallel import Workers, run_all
from ..replay.replay import Topics, replay
from .metrics import Moments, vrmse


@dataclass(frozen=True)
class CrossCheck:
    """Difference (vector RMSE, m/s) of the DVL to GNSS, whose noise is part of it, on bags that were not calibrated on.

    bags: (L,). models: (M,). n_paired: (L,) samples that had a reference. uncorrected: (L,) verified on. corrected:
    (L, M, L) calibrated on, model, verified on; nan on the bag itself, without paired samples, and where the model had
    nothing to calibrate with. notes: what the replays said.
    """

    bags: tuple[str, ...]
    models: tuple[str, ...]
    n_paired: tuple[int, ...]
    uncorrected: Array
    corrected: Array
    notes: tuple[str, ...]
    parameters: Mapping[str, Any]


@dataclass(frozen=True)
class _Replayed:
    """corrections: (M, 3, 3), nan where a model had no sample. moments: of the paired samples, None without."""

    corrections: Array
    moments: Moments | None
    n_paired: int
    notes: tuple[str, ...]


def cross_check(
    bags: Sequence[Path],
    parameters: Parameters,
    models: Sequence[str],
    topics: Topics,
    workers: Workers,
    on_progress: Callable[[float], None] = lambda _: None,
) -> CrossCheck:
    """Replay every bag, verify on all others. Raises InputError."""
    if len(set(bags)) < len(bags):
        raise InputError(f"{', '.join(map(str, bags))}: a bag is named twice; it cannot be checked against itself")
    found = run_all(partial(_replay_one, parameters, tuple(models), topics), bags, workers, on_progress)
    if not any(each.moments for each in found):
        raise InputError(f"{', '.join(map(str, bags))}: no sample has a reference to check against; set --gnss-topic")
    uncorrected = np.full(len(bags), np.nan)
    corrected = np.full((len(bags), len(models), len(bags)), np.nan)
    for verified, each in enumerate(found):
        if each.moments is None:
            continue
        uncorrected[verified] = vrmse(each.moments, parameters.rotation_dvl_from_body.T)
        for calibrated, other in enumerate(found):
            if calibrated != verified:
                corrected[calibrated, :, verified] = vrmse(each.moments, other.corrections)
    return CrossCheck(
        bags=tuple(map(str, bags)),
        models=tuple(models),
        n_paired=tuple(each.n_paired for each in found),
        uncorrected=uncorrected,
        corrected=corrected,
        notes=tuple(f"{bag}: {note}" for bag, each in zip(bags, found, strict=True) for note in each.notes),
        parameters=parameters.as_dict(),
    )


def _replay_one(parameters: Parameters, models: Sequence[str], topics: Topics, bag: Path) -> _Replayed:
    observer = Observer(parameters)
    measured: list[Array] = []
    reference: list[Array] = []

    def keep_paired(block: AlignedBlock) -> None:
        seen = observer.observe(block.part(block.paired), Needs.REFERENCE, np.zeros(2))
        assert seen.reference_body is not None
        measured.append(seen.velocity_at_reference)
        reference.append(seen.reference_body)

    def forget() -> None:
        measured.clear()
        reference.clear()

    replayed = replay([bag], parameters, topics, on_rows=keep_paired, on_restart=forget)
    corrections = np.full((len(models), 3, 3), np.nan)
    for index, name in enumerate(models):
        estimate = replayed.result.estimates[name]
        if estimate.used:
            rotation = parameters.rotation_dvl_from_body
            corrections[index] = correction_matrix(estimate.misalignment, estimate.scale, rotation)
    n_paired = sum(map(len, measured))
    moments = Moments.of(np.concatenate(measured), np.concatenate(reference)) if n_paired else None
    return _Replayed(corrections, moments, n_paired, replayed.notes)


def cross_check_document(check: CrossCheck) -> dict[str, Any]:
    """`evaluate --json` of bags; m/s."""
    by_bag = partial(zip, check.bags, strict=True)
    return {
        "uncorrected": dict(by_bag(check.uncorrected.tolist())),
        "corrected": {
            calibrated: {
                model: {bag: value for bag, value in by_bag(row.tolist()) if bag != calibrated}
                for model, row in zip(check.models, rows, strict=True)
            }
            for calibrated, rows in by_bag(check.corrected)
        },
        "paired": dict(by_bag(check.n_paired)),
        "notes": list(check.notes),
        "parameters": dict(check.parameters),
        "version": __version__,
    }
