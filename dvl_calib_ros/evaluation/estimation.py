"""Vectorised calibration of many variants of one run, with the models, priors and filter of live use and replay.

B variants of a run (combinations of errors) are aligned and gated like recordings, then processed as one array.
test_evaluation.py verifies that the states equal those of replayed bags.

Shapes: B variants of a run, N samples, E calibration times, n states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..calibration.calibrator import Calibrator
from ..calibration.filters.build_observations import ROWS_WITH, Observer
from ..calibration.filters.filter_bank import RelativeHeight
from ..calibration.filters.filter_setup import Assembler
from ..calibration.models import MODELS, Model, Needs
from ..calibration.models.base import Observations
from ..calibration.models.parameters import Parameters
from ..calibration.numerics import kalman
from ..calibration.numerics.frames import Array
from ..calibration.numerics.kalman import GaussianState
from ..calibration.numerics.samples import AlignedBlock, Mask, Stream, Streams, no_samples, sample_block
from ..calibration.streams.aligner import align
from .protocol import Trajectory
from .results import Failure

T = TypeVar("T", bound=np.generic)
# stamp of a run's time 0, s since 1970
_START_S = 1_600_000_000


@dataclass(frozen=True)
class SensorData:
    """Sensor data of a run in B variants. Body frame, forward-left-up; the DVL is mounted without rotation.

    run: true motion, times and attitude.
    velocity_dvl: (B, N, 3) m/s.
    reference: (B, N, 3) m/s.
    """

    run: Trajectory
    velocity_dvl: Array
    reference: Array

    def part(self, start: int, end: int) -> SensorData:
        """Return the samples start .. end - 1."""
        return SensorData(self.run.part(start, end), self.velocity_dvl[:, start:end], self.reference[:, start:end])


@dataclass(frozen=True)
class AlignedVariants:
    """B variants of a run of N samples after the calibrator's alignment and gates.

    rows: of all variants in sequence (B N). A rejected sample, for example above max_speed, is a row that no model
      uses.
    has: for each need the rows (B, N) that satisfy it.
    sway_heave: (B, 2) m/s, the priors.
    """

    rows: AlignedBlock
    has: Mapping[Needs, Mask]
    sway_heave: Array

    def observations(self, needs: Needs, parameters: Parameters) -> Observations:
        """Return the observations of models with these needs for all rows; any finite values for unusable rows."""
        n_samples = self.has[needs].shape[1]
        rows = self.rows
        if needs is Needs.REFERENCE:
            rows = replace(rows, attitude=np.nan_to_num(rows.attitude))
        return Observer(parameters).observe(rows, needs, np.repeat(self.sway_heave, n_samples, axis=0))


def streams_of(data: SensorData, variant: int) -> Streams:
    """Return one variant as the streams of a recording."""
    run = data.run
    stamps_ns = np.rint((_START_S + run.time) * 1e9).astype(np.int64)
    imu = no_samples(Stream.IMU)
    if run.rotation_enu_from_body is not None and run.angular_velocity is not None:
        imu = sample_block(Stream.IMU, stamps_ns, np.concatenate([run.quaternions, run.angular_velocity], axis=1))
    return Streams(
        sample_block(Stream.DVL, stamps_ns, data.velocity_dvl[variant]),
        sample_block(Stream.REFERENCE, stamps_ns, data.reference[variant]),
        imu,
    ).arriving_by_stamp()


def true_prior(data: SensorData, parameters: Parameters) -> tuple[float, float] | None:
    """Return sway and heave of ``prior_source: reference``: here the true ones, over the prior's window."""
    if parameters.prior_source != "reference":
        return None
    _, sway, heave = data.run.velocity[: data.run.first(parameters.prior_window)].mean(axis=0).tolist()
    return sway, heave


def aligned(data: SensorData, parameters: Parameters) -> AlignedVariants:
    """Align all variants of a run by a calibration's rules."""
    prior, n_samples = true_prior(data, parameters), len(data.run.time)
    found = [align(streams_of(data, variant), parameters, prior) for variant in range(len(data.velocity_dvl))]
    # a row for every sample, including rejected ones
    at = np.zeros((len(found), n_samples), dtype=np.intp)
    present = np.zeros(at.shape, dtype=bool)
    first = 0
    for index, (block, _) in enumerate(found):
        at[index, block.row] = first + np.arange(len(block))
        present[index, block.row] = True
        first += len(block)
    columns = (np.concatenate(column) for column in zip(*(block.columns() for block, _ in found), strict=True))
    rows = AlignedBlock(*columns).part(at.ravel())
    has = {needs: present & rows_with(rows).reshape(at.shape) for needs, rows_with in ROWS_WITH.items()}
    # missing velocities are 0; covariances are unchanged
    reference = np.concatenate([np.nan_to_num(rows.reference[:, :3]), rows.reference[:, 3:]], axis=1)
    rows = replace(rows, reference=reference)
    return AlignedVariants(rows, has, np.array([sway_heave for _, sway_heave in found]))


def estimate(
    models: Sequence[str], data: SensorData, parameters: Parameters, ends: Sequence[int], failures: list[Failure]
) -> Mapping[str, GaussianState]:
    """Return the states of every usable model after the first `ends` samples (E ascending numbers).

    Returns x (E, B, n) and P (E, B, n, n) by the model's name. parameters: without process noise, lever arm or
    mounting. A variant whose estimation raises is nan in that model only, and is added to `failures`.
    """
    has_attitude = data.run.rotation_enu_from_body is not None
    able = [name for name in models if has_attitude or MODELS[name].needs is not Needs.ATTITUDE]
    try:
        return _estimate_all(able, data, parameters, ends)
    except Exception:  # repeat individually, so that an exception affects only its own variant
        return {name: _estimate_by_variant(name, data, parameters, ends, failures) for name in able}


def _estimate_by_variant(
    name: str, data: SensorData, parameters: Parameters, ends: Sequence[int], failures: list[Failure]
) -> GaussianState:
    """Run `estimate` for one model, with each variant separately."""
    n_state, n_variants = MODELS[name].n_state, len(data.velocity_dvl)
    x = np.full((len(ends), n_variants, n_state), np.nan)
    p = np.full((len(ends), n_variants, n_state, n_state), np.nan)
    for index in range(n_variants):
        one_variant = slice(index, index + 1)
        one = replace(data, velocity_dvl=data.velocity_dvl[one_variant], reference=data.reference[one_variant])
        try:
            state = _estimate_all([name], one, parameters, ends)[name]
        except Exception as error:
            failures.append(Failure.of(error, name, data.run.name, index))
            continue
        x[:, index], p[:, index] = state.x[:, 0], state.p[:, 0]
    return GaussianState(x, p)


def _estimate_all(
    models: Sequence[str], data: SensorData, parameters: Parameters, ends: Sequence[int]
) -> Mapping[str, GaussianState]:
    """Run `estimate` for models that are usable with these data."""
    variants = aligned(data, parameters)
    found = {name: _estimate_fed(name, data, parameters, ends) for name in models if MODELS[name].estimator}
    for needs in Needs:
        group = [MODELS[name] for name in models if MODELS[name].needs is needs and name not in found]
        if not group:
            continue
        seen = variants.observations(needs, parameters)
        for model in group:  # models run separately, because the variants already fill the arrays
            found[model.name] = _estimate_one(model, seen, variants, parameters, ends)
    return {name: found[name] for name in models}


def _estimate_one(
    model: Model, seen: Observations, variants: AlignedVariants, parameters: Parameters, ends: Sequence[int]
) -> GaussianState:
    """Return a model's estimates for all variants at the ends of their data."""
    assembler = Assembler([model], parameters)
    if model.uses_height:
        seen = replace(seen, height=_heights(seen, variants, variants.has[model.needs]))
    flat = assembler.measurements(seen, variants.rows.share(model.aided), variants.rows.prior_known)
    usable = variants.has[model.needs]
    x, p = (np.repeat(each, len(usable), axis=0) for each in assembler.start)
    after = _states_after(x, p, _by_variant(flat, usable), ends)
    return assembler.state(0, after.x, after.p)


def _estimate_fed(name: str, data: SensorData, parameters: Parameters, ends: Sequence[int]) -> GaussianState:
    """Return x (E, B, n), P (E, B, n, n) of an estimator, fed each variant, after its first `ends` samples."""
    prior = true_prior(data, parameters)
    x, p = [], []
    for variant in range(len(data.velocity_dvl)):
        calibrator = Calibrator(parameters, prior_sway_heave=prior, block_size=max(ends), models=(name,))
        found = []
        for start, end in pairwise((0, *ends)):
            if end > start:
                calibrator.feed(streams_of(data.part(start, end), variant))
            found.append(calibrator.result().estimates[name])
        x.append([each.state for each in found])
        p.append([each.recording_covariance for each in found])
    return GaussianState(np.array(x).swapaxes(0, 1), np.array(p).swapaxes(0, 1))


def _heights(seen: Observations, variants: AlignedVariants, given: Mask) -> Array:
    """Return `Observations.height` of all rows (B N,), from those that models receive (B, N)."""
    heights = np.zeros(given.shape)
    columns = (each.reshape(given.shape) for each in (variants.rows.stamps_ns, seen.rising))
    for height, at, stamps_ns, rising in zip(heights, given, *columns, strict=True):
        height[at] = RelativeHeight().add(stamps_ns[at], rising[at])
    return heights.ravel()


def _by_variant(flat: kalman.Measurements, usable: Mask) -> kalman.Measurements:
    """Reshape one model's measurements of B variants from (1, B N, ...) to (B, N, ...)."""

    def split(values: NDArray[T]) -> NDArray[T]:
        same_for_all = values.shape[1] == 1
        return values if same_for_all else values.reshape(*usable.shape, *values.shape[2:])

    by_variant = {field.name: split(getattr(flat, field.name)) for field in fields(flat)}
    return kalman.Measurements(**by_variant | {"usable": by_variant["usable"] & usable})


def _states_after(x: Array, p: Array, data: kalman.Measurements, ends: Sequence[int]) -> GaussianState:
    """Return x (E, K, n) and P (E, K, n, n) after the first `ends` samples."""
    if not np.isfinite(data.gate).any():
        return kalman.least_squares(x, p, data, ends)
    states = []
    for start, end in pairwise((0, *ends)):
        if end > start:
            after = kalman.batch(x, p, data.part(slice(start, end)))
            x, p = after.x, after.p
        states.append((x, p))
    return GaussianState(*map(np.array, zip(*states, strict=True)))
