"""What is turned to the axes of base_frame, forward-left-up or z down."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import ENU_FROM_NWU, FLU_FROM_FRD
from dvl_calib_ros.messages.decode import AS_SENT, DECLARED_FRAMES, HALF_TURN, QUARTER_TURN, turns_dvl
from dvl_calib_ros.messages.drivers import VELOCITY_TYPES

TWIST = VELOCITY_TYPES["geometry_msgs/msg/TwistWithCovarianceStamped"]
DOWN = next(kind for kind in VELOCITY_TYPES.values() if kind.points_down)


@pytest.mark.parametrize(
    ("axes", "matrix"), [(AS_SENT, np.eye(3)), (HALF_TURN, FLU_FROM_FRD), (QUARTER_TURN, ENU_FROM_NWU)]
)
def test_axes_turn_velocities_and_covariances_as_their_matrix(axes, matrix, rng):
    velocity, square = rng.normal(size=(5, 3)), rng.normal(size=(4, 3, 3))
    covariance = square @ square.swapaxes(1, 2)
    np.testing.assert_array_equal(axes.velocity(velocity), velocity @ matrix.T)
    np.testing.assert_allclose(axes.covariance(covariance), matrix @ covariance @ matrix.T, rtol=1e-12)


@pytest.mark.parametrize(
    ("kind", "frame_id", "given", "turned"),
    [
        (TWIST, "dvl_link", {}, False),
        (DOWN, "dvl_link", {}, True),
        (DOWN, "dvl_flu", {}, False),
        (TWIST, "dvl_link", {"base_axes": "frd"}, False),
        (DOWN, "dvl_link", {"base_axes": "frd"}, False),
        (TWIST, "dvl_flu", {"base_axes": "frd"}, True),
        (TWIST, "dvl_link", {"base_axes": "frd", "dvl_axes": "flu"}, True),
        (DOWN, "dvl_link", {"base_axes": "frd", "dvl_axes": "frd"}, False),
        (TWIST, "dvl_link", {"dvl_axes": "frd"}, True),
    ],
)
def test_a_dvl_is_turned_where_its_axes_are_not_those_of_the_body(kind, frame_id, given, turned):
    assert turns_dvl(kind, frame_id, Parameters(**given)) is turned


def test_a_reference_in_named_body_axes_is_turned_for_a_body_with_other_axes():
    for name, other in (("flu", "frd"), ("frd", "flu")):
        assert DECLARED_FRAMES[name].in_base(other).axes is HALF_TURN
        assert DECLARED_FRAMES[name].in_base(name) == DECLARED_FRAMES["body"]
