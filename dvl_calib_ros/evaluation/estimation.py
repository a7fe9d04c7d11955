"""Many calibrations of one run at once: the same models, priors and filter as live and in replay.

What differs is the layout. Runs here are complete and synchronous, so nothing waits for a partner, and B variants of a
run (combinations of errors) go through the models and the filter as one array. That this gives the state that replaying
a bag of the same data gives is proved in test_evaluation.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..calibration import kalman
from ..calibration.bank import Assembler
from ..calibration.frames import Array
from ..calibration.kalman import GaussianState
from ..calibration.models import MODELS, Model, Needs
from ..calibration.observations import Assumptions, Observations
from ..calibration.parameters import Parameters
from .trajectories import Trajectory

Mask = NDArray[np.bool_]
T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class SensorData:
    """What the sensors gave on a run, in B variants. Body frame, forward-left-up; the DVL is mounted straight.

    run: its truth, times and attitude. velocity_dvl: (B, N, 3) m/s. reference: (B, N, 3) m/s.
    """

    run: Trajectory
    velocity_dvl: Array
    reference: Array


def estimate(
    models: Sequence[str], data: SensorData, parameters: Parameters, ends: Sequence[int]
) -> Mapping[str, GaussianState]:
    """States of every model that can run on the data, after the first `ends` samples (E ascending numbers).

    Returns x (E, B, n) and P (E, B, n, n) by the model's name. parameters: without process noise, lever arm or
    mounting.
    """
    usable = usable_samples(data, parameters)
    sway_heave, prior_known = prior_sway_heave(data, usable, parameters)
    found: dict[str, GaussianState] = {}
    for needs in Needs:
        group = [MODELS[name] for name in models if MODELS[name].needs is needs]
        if not group or (needs is Needs.ATTITUDE and data.run.rotation_enu_from_body is None):
            continue
        seen = observations(data, needs, sway_heave, parameters)
        for model in group:  # each on its own, in its own size: here it is the variants that fill the arrays
            found[model.name] = _estimate_one(model, seen, usable, prior_known, parameters, ends)
    return {name: found[name] for name in models if name in found}


def _estimate_one(
    model: Model, seen: Observations, usable: Mask, prior_known: Mask, parameters: Parameters, ends: Sequence[int]
) -> GaussianState:
    assembler = Assembler([model], parameters)
    flat = assembler.measurements(seen, np.ones(usable.size), prior_known.ravel())
    x, p = (np.repeat(each, len(usable), axis=0) for each in assembler.start)
    after = _states_after(x, p, _by_variant(flat, usable), ends)
    return assembler.state(0, after.x, after.p)


def observations(data: SensorData, needs: Needs, sway_heave: Array, parameters: Parameters) -> Observations:
    """All variants in a row (B N samples)."""
    run, (n_variants, n_samples, _) = data.run, data.velocity_dvl.shape
    attitude = needs is Needs.ATTITUDE
    aided = needs is Needs.REFERENCE
    std = parameters.gnss_aided_std if aided else parameters.gnss_free_std

    def repeated(values: Array | None) -> Array | None:
        return None if values is None else np.tile(values, (n_variants,) + (1,) * (values.ndim - 1))

    return Observations(
        velocity_dvl=data.velocity_dvl.reshape(-1, 3),
        reference_body=data.reference.reshape(-1, 3) if aided else None,
        lever_velocity=None,
        rotation_dvl_from_body=np.eye(3),
        sway_heave=np.repeat(sway_heave, n_samples, axis=0),
        noise=std**2 * np.eye(3)[None],
        rotation_enu_from_body=repeated(run.rotation_enu_from_body) if attitude else None,
        angular_velocity=repeated(run.angular_velocity) if attitude else None,
        interval=repeated(np.diff(run.time, prepend=run.time[0])),
        assumptions=Assumptions(*(getattr(parameters, name) for name in Assumptions._fields)),
    )


def usable_samples(data: SensorData, parameters: Parameters) -> Mask:
    """Samples (B, N) that are neither too slow nor in too sharp a turn, as the calibrator has it."""
    usable: Mask = np.sum(data.velocity_dvl**2, axis=-1) >= parameters.min_speed**2
    if parameters.max_turn_rate > 0.0:
        rates = data.run.angular_velocity
        calm = np.zeros(usable.shape[1], bool) if rates is None else _squared(rates) <= parameters.max_turn_rate**2
        usable = usable & calm
    return usable


def _squared(vectors: Array) -> Array:
    return np.asarray(np.sum(vectors**2, axis=-1))


def prior_sway_heave(data: SensorData, usable: Mask, parameters: Parameters) -> tuple[Array, Mask]:
    """Prior sway and heave (B, 2) m/s, and at which samples (B, N) it is known."""
    n_variants = len(usable)
    known: Mask = np.ones(usable.shape, dtype=bool)
    time = data.run.time
    if parameters.prior_source == "fixed":
        return np.tile(parameters.prior_sway_heave, (n_variants, 1)), known
    if parameters.prior_source == "reference":
        window = data.run.velocity[: data.run.first(parameters.prior_window)]
        return np.tile(window[:, 1:].mean(axis=0), (n_variants, 1)), known
    started = time[np.argmax(usable, axis=1)]
    known = time[None] - started[:, None] >= parameters.prior_window
    in_window = (usable & ~known)[..., None]
    mean = np.sum(data.velocity_dvl[..., 1:] * in_window, axis=1) / np.maximum(in_window.sum(axis=1), 1)
    return mean, known


def _by_variant(flat: kalman.Measurements, usable: Mask) -> kalman.Measurements:
    """Measurements of one model, B variants in a row (1, B N, ...) -> of B models (B, N, ...)."""

    def split(values: NDArray[T]) -> NDArray[T]:
        same_for_all = values.shape[1] == 1
        return values if same_for_all else values.reshape(*usable.shape, *values.shape[2:])

    return kalman.Measurements(
        z=split(flat.z),
        h=split(flat.h),
        r=split(flat.r),
        weight=split(flat.weight),
        usable=split(flat.usable) & usable,
        gate=np.repeat(flat.gate, len(usable)),
    )


def _states_after(x: Array, p: Array, data: kalman.Measurements, ends: Sequence[int]) -> GaussianState:
    """x (E, K, n) and P (E, K, n, n) after the first `ends` samples."""
    if not np.isfinite(data.gate).any():
        return kalman.least_squares(x, p, data, ends)
    states = []
    for start, end in pairwise((0, *ends)):
        if end > start:
            after = kalman.batch(x, p, data.part(slice(start, end)))
            x, p = after.x, after.p
        states.append((x, p))
    return GaussianState(*map(np.array, zip(*states, strict=True)))
