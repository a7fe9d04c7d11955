"""The batch path against filterpy's KalmanFilter doing the same updates."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from dvl_calib_ros.calibration import kalman
from dvl_calib_ros.calibration.bank import prior
from dvl_calib_ros.calibration.frames import Array
from dvl_calib_ros.calibration.models import MODELS
from dvl_calib_ros.calibration.observations import Observations
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.errors import InputError

from . import Measurement

N_SAMPLES = 20_000
TARGET = 100.0
ROUNDS = 7


def measure() -> list[Measurement]:
    """Whole history of M3 over N_SAMPLES. Raises InputError without filterpy."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError as error:
        raise InputError("the batch benchmark compares with filterpy: pip install 'dvl_calib_ros[test]'") from error
    rng = np.random.default_rng(0)
    reference = rng.normal([1.5, 0.1, 0.0], 0.3, (N_SAMPLES, 3))
    seen = Observations(reference + rng.normal(0, 0.2, (N_SAMPLES, 3)), reference, None, np.eye(3), np.zeros(2))
    model, noise = MODELS["M3"], 0.04 * np.eye(3)
    z, h = model.linearise(seen)
    start = prior(model, Parameters())

    def run_ours() -> Array:
        data = kalman.Measurements(
            z[None],
            h[None],
            noise[None, None],
            np.ones((1, N_SAMPLES)),
            np.ones((1, N_SAMPLES), bool),
            np.array([np.inf]),
        )
        return kalman.history(start.x[None], start.p[None], data).x[0]

    def run_peer() -> Array:
        peer = KalmanFilter(dim_x=model.n_state, dim_z=3)
        peer.x, peer.P, peer.R = start.x[:, None], start.p.copy(), noise
        states, covariances = np.empty((N_SAMPLES, model.n_state)), np.empty((N_SAMPLES, *start.p.shape))
        for i in range(N_SAMPLES):
            peer.update(z[i][:, None], H=h[i])
            states[i], covariances[i] = peer.x[:, 0], peer.P
        return states

    # in turns, the best of each: what else the machine does only ever adds
    times = [(_cpu_seconds(run_ours), _cpu_seconds(run_peer)) for _ in range(ROUNDS)]
    ours, peer = min(ours for ours, _ in times), min(peer for _, peer in times)
    difference = float(np.abs(run_ours() - run_peer()).max())
    return [
        Measurement(
            f"batch path, history of {N_SAMPLES} updates, CPU (largest difference {difference:.0e})",
            f"{1e6 * ours / N_SAMPLES:.2f} µs/update",
            f"{1e6 * peer / N_SAMPLES:.1f} µs/update (filterpy)",
            f"{peer / ours:.0f} x faster",
            f">= {TARGET:.0f} x",
            peer / ours >= TARGET,
        )
    ]


def _cpu_seconds(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started
