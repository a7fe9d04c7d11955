"""What was done before, and how fast the misalignment is found: against truth that is known."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import nearest_rotation, rotation_of
from dvl_calib_ros.evaluation import protocol
from dvl_calib_ros.evaluation.protocol import own_trajectories
from dvl_calib_ros.evaluation.results import BASELINES
from dvl_calib_ros.evaluation.validation_study import (
    DEFAULTS,
    TIMES_S,
    curve_keys,
    curves,
    dvl_velocities,
    references,
    squared_errors,
)

MODELS = ("M3", "unaided")


@pytest.mark.parametrize("name", BASELINES)
def test_a_baseline_finds_a_rotation_exactly_where_nothing_else_is_wrong(name):
    rng = np.random.default_rng(2)
    rotations = np.stack([rotation_of(rng.normal(0.0, 0.5, 3)) for _ in range(4)])
    reference = rng.normal(size=(4, 50, 3))
    measured = np.einsum("bji,bnj->bni", rotations, reference)  # v = Cᵀ g
    found = BASELINES[name](np.arange(50.0), measured, reference)
    assert np.allclose(found, rotations, atol=1e-9)


def test_what_is_found_is_a_rotation_also_of_motion_in_a_plane_or_of_none():
    level = np.array([[1.0, 0.2, 0.0], [0.5, -1.0, 0.0], [1.0, 1.0, 0.0]])
    for vectors in (level, level[:1], np.zeros((3, 3))):
        found = nearest_rotation(vectors.T @ vectors)
        assert np.allclose(found @ found.T, np.eye(3), atol=1e-12) and np.linalg.det(found) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def found():
    run = own_trajectories()["T02"]
    with_noise = {std: references(run, 0, std) for std in (protocol.GNSS_STD, 0.02)}
    squares = squared_errors(run, dvl_velocities(run, 0), with_noise, MODELS, Parameters.from_mapping(DEFAULTS), [])
    return {(each.name, each.gnss_std): each for each in curves(MODELS, squares[None, None])}


def test_a_curve_is_there_for_each_reference_noise_and_for_none(found):
    assert set(found) == set(curve_keys(MODELS)) and (("unaided", None) in found)
    for each in found.values():
        assert each.rms.shape == (len(TIMES_S), 3) and (each.angle_deg >= each.level_deg).all()


def test_g1_is_better_with_time_with_a_better_receiver_and_than_the_baselines(found):
    coarse, fine = found["M3", protocol.GNSS_STD], found["M3", 0.02]
    assert coarse.level_deg[-1] < 0.5 * coarse.level_deg[0]
    assert (fine.level_deg < coarse.level_deg).all()
    for name in BASELINES:
        assert (coarse.angle_deg < found[name, protocol.GNSS_STD].angle_deg).all()


def test_without_a_reference_the_error_stays_below_that_of_the_prior(found):
    assert found["unaided", None].angle_deg.max() < np.degrees(np.linalg.norm(protocol.truth()[:, :3], axis=1)).max()
