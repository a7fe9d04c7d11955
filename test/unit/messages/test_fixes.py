"""Velocity of satellite positions: against positions that are computed from a velocity, and receivers as they are."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import ReferenceSample, VelocityFrame
from dvl_calib_ros.messages.decode import MessageDecoder, Refusal
from dvl_calib_ros.messages.positions import FixDifference

A, B = 6_378_137.0, 6_356_752.314245  # WGS 84
START = 1_760_000_000_000_000_000


def geocentric(latitude_deg: float, longitude_deg: float, height: float) -> np.ndarray:
    """Earth-centred position of a geodetic one, m: by the ellipse itself, not by radii of curvature."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    root = math.hypot(A * math.cos(latitude), B * math.sin(latitude))
    across = (A**2 / root + height) * math.cos(latitude)
    return np.array(
        [across * math.cos(longitude), across * math.sin(longitude), (B**2 / root + height) * math.sin(latitude)]
    )


def moved(latitude_deg: float, longitude_deg: float, height: float, enu: tuple[float, float, float]) -> tuple:
    """The geodetic position so many metres east, north and up of another."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    north = np.cross(up, east)
    target = geocentric(latitude_deg, longitude_deg, height) + enu[0] * east + enu[1] * north + enu[2] * up
    position = np.array([latitude_deg, longitude_deg, height])
    for _ in range(5):  # Newton on the geocentric position
        step = 1e-6
        here = geocentric(*position)
        jacobian = np.column_stack([(geocentric(*(position + step * row)) - here) / step for row in np.eye(3)])
        position = position + np.linalg.solve(jacobian, target - here)
    return tuple(position)


@pytest.mark.parametrize("place", [(43.1, 10.9), (0.0, 0.0), (-77.8, 166.7), (12.0, 179.99999)])
@pytest.mark.parametrize("velocity", [(1.5, 0.0, 0.0), (0.0, -2.0, 0.0), (0.7, 0.9, -0.3)])
def test_a_steady_velocity_comes_out_anywhere_on_earth(place, velocity):
    difference = FixDifference()
    found = []
    for i in range(11):
        metres = tuple(0.2 * i * each for each in velocity)
        fixed = difference(START + i * 200_000_000, *moved(*place, 3.0, metres), None)
        found += [fixed] if fixed else []
    assert len(found) == 6  # the first when a second has passed
    assert found[0].stamp_ns == START + 500_000_000
    for each in found:
        np.testing.assert_allclose(each.velocity, velocity, atol=5e-6)


def test_its_noise_is_that_of_both_positions_over_the_window():
    difference = FixDifference(2.0)
    covariance = np.diag([0.01, 0.02, 0.09])
    assert difference(START, 43.0, 10.0, 0.0, covariance) is None
    fixed = difference(START + 2_000_000_000, 43.0, 10.0, 0.0, covariance)
    np.testing.assert_allclose(np.diag(fixed.covariance), [0.005, 0.01, 0.045])


def test_in_a_turn_the_velocity_is_that_of_the_middle_of_the_window():
    speed, rate = 1.5, math.radians(12.0)
    path = solve_ivp(lambda t, _: [speed * math.cos(rate * t), speed * math.sin(rate * t)], (0, 4), [0, 0], rtol=1e-10,
                     t_eval=np.arange(0, 4, 0.2))  # fmt: skip
    difference = FixDifference()
    for t, (east, north) in zip(path.t, path.y.T, strict=True):
        fixed = difference(START + round(t * 1e9), *moved(43.0, 10.0, 0.0, (east, north, 0.0)), None)
        if fixed:
            at = 1e-9 * (fixed.stamp_ns - START)
            truth = speed * np.array([math.cos(rate * at), math.sin(rate * at), 0.0])
            np.testing.assert_allclose(fixed.velocity, truth, atol=0.003 * speed)


def test_nothing_is_differenced_across_an_outage_or_a_clock_that_went_back():
    difference = FixDifference()
    for at in (0.0, 0.5, 10.0, 10.5, 3.0, 3.5):
        assert difference(START + round(at * 1e9), 43.0 + at, 10.0, 0.0, None) is None
    assert difference(START + 4_000_000_000, 46.5, 10.0, 0.0, None).velocity[1] == pytest.approx(55_600.0, rel=0.01)


def fix(stamp_ns: int, latitude: float = 43.0, status: int = 0) -> SimpleNamespace:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="gps"), status=SimpleNamespace(status=status), latitude=latitude,
        longitude=10.0, altitude=0.0, position_covariance=np.zeros(9), position_covariance_type=0,
    )  # fmt: skip


def test_positions_are_a_reference_in_east_north_up_whatever_their_frame_is_called():
    decoder = MessageDecoder(Parameters(gnss_type="sensor_msgs/msg/NavSatFix"))
    assert decoder.reference(fix(START), 0) == Refusal("first_fix")
    assert decoder.reference(fix(START + 500_000_000, status=-1), 0) == Refusal("no_fix")
    sample = decoder.reference(fix(START + 1_000_000_000, 43.00001), 0)
    assert isinstance(sample, ReferenceSample) and sample.frame is VelocityFrame.ENU
    assert sample.velocity[1] == pytest.approx(1.111, abs=0.001) and sample.covariance is None


@pytest.mark.parametrize(("frame", "north_mps"), [("map", 0.0), ("map_nwu", 1.0)])
def test_poses_in_a_north_west_up_map_are_turned_to_east_north_up(frame, north_mps):
    decoder = MessageDecoder(Parameters(gnss_type="geometry_msgs/msg/PoseStamped"))
    fixes = []
    decoder.on_fix = lambda *fix: fixes.append(fix)
    for second in range(2):
        stamp = SimpleNamespace(sec=START // 10**9 + second, nanosec=0)
        position = SimpleNamespace(x=1.0 * second, y=0.0, z=0.0)
        header = SimpleNamespace(stamp=stamp, frame_id=frame)
        sample = decoder.reference(SimpleNamespace(header=header, pose=SimpleNamespace(position=position)), 0)
    expected = (1.0 - north_mps, north_mps, 0.0)
    np.testing.assert_allclose(sample.velocity, expected, atol=1e-12)
    np.testing.assert_allclose(fixes[1][1], expected, atol=1e-12)


def test_course_and_speed_over_ground_are_east_and_north():
    decoder = MessageDecoder(Parameters(gnss_type="gps_msgs/msg/GPSFix"))
    message = fix(START)
    message.track, message.speed, message.climb, message.err_speed, message.err_climb = 90.0, 2.0, 0.1, 0.2, 0.0
    sample = decoder.reference(message, 0)
    np.testing.assert_allclose(sample.velocity, (2.0, 0.0, 0.1), atol=1e-12)
    assert sample.covariance[0, 0] == pytest.approx(0.01) and sample.covariance[2, 2] > 1e3


@pytest.mark.parametrize(
    "kind", ["uuv_sensor_ros_plugins_msgs/msg/DVL", "cola2_msgs/msg/DVL", "stonefish_ros2/msg/DVL"]
)
def test_the_simulators_dvls_are_read_and_what_they_call_invalid_is_refused(kind):
    decoder = MessageDecoder(Parameters(dvl_type=kind))
    message = fix(START)
    message.header.frame_id = "dvl_link"
    message.velocity, message.velocity_covariance = SimpleNamespace(x=1.0, y=0.1, z=0.0), np.eye(3).ravel() * 1e-4
    assert decoder.dvl(message, 0).velocity == (1.0, 0.1, 0.0)
    message.velocity_covariance = np.full(9, -1.0)
    assert decoder.dvl(message, 0) == Refusal("flagged_invalid")


def test_ds_dvl_is_read_in_the_instruments_axes_over_ground_only():
    decoder = MessageDecoder(Parameters(dvl_type="ds_sensor_msgs/msg/Dvl"))
    message = fix(START)
    message.header.frame_id = "dvl_link"
    message.velocity, message.velocity_covar = SimpleNamespace(x=1.0, y=0.1, z=0.0), np.full(9, -1.0)
    message.velocity_mode, message.coordinate_mode, message.num_good_beams = 1, 1, 4
    sample = decoder.dvl(message, 0)
    assert sample.velocity == (1.0, 0.1, 0.0) and sample.covariance is None
    for field, value, reason in (
        ("velocity_mode", 2, "water_track"), ("coordinate_mode", 3, "other_axes"), ("num_good_beams", 2, "few_beams"),
    ):  # fmt: skip
        changed = SimpleNamespace(**{**vars(message), field: value})
        assert decoder.dvl(changed, 0) == Refusal(reason)
