"""What is made of a span of time grows with samples, not with the pauses between them, and finds the same."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.calibration.checks.imu_rate_consistency import SPAN_S, _spans
from dvl_calib_ros.calibration.registration.motion_streams import Curves, MotionStreams, make_motion
from dvl_calib_ros.calibration.registration.unregistrable_clocks import far_clocks
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns, shortened

DAY_S, YEAR_S = 86_400.0, 365 * 86_400.0
MIB = 1 << 20


@given(st.lists(st.floats(0.0, 1e9), min_size=1, max_size=30), st.floats(0.1, 1e6))
def test_only_the_longest_pauses_are_cut_and_to_one_length(pauses, most):
    pauses = np.array(pauses)
    found = shortened(pauses, most)
    if pauses.sum() <= most:
        assert found is pauses
        return
    assert found.sum() == pytest.approx(most, rel=1e-6)
    cut = found < pauses
    assert cut.any() and np.ptp(found[cut]) == 0.0
    assert (found[~cut] <= found[cut][0]).all()


@given(st.integers(2, 40), st.floats(-1e3, 1e3), st.integers(0, 2**32))
def test_spans_are_those_of_a_grid_of_time(n, start, seed):
    rng = np.random.default_rng(seed)
    times = start + np.cumsum(rng.choice([0.02, 0.1, 0.25, SPAN_S, 3.0], n))
    wanted = np.searchsorted(times, np.arange(times[0], times[-1] + SPAN_S, SPAN_S)).clip(max=n - 1)
    at = wanted[np.flatnonzero(np.diff(wanted, prepend=-1))]
    np.testing.assert_array_equal(_spans(times), np.stack([at[:-1], at[1:]]))


def motion(late_s: float, pause_s: float, imu_starts: float = 0.0) -> MotionStreams:
    """Two dives of ten minutes with a pause between them, the DVL stamped late."""
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 1200.0, 0.5)
    speed = 1.0 + 0.5 * np.convolve(rng.standard_normal(len(time)), np.ones(40) / 6.0, "same")
    velocity = np.column_stack([speed, 0.1 * np.sin(time / 20.0), np.zeros(len(time))])
    time = time + pause_s * (time >= 600.0)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    imu = ImuColumns(np.append(imu_starts, time[1:]), level, np.zeros((len(time), 3)))
    made = make_motion((time + late_s, velocity), (time, velocity), True, (True, True, True), imu)
    assert made is not None
    return made


def peak(run) -> int:
    tracemalloc.start()
    run()
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most


@pytest.mark.spread(1)
@pytest.mark.parametrize("pause_s", [0.0, YEAR_S])
def test_clocks_that_are_far_apart_are_found_across_a_pause(pause_s):
    found = far_clocks(motion(200.0, pause_s), np.eye(3))
    assert found is not None
    assert (found.whose, found.delay_s) == ("the DVL's", pytest.approx(200.0, abs=1.0))
    assert far_clocks(motion(0.0, pause_s), np.eye(3)) is None


def test_how_far_a_clock_is_off_is_found_however_far():
    found = far_clocks(motion(-50 * YEAR_S, YEAR_S), np.eye(3))
    assert found is not None
    assert found.delay_s == pytest.approx(-50 * YEAR_S, abs=1.0)


@pytest.mark.parametrize(
    "streams", [motion(0.0, YEAR_S), motion(0.0, 0.0, -YEAR_S)], ids=["a year's pause", "an IMU's first stamp"]
)
def test_memory_does_not_grow_with_the_span_of_stamps(streams):
    assert peak(lambda: far_clocks(streams, np.eye(3))) < 200 * MIB
    assert peak(lambda: Curves(streams)) < 200 * MIB
