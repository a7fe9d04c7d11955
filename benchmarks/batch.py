"""The batch path against filterpy's KalmanFilter doing the same updates."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from dvl_calib_ros.calibration import kalman
from dvl_calib_ros.calibration.bank import Assembler, ModelBank
from dvl_calib_ros.calibration.frames import Array
from dvl_calib_ros.calibration.models import MODELS, Needs
from dvl_calib_ros.calibration.observations import Observations
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.errors import InputError

from . import Measurement

N_SAMPLES = 20_480
BLOCK = 512  # as replay
TARGET = 100.0
ROUNDS = 5


def measure() -> list[Measurement]:
    """All models with GNSS over N_SAMPLES in blocks, gated, as replay runs them. Raises InputError without filterpy."""
    try:
        from filterpy.kalman import KalmanFilter
    except ImportError as error:
        raise InputError("the batch benchmark compares with filterpy: pip install 'dvl_calib_ros[test]'") from error
    rng = np.random.default_rng(0)
    reference = rng.normal([1.5, 0.1, 0.0], 0.3, (N_SAMPLES, 3))
    measured = reference + rng.normal(0, 0.02, reference.shape)
    reference = reference + rng.normal(0, 0.2, reference.shape)
    models = [model for model in MODELS.values() if model.needs is Needs.REFERENCE]
    parameters = Parameters()
    noise = 0.04 * np.eye(3)[None]
    stamps_ns = np.arange(N_SAMPLES) * 200_000_000
    ones, known = np.ones(BLOCK), np.ones(BLOCK, dtype=bool)

    def seen(at: slice) -> Observations:
        interval = np.full(len(measured[at]), 0.2)
        return Observations(measured[at], reference[at], None, np.eye(3), np.zeros(2), noise, interval=interval)

    def run_ours() -> ModelBank:
        bank = ModelBank(models, parameters)
        for start in range(0, N_SAMPLES, BLOCK):
            at = slice(start, start + BLOCK)
            bank.update(Needs.REFERENCE, stamps_ns[at], seen(at), ones, known)
        return bank

    # z, H, R and what the gate lets through come for nothing
    assembler = Assembler(models, parameters)
    given = assembler.measurements(seen(slice(None)), np.ones(N_SAMPLES), np.ones(N_SAMPLES, dtype=bool))
    used = kalman.recursion(*assembler.start, given).used
    r = np.broadcast_to(given.r, (len(models), N_SAMPLES, 3, 3))

    def run_peer() -> list[Array]:
        states = []
        for k, model in enumerate(models):
            n = model.n_state
            peer = KalmanFilter(dim_x=n, dim_z=3)
            peer.x, peer.P = assembler.start.x[k, :n, None].copy(), assembler.start.p[k, :n, :n].copy()
            for i in np.flatnonzero(used[k]).tolist():
                peer.update(given.z[k, i, :, None], R=r[k, i], H=given.h[k, i, :, :n])
            states.append(peer.x[:, 0])
        return states

    # the best of several: what else the machine does only ever adds; the peer takes long enough to even it out
    ours, peer = min(_cpu_seconds(run_ours) for _ in range(ROUNDS)), _cpu_seconds(run_peer)
    after, states = run_ours().standing(Needs.REFERENCE, 1), run_peer()
    difference = max(float(np.abs(after.x[0, k, : len(state)] - state).max()) for k, state in enumerate(states))
    updates = N_SAMPLES * len(models)
    return [
        Measurement(
            f"bank of {len(models)} models, blocks of {BLOCK}, gated, CPU (largest difference {difference:.0e})",
            f"{1e6 * ours / updates:.2f} µs/update",
            f"{1e6 * peer / updates:.1f} µs/update (filterpy)",
            f"{peer / ours:.0f} x faster",
            f">= {TARGET:.0f} x",
            peer / ours >= TARGET,
        )
    ]


def _cpu_seconds(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started
