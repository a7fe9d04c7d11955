"""How effects on the mounting compose with the misalignment: D = (I + diag(δk)) Exp(φ + turns) T, both ways."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvl_calib_ros.calibration.numerics.frames import Array
from dvl_calib_ros.diagnosis.model.forward_model import make_problem
from dvl_calib_ros.diagnosis.model.hypothesis import Hypothesis
from dvl_calib_ros.diagnosis.model.recorded_streams import make_recording
from dvl_calib_ros.diagnosis.model.time_grid import Offsets
from dvl_calib_ros.effects.base import Injection
from dvl_calib_ros.effects.registry import EFFECTS
from dvl_calib_ros.simulation.scenario import Run, Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

PHI = np.deg2rad([1.0, -1.5, 0.5])
MOVED = np.deg2rad([-2.0, 1.0, 3.0])
SCALE = (0.01, -0.005, 0.02)
MOUNTING_RPY = (0.02, -0.01, 0.8)


def rpy_of(phi: Array) -> tuple[float, float, float]:
    """Roll, pitch, yaw of a DVL whose misalignment is the rotation vector φ."""
    roll, pitch, yaw = Rotation.from_rotvec(phi).inv().as_euler("xyz").tolist()
    return roll, pitch, yaw


def run(phi: Array, effects: tuple[Injection, ...] = ()) -> Run:
    errors = DvlErrors(rpy_of(phi), SCALE)
    return simulate(
        Scenario("free", 60.0, errors=errors, mounting_rpy=MOUNTING_RPY, gnss_std=0.0, effects=effects, gnss_rate=10.0)
    )


def injected(name: str, size: Array) -> Injection:
    effect = EFFECTS[name]
    return Injection(effect, dict(zip([spec.name for spec in effect.parameters], size.tolist(), strict=True)))


def test_a_mounting_that_moved_is_that_of_the_angles_added_to_the_last_digit():
    moved, turned = run(PHI, (injected("mounting_moved", MOVED),)), run(PHI + MOVED)
    velocities = [np.array([sample.velocity for sample in each.dvl]) for each in (moved, turned)]
    np.testing.assert_allclose(velocities[0], velocities[1], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "size"), [("mounting_moved", MOVED), ("misalignment_drift", 30.0 * MOVED), ("mount_flexure", MOVED)]
)
def test_the_model_undoes_a_turned_mounting_beside_a_misalignment_and_its_columns_are_derivatives(name, size):
    one = injected(name, size)
    given = run(PHI, (one,))
    first_ns = given.dvl[0].stamp_ns

    def stream(samples, field):
        return (
            np.array([1e-9 * (sample.stamp_ns - first_ns) for sample in samples]),
            np.array([getattr(sample, field) for sample in samples]),
        )

    recording = make_recording(
        "run", stream(given.dvl, "velocity"), stream(given.gnss, "velocity"), attitude=stream(given.imu, "orientation")
    )
    nominal = Rotation.from_euler("xyz", MOUNTING_RPY).as_matrix().T
    problem = make_problem([recording], nominal, np.zeros(3), [Offsets()])
    true = Hypothesis(PHI, np.array(SCALE), (one.effect,), {name: (one.values,)})
    seen = problem.all_seen(true)
    left = problem.residual(seen)[8:-8]
    assert np.sqrt(np.mean(left**2)) < 3e-4  # what 5 Hz samples leave of a corner; the cross term is 1 to 3 mm/s

    columns = np.concatenate(
        [problem.calibration_columns(true, seen), problem.columns(true, seen, one.effect, [one.values])], axis=2
    )
    steps = 1e-5 * np.eye(columns.shape[2])
    for index in (0, 1, 2, 6, 7, 8):
        step = steps[index]
        ends = [problem.residual(problem.all_seen(true.moved(sign * step))) for sign in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / (2.0 * step.sum())
        error = np.abs(slope - columns[:, :, index])[8:-8].max() / np.abs(slope).max()
        assert error < 0.02, (index, error)
