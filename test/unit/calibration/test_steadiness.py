"""A clock that drifts or leaps once is found with its size and time, and clocks that stand still are left alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from test_register import ARM, run

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.registration.clock_drift_and_jumps import unsteady
from dvl_calib_ros.calibration.registration.gauss_newton import Claimed, Fitted
from dvl_calib_ros.calibration.registration.motion_streams import make_motion
from dvl_calib_ros.calibration.registration.registration import Registration, register
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns

AT_S = 250.0


@cache
def registered(trajectory: str, whose: str = "", drift: float = 0.0, leap: float = 0.0) -> Registration:
    """A run of ten minutes, one of whose clocks gets later."""
    streams = dict(zip(("dvl", "reference", "imu"), run(trajectory, 5.0), strict=True))
    if whose:
        times, *values = streams[whose]
        times = times + drift * times + leap * (times > AT_S)
        later = np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0.0
        streams[whose] = (times[later], *(value[later] for value in values))
    made = make_motion(streams["dvl"], streams["reference"], True, (True,) * 3, ImuColumns(*streams["imu"]))
    assert made is not None
    found = register(made, np.eye(3), np.zeros(3))
    assert found is not None
    return found


@pytest.mark.parametrize("trajectory", ["box", "free"])
def test_clocks_that_stand_still_do(trajectory):
    assert registered(trajectory).unsteady is None


def test_noise_that_lasts_as_long_as_blocks_of_a_stretch_is_no_drift():
    """Survey 33059: -1914 ± 247 ppm were said of a clock that stood still, and the right answer was rejected."""
    seen = [(47.0, 1.2, -0.27), (139.0, 0.7, -0.09), (232.0, 0.3, 0.09), (324.0, -0.1, 0.27)]

    def found(inflation: float):
        std = np.array([0.01] * 4 + [0.3, 0.07, 0.1, 0.05, 0.35])
        claimed = Claimed(np.diag(std**2), inflation, np.full(9, 1.5))
        each = [
            Fitted(
                np.array([0.0] * 7 + [apart, late]), np.eye(3), 0.05, 400, 0.8, np.zeros(400), 3, np.arange(400),
                lambda: claimed,
            )
            for _, late, apart in seen
        ]  # fmt: skip
        return unsteady(np.array([at for at, *_ in seen]), each, is_turned=True)

    assert found(1.5) is not None  # where no noise lasts
    assert found(3.5) is None


@pytest.mark.spread(1)
@pytest.mark.parametrize("seconds", [0.3, -3.0])
@pytest.mark.parametrize("whose", ["dvl", "reference"])
def test_one_leap_is_found_with_its_size_and_time(whose, seconds):
    found = registered("figure8", whose, leap=seconds)
    assert found.unsteady is not None and found.unsteady.whose == whose and not found.unsteady.drift
    assert found.unsteady.leap == pytest.approx(seconds, abs=0.05 + 3.0 * found.unsteady.std)
    assert found.unsteady.at == pytest.approx(AT_S, abs=20.0 + abs(seconds))
    # ... and with it taken off the arm is what it is
    assert found.lever_arm[0] == pytest.approx(ARM, abs=0.05)


@pytest.mark.spread(1)
@pytest.mark.parametrize("whose", ["dvl", "reference", "imu"])
def test_a_drift_is_found_with_its_size(whose):
    found = registered("figure8", whose, drift=1e-3)  # 0.6 s in all, as 170 ppm make of an hour
    assert found.unsteady is not None and found.unsteady.whose == whose and not found.unsteady.leap
    assert found.unsteady.drift == pytest.approx(1e-3, abs=3.0 * found.unsteady.std)
    assert found.unsteady.std < 2e-4
    assert found.lever_arm[0] == pytest.approx(ARM, abs=0.05)


@pytest.mark.spread(1)
@pytest.mark.parametrize(
    ("trajectory", "whose", "moves"),
    [("free", "imu", {"leap": 0.5}), ("box", "imu", {"drift": 1e-3}), ("free", "reference", {"leap": 0.3})],
)
def test_what_looks_like_an_arm_of_its_own_in_each_stretch_is_told_by_the_arm_being_one(trajectory, whose, moves):
    found = registered(trajectory, whose, **moves)  # the arm was -1.04, -1.00 and -0.32
    assert found.unsteady is not None and found.unsteady.whose in (whose, "")
    assert found.lever_arm[0] == pytest.approx(ARM, abs=0.06)


@pytest.mark.slow
def test_only_the_clock_of_the_dvl_is_put_right_and_what_is_left_is_said():
    of_dvl, of_reference = (registered("figure8", whose, leap=1.0) for whose in ("dvl", "reference"))
    assert of_dvl.unsteady is not None and of_reference.unsteady is not None
    taken = of_dvl.unsteady.corrections(10**18)
    assert taken["dvl_time_jump"] == pytest.approx(1.0, abs=0.1)
    assert taken["dvl_time_jump_at"] == pytest.approx(1e9 + AT_S, abs=2.0)
    assert not of_reference.unsteady.corrections(10**18)
    said = of_reference.contradiction(Parameters())
    assert said is not None and said.code == "CLOCK_LEAPS"
    assert said.numbers["whose"] == "the reference's" and said.numbers["way"] == "ahead"


def test_a_clock_that_leaps_ahead_leaves_a_hole_in_its_stamps():
    """Combination 652, in noise that lasts: the DVL's clock leapt ahead by 42 s, in stamps that are all there."""
    at, std = np.arange(45.0, 600.0, 90.0), np.array([0.01] * 4 + [0.3] * 3 + [0.2, 0.2])
    claimed = Claimed(np.diag(std**2), 1.5, np.full(9, 1.5))
    each = [
        Fitted(
            np.array([0.0] * 7 + [40.0 * (n > 2), 0.0]), np.eye(3), 0.05, 400, 0.8, np.zeros(400), 3, np.arange(400),
            lambda: claimed,
        )
        for n in range(len(at))
    ]  # fmt: skip
    even = np.arange(0.0, 600.0, 0.2)
    streams = {"dvl": even[(even < 270.0) | (even > 310.0)], "reference": even, "imu": even}
    found = unsteady(at, each, True, streams)
    assert found is not None and found.whose == "dvl" and found.leap == pytest.approx(40.0, abs=1.0)
    found = unsteady(at, each, True, {**streams, "dvl": even})
    assert found is None or found.leap < 0.0
