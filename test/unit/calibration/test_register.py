"""One registration: clocks of all three instruments, lever arm and mounting, whichever is off and by how much."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import quaternion_from_rotation, rotation_from_rpy
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame
from dvl_calib_ros.calibration.registration import registration
from dvl_calib_ros.calibration.registration.configuration_check import SIGNS, fitting_configuration, wrong_axes
from dvl_calib_ros.calibration.registration.delay_search import FARTHEST_S, _minima, candidate_delays
from dvl_calib_ros.calibration.registration.gauss_newton import DELTA, DVL, REFERENCE, RHO, MotionFit
from dvl_calib_ros.calibration.registration.motion_streams import Curves, MotionStreams, make_motion
from dvl_calib_ros.calibration.registration.registration import (
    Clock,
    Registration,
    _is_possible,
    is_beyond_doubt,
    register,
)
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns, attitude_at
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors

ARM = -0.6
ONE_ARM = (injection(f"lever_arm:x_m={ARM}"),)
ERRORS = DvlErrors((0.02, -0.02, 0.03), (0.005,) * 3, beam_std=0.005)


@cache
def run(trajectory: str, rate: float, mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)):
    """Times and values of the streams of a run of ten minutes."""
    given = {"mounting_rpy": mounting, "gnss_std": 0.05, "gnss_rate": rate, "dvl_rate": rate}
    return columns_of(Scenario(trajectory, 600.0, 3, ERRORS, effects=ONE_ARM, **given))


def columns_of(scenario: Scenario):
    simulated = simulate(scenario)
    first_ns = simulated.dvl[0].stamp_ns

    def columns(samples, *fields):
        times = np.array([1e-9 * (sample.stamp_ns - first_ns) for sample in samples])
        return times, *(np.array([getattr(sample, field) for sample in samples]) for field in fields)

    return (
        columns(simulated.dvl, "velocity"),
        columns(simulated.gnss, "velocity"),
        columns(simulated.imu, "orientation", "angular_velocity"),
    )


def motion(trajectory: str, rate: float, dvl=0.0, reference=0.0, imu=0.0, in_earth=True, **scenario) -> MotionStreams:
    """A run whose stamps are late by so many seconds."""
    (td, v), (tg, g), (ti, q, w) = run(trajectory, rate, **scenario)
    made = make_motion((td + dvl, v), (tg + reference, g), in_earth, (True,) * 3, ImuColumns(ti + imu, q, w))
    assert made is not None
    return made


def registered(*args, **late) -> Registration:
    found = register(motion(*args, **late), np.eye(3), np.zeros(3))
    assert found is not None
    return found


@pytest.mark.spread(4)
@pytest.mark.parametrize(
    ("trajectory", "rate", "seconds"),
    [("box", 5.0, 0.0), ("figure8", 5.0, 0.8), ("free", 1.0, 0.8), ("free", 1.0, 30.0)],
)
@pytest.mark.parametrize("stream", ["dvl", "reference"])
def test_a_late_clock_is_found_and_no_other(trajectory, rate, seconds, stream):
    found = registered(trajectory, rate, **{stream: seconds})
    other = "reference" if stream == "dvl" else "dvl"
    assert getattr(found, stream).delay_s == pytest.approx(seconds, abs=0.05 + 0.03 * seconds)
    assert getattr(found, stream).is_shown == (seconds > 0.0)
    assert getattr(found, other).delay_s == pytest.approx(0.0, abs=1e-3)
    assert not getattr(found, other).is_shown and not found.imu.is_shown
    assert found.offsets.keys() == ({f"{stream}_time_offset"} if seconds else set())
    assert found.lever_arm[0] == pytest.approx(ARM, abs=5.0 * found.lever_arm_std[0] + 0.02)


@pytest.mark.spread(1)
@pytest.mark.parametrize("seconds", [(7.5, 7.0), (2.0, 5.0), (-1.0, 3.0)])
def test_two_late_clocks_are_told_apart(seconds):
    dvl, reference = seconds
    found = registered("free", 5.0, dvl=dvl, reference=reference)
    assert found.dvl.is_shown and found.reference.is_shown
    assert found.dvl.delay_s == pytest.approx(dvl, abs=max(0.1, 4.0 * found.dvl.std))
    assert found.reference.delay_s == pytest.approx(reference, abs=max(0.1, 4.0 * found.reference.std))
    said = found.contradiction(Parameters())
    assert said is not None and said.code == "CLOCKS_LATE"
    assert said.numbers["dvl_way"] == ("early" if dvl < 0.0 else "late")
    assert (said.numbers["seconds"], said.numbers["dvl_seconds"]) == pytest.approx((reference, abs(dvl)), abs=0.1)


@pytest.mark.parametrize("seconds", [-0.6, 0.5, 4.0])
def test_where_dvl_and_reference_agree_it_is_the_imu(seconds):
    found = registered("free", 5.0, imu=seconds)
    assert found.imu.is_shown and found.imu.delay_s == pytest.approx(seconds, abs=0.1)
    assert found.offsets == {"imu_time_offset": found.imu.delay_s}
    said = found.contradiction(Parameters())
    assert said is not None and (said.code, said.numbers["parameter"]) == ("CLOCK_LATE", "imu_time_offset")


def test_a_reference_in_the_body_shows_only_the_difference_of_the_clocks():
    (td, v), (tg, g), (ti, q, w) = run("free", 5.0)
    turned = np.array([1.0, 0.4, 0.1])  # any frame will do: what counts is that no attitude turns it
    made = make_motion(
        (td + 2.0, v), (tg, np.linalg.norm(g, axis=1)[:, None] * turned), False, (True,) * 3, ImuColumns(ti, q, w)
    )
    found = register(made, None, np.zeros(3))
    assert found.apart.delay_s == pytest.approx(2.0, abs=0.1) and not found.reference.is_shown


@pytest.mark.spread(1)
@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.7), (np.pi, 0.0, -2.0), (0.3, 0.5, 1.0)])
def test_a_mounting_that_nobody_told_is_found_with_the_clock(rpy):
    found = register(motion("free", 5.0, reference=5.0, mounting=rpy), None, np.zeros(3))
    assert found.reference.delay_s == pytest.approx(5.0, abs=0.2)
    away = found.rotation_body_from_dvl.T @ rotation_from_rpy(rpy)
    assert np.arccos(0.5 * (np.trace(away) - 1.0)) < 0.1


def test_a_straight_leg_at_one_speed_shows_no_clock():
    times = np.arange(0.0, 300.0, 0.2)
    rng = np.random.default_rng(1)
    level, still = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)), np.zeros((len(times), 3))
    for late in (0.0, 2.0):
        v, g = (np.array([1.5, 0.0, 0.0]) + std * rng.standard_normal((len(times), 3)) for std in (0.01, 0.1))
        made = make_motion((times, v), (times + late, g), True, (True,) * 3, ImuColumns(times, level, still))
        found = register(made, np.eye(3), np.zeros(3))
        assert not (found.dvl.is_shown or found.reference.is_shown or found.imu.is_shown)
        assert found.offsets == {} and found.contradiction(Parameters()) is None


def leg_in_waves(seed: int) -> MotionStreams:
    """A leg in time, in waves of two periods that repeat each other after 41 s, with a DVL as noisy as a reference."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 380.0, 0.02)
    first, second = 2.0 * np.pi / 6.0 * times, 2.0 * np.pi / 8.22 * times
    phase = rng.uniform(0.0, 6.0, 6)
    tilt = 0.007 * (np.sin(first[:, None] + phase[:2]) + 0.7 * np.sin(second[:, None] + phase[2:4]))
    angles = np.column_stack([tilt, 0.4 * np.sin(times / 60.0) + 0.1 * np.sin(times / 17.0)])
    heave = 0.05 * (np.sin(first + phase[4]) + 0.5 * np.sin(second + phase[5]))
    body = np.column_stack([1.8 + 0.02 * np.cos(first + phase[4]), 0.015 * np.sin(second + phase[5]), heave])
    attitudes = rotation_from_rpy(angles)
    dvl, reference, imu = slice(10, None, 25), slice(3, None, 10), slice(0, None, 5)
    v, g = body[dvl], np.einsum("nij,nj->ni", attitudes, body)[reference]
    orientations = np.array([quaternion_from_rotation(each) for each in attitudes[imu]])
    made = make_motion(
        (times[dvl], v + rng.normal(0.0, 0.03, v.shape)),
        (times[reference], g + rng.normal(0.0, 0.06, g.shape) * [1.0, 1.0, 1.5]),
        True,
        (True,) * 3,
        ImuColumns(times[imu], orientations, np.gradient(angles, times, axis=0)[imu]),
    )
    assert made is not None
    return made


@pytest.mark.parametrize("seed", [1, 11])
def test_waves_that_repeat_with_other_noise_are_no_clock(seed):
    found = register(leg_in_waves(seed), np.eye(3), np.zeros(3))
    assert found is not None and found.offsets == {} and found.ambiguity is None


def leg_in_moving_water(share: float, seed: int) -> MotionStreams:
    """A leg at about one speed, in time, whose DVL is on moving water over the last share of it."""
    times = np.arange(0.0, 400.0, 0.2)
    rng = np.random.default_rng(seed)
    roll, slow, slower = (0.05 * np.sin(2.0 * np.pi * times / period + seed) for period in (7.0, 31.0, 83.0))
    yaw = slow + slower
    attitudes = rotation_from_rpy(np.column_stack([roll, 0.0 * yaw, yaw]))
    rates = np.column_stack([np.gradient(roll, times), 0.0 * yaw, np.gradient(yaw, times)])
    body = np.column_stack([1.5 + 0.03 * np.sin(times / 11.0), 0.02 * np.sin(times / 3.0), 0.0 * yaw])
    earth = np.einsum("nij,nj->ni", attitudes, body)
    water = np.einsum("nji,j->ni", attitudes, [0.2, 0.15, 0.0]) * (times > 400.0 * (1.0 - share))[:, None]
    dvl = body - water + 0.01 * rng.standard_normal(body.shape)
    reference = earth + 0.036 * rng.standard_normal(body.shape)
    imu = ImuColumns(times, np.array([quaternion_from_rotation(each) for each in attitudes]), rates)
    made = make_motion((times, dvl), (times, reference), True, (True,) * 3, imu)
    assert made is not None
    return made


def test_a_stretch_of_bad_velocities_is_no_clock_that_pushes_it_out_of_the_overlap():
    """Less was left of the rest there, and 42 s were taken off clocks that were in time."""
    found = register(leg_in_moving_water(0.1, 0), np.eye(3), np.zeros(3))
    assert found is not None
    assert found.offsets == {} and found.corrections == {}
    assert abs(found.dvl.delay_s) < 3.0 and abs(found.reference.delay_s) < 3.0


@pytest.mark.spread(1)
@pytest.mark.parametrize("seed", [0, 2])
def test_nothing_is_taken_off_where_a_leg_does_not_show_its_clocks(seed):
    """A delay of 115 s was, which no parameter takes."""
    found = register(leg_in_moving_water(0.3, seed), np.eye(3), np.zeros(3))
    assert found is not None
    assert not found.are_known and found.corrections == {}
    assert max(abs(found.dvl.delay_s), abs(found.reference.delay_s)) <= FARTHEST_S


@pytest.mark.slow
def test_sigmas_of_the_clocks_and_the_arm_are_what_runs_scatter_by():
    z = []
    for seed in range(12):
        dvl, (tg, g), imu = columns_of(Scenario("box", 300.0, seed, ERRORS, gnss_std=0.1, effects=ONE_ARM))
        late = make_motion(dvl, (tg + 3.0, g), True, (True,) * 3, ImuColumns(*imu))
        found = register(late, np.eye(3), np.zeros(3))
        z.append([(found.reference.delay_s - 3.0) / found.reference.std,
                  (found.lever_arm[0] - ARM) / found.lever_arm_std[0]])  # fmt: skip
    rms = np.sqrt((np.array(z) ** 2).mean(axis=0))
    assert (rms < 2.0).all() and (rms > 0.4).all()


def test_too_little_is_none():
    (td, v), (tg, g), (ti, q, w) = run("box", 1.0)
    imu = ImuColumns(ti, q, w)
    assert make_motion((td[:1], v[:1]), (tg, g), True, (True,) * 3, imu) is None
    short = make_motion((td[:5], v[:5]), (tg[:5], g[:5]), True, (True,) * 3, imu)
    assert register(short, np.eye(3), np.zeros(3)) is None
    apart = make_motion((td, v), (tg + 5000.0, g), True, (True,) * 3, imu)
    assert candidate_delays(apart, np.eye(3)) == [] and register(apart, np.eye(3), np.zeros(3)) is None


def test_at_one_speed_the_clock_of_a_reference_is_in_the_arm_and_the_delay():
    """A boat's forward arm came out at -0.46 m ± 0.05, and is 0.0 ± 0.1 by differences of velocities."""
    (td, v), (tg, g), imu = run("figure8", 5.0)
    ahead = v * [1.0, 0.0, 0.0]
    at_one_speed = make_motion((td, ahead * (1.0 / v[:, :1])), (tg, g), True, (True, True, False), ImuColumns(*imu))
    assert at_one_speed is not None
    turned = register(_of_its_own(at_one_speed), np.eye(3), np.zeros(3))
    assert turned is not None
    std = np.sqrt(np.diag(turned.left_open))[3:]
    assert std[0] == pytest.approx(std[3] * turned.speed, rel=0.1) and std[0] > 0.08 > 10.0 * std[1]


def test_on_a_circle_the_clock_of_a_reference_is_in_the_yaw():
    """At one rate of turn a reference that is late is turned by as much: what is open of one is open of the other."""
    times = np.arange(0.0, 300.0, 0.2)
    yaw, zero = 0.1 * times, np.zeros(len(times))
    quaternions = np.stack([np.cos(0.5 * yaw), zero, zero, np.sin(0.5 * yaw)], axis=1)
    rates, ahead = np.tile([0.0, 0.0, 0.1], (len(times), 1)), np.tile([1.0, 0.0, 0.0], (len(times), 1))
    circle = make_motion(
        (times, ahead * (1.0 + 0.1 * np.sin(times / 9.0))[:, None]), (times, ahead), True, (True, True, False),
        ImuColumns(times, quaternions, rates),
    )  # fmt: skip
    assert circle is not None
    found = register(_of_its_own(circle), np.eye(3), np.zeros(3))
    assert found is not None
    std = np.sqrt(np.diag(found.left_open))
    assert std[2] == pytest.approx(0.1 * std[6], rel=0.15) and std[6] > 0.4
    assert max(std[0], std[1]) < 0.01 * std[2]


def _of_its_own(one: MotionStreams) -> MotionStreams:
    """The same where the reference is what the DVL says, with noise."""
    rng = np.random.default_rng(3)
    rotation, known = attitude_at(one.imu, one.dvl.times, 2.0)
    seen = np.einsum("nij,nj->ni", rotation, one.dvl.velocity)[known] + rng.normal(0.0, 0.05, (known.sum(), 3))
    return replace(one, reference_times=one.dvl.times[known], reference=seen)


def heaving():
    """A vehicle that heaves, which shows the sign of z as its sway does that of y."""
    (td, v), (tg, g), imu = run("free", 5.0)
    v, g = (each + np.outer(np.sin(2.0 * np.pi * t / 7.3), [0.0, 0.0, 0.1]) for t, each in ((td, v), (tg, g)))
    return (td, v), (tg, g), ImuColumns(*imu)


MIRRORED = {
    (1.0, 1.0, 1.0): None, (1.0, -1.0, 1.0): "y", (-1.0, -1.0, -1.0): "each of x, y and z",
}  # fmt: skip


@pytest.mark.spread(1)
@pytest.mark.parametrize(("signs", "axis"), MIRRORED.items())
def test_a_left_handed_driver_is_named_with_its_axis(signs, axis):
    """An arm of -0.52 m ± 0.08 for 0.60 and a yaw 4.3 degrees off were marginal, a pitch 2 degrees off accepted."""
    (td, v), reference, imu = heaving()
    made = make_motion((td, v * signs), reference, True, (True,) * 3, imu)
    found = register(made, np.eye(3), np.zeros(3))
    said = fitting_configuration(made, VelocityFrame.ENU, found, Parameters())
    assert (said and (said.code, said.numbers)) == (axis and ("DVL_LEFT_HANDED", {"axis": axis, "alike": ""}))
    said = fitting_configuration(made, VelocityFrame.ENU, found, Parameters(dvl_axes="frd"))
    assert axis not in ("y", "z") or f"(read as frd; read as flu, {'zy'['yz'.index(axis)]} does)" in said.sentence


QUARTER = Parameters(mounting_rpy=(0.0, 0.0, 0.5 * np.pi))


def test_a_left_handed_driver_at_90_degrees_is_named_with_its_axis():
    """With x mirrored it was accepted, with a yaw 6 degrees off."""
    (td, v), reference, imu = heaving()
    quarter = rotation_from_rpy((0.0, 0.0, 0.5 * np.pi))
    made = make_motion((td, (v @ quarter) * [-1.0, 1.0, 1.0]), reference, True, (True,) * 3, imu)
    found = register(made, quarter, np.zeros(3))
    said = fitting_configuration(made, VelocityFrame.ENU, found, QUARTER)
    assert said and (said.code, said.numbers) == ("DVL_LEFT_HANDED", {"axis": "x", "alike": ""})


def test_a_scale_of_one_axis_is_judged_by_the_residual_with_that_scale():
    """A registration with clocks of its own fitted better than a DVL without the scale."""
    (td, v), (tg, g), (ti, q, w) = run("free", 5.0)
    heave = 0.1 * np.sin(2.0 * np.pi * np.outer(td, [0.0, 0.0, 1.0]) / 9.0)
    right, half = (
        make_motion((td, (v + heave) * [1.0, 1.0, z]), (tg, g + heave), True, (True,) * 3, ImuColumns(ti, q, w))
        for z in (1.0, 0.5)
    )
    level = MotionFit(right, np.zeros(3), Curves(right))(0.0, 0.0, np.eye(3), (REFERENCE,)).level
    wrong = wrong_axes(half, np.eye(3), np.zeros(3), 1.01 * level, "from_message", SIGNS)
    assert wrong is not None and wrong.code == "DVL_AXIS_SCALED"
    assert wrong.numbers["factor"] == pytest.approx(0.5, abs=0.05)


def test_noise_of_the_axis_across_is_no_scale_of_the_axis_ahead(rng):
    """A DVL at 90 degrees, whose y points ahead, was rejected: "y is 0.22 times its true value"."""
    (td, v), (tg, g), imu = run("box", 5.0)
    quarter = rotation_from_rpy((0.0, 0.0, 0.5 * np.pi))
    measured = v @ quarter + rng.normal(0.0, 0.05, v.shape)
    made = make_motion((td, measured), (tg, g), True, (True,) * 3, ImuColumns(*imu))
    found = register(made, quarter, np.zeros(3))
    assert fitting_configuration(made, VelocityFrame.ENU, found, QUARTER) is None


@pytest.mark.parametrize("late", [0.0, 0.06, 0.1])
def test_an_imu_too_little_late_to_be_shown_is_in_the_arm(late):
    """An arm of 0.26 m ± 0.01 for 0.40 was accepted of one that is 0.1 s late."""
    found = registered("free", 5.0, imu=late)
    assert found.offsets == {}
    std = np.hypot(found.lever_arm_std, np.sqrt(np.diag(found.left_open))[3:6])
    assert (np.abs(found.lever_arm - [ARM, 0.0, 0.0]) < 2.5 * std).all() and std[0] < 0.06


def test_a_clock_that_is_not_told_apart_stays_in_time_and_is_open_by_what_the_data_have_it_late(monkeypatch):
    """An IMU 0.15 s late made an arm of 0.60 m ± 0.06 of one of 0.80, accepted: which clock was off was not told apart,
    and σ was that of a clock that had been taken off."""
    assert registered("free", 5.0, imu=0.3).open_std_s < 0.1
    monkeypatch.setattr(registration, "RULED_OUT", 1e9)
    found = registered("free", 5.0, imu=0.3)
    assert found.offsets == {} and found.open_std_s == pytest.approx(0.3, abs=0.1)
    assert np.sqrt(found.left_open[3, 3]) == pytest.approx(abs(found.open_by[3]) * 0.25, rel=0.3)


def test_where_the_clock_shows_nothing_of_the_arm_is_open():
    assert not registered("figure8", 5.0).left_open.any()
    assert not registered("free", 5.0, in_earth=False).left_open.any()


@pytest.mark.parametrize("seed", range(2))
def test_what_noise_seems_to_tell_of_a_delay_leaves_a_covariance(seed):
    """More was taken off than was known beside lever arm and scale: variances below zero, and steps without end."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 60.0, 0.2)
    yaw = 0.02 * np.sin(0.3 * times)
    attitude = np.array([quaternion_from_rotation(rotation_from_rpy((0.0, 0.0, each))) for each in yaw])
    rates = np.column_stack([0.0 * yaw, 0.0 * yaw, 0.006 * np.cos(0.3 * times)])
    speed = np.ones(len(times))
    body = np.column_stack([speed, np.zeros((len(times), 2))])
    earth = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * speed])
    v, g = (each + std * rng.standard_normal(each.shape) for each, std in ((body, 0.1), (earth, 0.1)))
    made = make_motion((times, v), (times[::10], g[::10]), True, (True,) * 3, ImuColumns(times, attitude, rates))
    for in_time in ((), (REFERENCE,), (DVL,)):
        found = MotionFit(made, np.zeros(3), Curves(made))(0.0, 0.0, np.eye(3), in_time)
        assert (np.diag(found.p) > 0.0).all() and np.abs(found.x).max() < FARTHEST_S


@pytest.mark.parametrize(
    ("at", "value", "is_possible"),
    [(RHO, 0.0, True), (RHO, FARTHEST_S - 1.0, True), (RHO, FARTHEST_S + 1.0, False), (DELTA, FARTHEST_S + 1.0, False),
     (DELTA, np.nan, False), (0, np.inf, False)],
)  # fmt: skip
def test_a_fit_that_settles_beyond_a_minute_or_nowhere_is_none(at, value, is_possible):
    moved = motion("box", 5.0)
    fitted = MotionFit(moved, np.zeros(3), Curves(moved))(0.0, 0.0, np.eye(3))
    x = fitted.x.copy()
    x[at] = value
    assert _is_possible(fitted._replace(x=x)) is is_possible


def test_flanks_of_a_broad_place_do_not_take_those_of_others():
    """Legs that repeat: a DVL that was 30 s late was found 50 s early, four times."""
    late = np.arange(-60.0, 60.5, 0.5)
    misfit = np.minimum(1e-5 * (late + 50.0) ** 2, 0.002 + 1e-2 * np.abs(late - 30.0))[None]
    assert [place.dvl for place in _minima(misfit, np.zeros(1), late, 4)][:2] == [-50.0, 30.0]


def test_a_clock_that_is_far_off_is_known_to_a_share_of_it():
    """At 1 Hz a DVL that was 7.5 s late was known to 0.28 s, so nobody said so, and replay found a delay of 3 s."""
    assert is_beyond_doubt(7.76, 0.28) and not is_beyond_doubt(1.06, 0.28) and not is_beyond_doubt(0.08, 0.001)
    assert not is_beyond_doubt(36.7, 0.43)  # of a short run


def test_clocks_that_are_far_apart_and_not_told_are_a_reason_against_a_calibration():
    in_time = Clock(0.0, 0.1, False)
    found = replace(registered("box", 5.0), dvl=in_time, reference=in_time, imu=in_time, apart=Clock(-50.0, 0.1, True))
    assert found.ambiguity is not None and found.ambiguity.code == "CLOCKS_NOT_TOLD_APART"
    assert found.contradiction(Parameters()) == found.ambiguity


@pytest.mark.parametrize(
    ("late", "next_worse", "code"), [(0.2, 10.0, None), (0.2, 17.0, "CLOCK_LATE"), (0.5, 10.0, "CLOCK_LATE")]
)
def test_a_clock_that_is_told_apart_by_little_is_no_reason_against_a_calibration_whose_sigma_holds_it(
    late, next_worse, code
):
    """Of all streams it was not told apart, so not taken off; of what was calibrated with it was, and rejected."""
    in_time, arm = Clock(0.0, 0.1, False), np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    clocks = {"dvl": in_time, "imu": in_time, "reference": Clock(late, 0.02, True)}
    found = replace(registered("box", 5.0), **clocks, open_std_s=0.15, open_by=arm, next_worse=next_worse)
    said = found.contradiction(Parameters())
    assert (said.code if said else None) == code
    without = replace(found, open_by=np.zeros(7)).contradiction(Parameters())
    assert without is not None and without.code == "CLOCK_LATE"
