"""The published procedure against the same loop written with filterpy's KalmanFilter, one update at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dvl_calib_ros.calibration.filters.filter_bank import RelativeHeight
from dvl_calib_ros.calibration.filters.filter_setup import Assembler
from dvl_calib_ros.calibration.models import LINEAR_MODELS, MODELS, Model, Needs
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.evaluation import protocol
from dvl_calib_ros.evaluation.estimation import SensorData, aligned
from dvl_calib_ros.evaluation.protocol import load_folder, own_trajectories
from dvl_calib_ros.evaluation.validation_study import DEFAULTS, Procedure, corrections, run_seed, sensor_data

from . import DifferentWorkError, Measurement, check_same

TARGET_SECONDS = 2.0
TARGET_RATIO = 50.0
ROUNDS = 5


def measure() -> list[Measurement]:
    """The procedure with one seed, without studies, of all linear models. Raises InputError."""
    try:
        import filterpy.kalman  # noqa: F401
    except ImportError as error:
        raise InputError("the evaluate benchmark compares with filterpy: pip install 'dvl_calib_ros[test]'") from error
    folder = os.environ.get("DVL_CALIB_SNAPIR")
    runs = load_folder(Path(folder))[0] if folder else own_trajectories()
    models = tuple(model.name for model in LINEAR_MODELS)
    procedure = Procedure(runs, models, protocol.SETS, Parameters(**DEFAULTS), studies=False)
    # best of several: what else the machine does only ever adds; the peer takes long enough to even it out
    times = []
    for _ in range(ROUNDS):
        started = time.process_time()
        outcome = run_seed(procedure, 0)
        times.append(time.process_time() - started)
    started = time.process_time()
    peers = _with_filterpy(procedure, 0)
    ours, peer = min(times), time.process_time() - started
    scores = np.array([each.by_time for each in outcome.by_set])
    difference = float(np.nanmax(np.abs(scores - peers)))
    if not np.array_equal(np.isnan(scores), np.isnan(peers)):
        raise DifferentWorkError("the procedure and its loop with filterpy: not the same models can run")
    check_same(difference, "the procedure and its loop with filterpy")
    source = "the trajectories of DVL_CALIB_SNAPIR" if folder else "own trajectories"
    return [
        Measurement(
            f"evaluate, {source}, {len(models)} models, 4 sets, 8 windows, 15 combinations, CPU",
            f"{ours:.3f} s",
            f"{peer:.1f} s (filterpy; largest difference {difference:.0e} m/s)",
            f"{peer / ours:.0f} x faster",
            f">= {TARGET_RATIO:.0f} x, <= {TARGET_SECONDS:g} s",
            peer / ours >= TARGET_RATIO and ours <= TARGET_SECONDS,
            peer / ours,
            True,
        )
    ]


def _with_filterpy(procedure: Procedure, seed: int) -> Array:
    """Avg.VRMSE (S, W, C) of the sets after every window."""
    data = {name: sensor_data(run, seed) for name, run in procedure.runs.items()}
    n_combinations, n_windows = len(protocol.COMBINATIONS), len(protocol.WINDOWS_S)
    scores = np.full((len(procedure.sets), n_windows, procedure.n_columns), np.nan)
    for row, each in enumerate(procedure.sets):
        run = data[each.calibration_run]
        others = [other for name, other in data.items() if name != each.calibration_run]
        ends = [run.run.first(window) for window in protocol.WINDOWS_S]
        scores[row, :, 0] = np.mean([_vrmse(o, index, np.eye(3)) for o in others for index in range(n_combinations)])
        for column, name in enumerate(procedure.models, start=1):
            model = MODELS[name]
            if model.needs is Needs.ATTITUDE and run.run.rotation_enu_from_body is None:
                continue
            found = np.empty((n_combinations, n_windows, len(others)))
            for index in range(n_combinations):
                for window, matrix in enumerate(_calibrate(model, _variant(run, index), procedure.parameters, ends)):
                    found[index, window] = [_vrmse(other, index, matrix) for other in others]
            scores[row, :, column] = found.mean(axis=(0, 2))
    return scores


def _variant(data: SensorData, index: int) -> SensorData:
    at = slice(index, index + 1)
    return SensorData(data.run, data.velocity_dvl[at], data.reference[at])


def _calibrate(model: Model, data: SensorData, parameters: Parameters, ends: Sequence[int]) -> Iterator[Array]:
    """Correction matrices (3, 3) after the first `ends` samples.

    Predict and update for every sample, as users of filterpy write it; z, H and R come for nothing from the models.
    """
    from filterpy.kalman import KalmanFilter

    n, m = model.n_state, model.n_measurement
    assembler = Assembler([model], parameters)
    variants = aligned(data, parameters)
    usable = variants.has[model.needs]
    seen = variants.observations(model.needs, parameters)
    if model.uses_height:
        height = np.zeros(usable.size)
        height[usable[0]] = RelativeHeight().add(variants.rows.stamps_ns[usable[0]], seen.rising[usable[0]])
        seen = replace(seen, height=height)
    given = assembler.measurements(seen, variants.rows.share(model.aided), variants.rows.prior_known)
    used = given.usable[0] & usable[0]
    r = given.r[0] / given.weight[0][:, None, None]  # of the model's own rows
    peer = KalmanFilter(dim_x=n, dim_z=m)
    peer.F, peer.Q = np.eye(n), np.zeros((n, n))
    peer.x, peer.P = assembler.start.x[0, :, None].copy(), assembler.start.p[0].copy()
    for start, end in pairwise((0, *ends)):
        for i in range(start, end):
            peer.predict()
            if used[i]:
                peer.update(given.z[0, i, :m, None], R=r[i], H=given.h[0, i, :m])
        yield corrections(model, assembler.state(0, peer.x[:, 0], peer.P))


def _vrmse(data: SensorData, index: int, matrix: Array) -> float:
    error = data.run.velocity - data.velocity_dvl[index] @ matrix.T
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
