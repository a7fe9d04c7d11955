"""Clocks that are far apart: by when messages arrived, live and in a recording, across pauses of any length."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs import MatchedRun, feed, feed_columns, make_samples, shifted

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.checks.imu_rate_consistency import SPAN_S, _spans
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import ReferenceSample, Stream
from dvl_calib_ros.calibration.registration import clock_domains
from dvl_calib_ros.calibration.registration.clock_domains import MOST, _ThinnedValues, arrival_offset, limit_s
from dvl_calib_ros.calibration.registration.motion_streams import Curves, MotionStreams, make_motion
from dvl_calib_ros.calibration.registration.unregistrable_clocks import far_clocks
from dvl_calib_ros.calibration.streams.interpolation import ImuColumns, shortened
from dvl_calib_ros.verdict.kinds import Severity

DVL, REFERENCE, IMU = Stream.DVL, Stream.REFERENCE, Stream.IMU
P = Parameters()


@pytest.mark.parametrize(
    ("ahead", "found"),
    [
        ({DVL: 0.0, REFERENCE: 18.0, IMU: 0.1}, [(REFERENCE, 18.0)]),
        ({DVL: -7.0, REFERENCE: 0.0, IMU: 0.1}, [(DVL, -7.0)]),
        ({DVL: 0.0, REFERENCE: 18.0, IMU: 18.1}, [(DVL, -18.0)]),
        ({DVL: 0.0, REFERENCE: -37.0}, [(REFERENCE, -37.0)]),
        ({DVL: 0.0, REFERENCE: 30.0, IMU: -30.0}, [(REFERENCE, 30.0), (IMU, -30.0)]),
        ({DVL: 0.0, REFERENCE: 4.0, IMU: -4.0}, []),
        ({DVL: 5.0}, []),
    ],
)
def test_the_stream_that_is_alone_is_named(ahead, found):
    assert [(each.stream, pytest.approx(each.ahead)) for each in arrival_offset(ahead, P)] == found


def test_what_the_parameters_take_off_is_no_fault_and_neither_is_late_arrival():
    told = P.replace(reference_time_offset=18.0)
    assert arrival_offset({DVL: 0.0, REFERENCE: 18.0}, told) == []
    assert arrival_offset({DVL: 0.0, REFERENCE: 0.0}, told) == []
    assert [each.ahead for each in arrival_offset({DVL: 0.0, REFERENCE: -18.0}, told)] == [-36.0]


def test_what_is_not_known_so_well_is_said_later():
    beyond = limit_s(P) + 3.0
    assert arrival_offset({DVL: 0.0, IMU: beyond}, P) and not arrival_offset({DVL: 0.0, IMU: beyond}, P, 5.0)


# ---------------------------------------------------------------------- live


@pytest.mark.parametrize("sizes", [[10], [MOST, 1], [MOST + 1], [3, 4096, 7, 4096] * 40, [1] * 20_000])
def test_of_many_numbers_every_so_many_th_is_kept(sizes):
    spread, numbers, first = _ThinnedValues(), np.arange(sum(sizes)), 0
    for size in sizes:
        spread.add(numbers[first : first + size])
        first += size
    every = int(np.diff(spread.kept)[0])
    np.testing.assert_array_equal(spread.kept, numbers[::every])
    assert len(spread.kept) <= MOST and (every == 1 or len(spread.kept) >= MOST // 2)


@pytest.mark.spread(2)
@pytest.mark.parametrize("seconds", [0, 18])
@pytest.mark.parametrize("given", [feed, feed_columns])
def test_live_clocks_that_are_apart_are_named_as_by_a_replay(seconds, given):
    """Nothing was paired then, so nothing verified, and nothing said beside that no data had come."""
    samples = make_samples(MatchedRun("straight", 60.0, imu_every=50))
    stamped = shifted(samples, seconds * 10**9, ReferenceSample)
    calibrator = Calibrator(Parameters(), worker=AtOnce())
    assert calibrator.doubts_so_far == []
    given(calibrator, stamped)
    said = [each for each in calibrator.doubts_so_far if each.code == "CLOCKS_APART"]
    assert bool(said) == bool(seconds) and all("GPS time" in str(each) for each in said)
    result = calibrator.result()
    assert (result.verifications[result.selected].verdict is Severity.REJECT) == bool(seconds)


def test_live_clocks_are_compared_again_only_where_something_came(monkeypatch):
    """Diagnostics ask twice a second, also of a vehicle whose instruments are off."""
    asked = []
    monkeypatch.setattr(clock_domains, "median", lambda ahead: asked.append(len(ahead)) or float(np.median(ahead)))
    late = shifted(make_samples(MatchedRun("straight", 60.0, imu_every=50)), 18 * 10**9, ReferenceSample)
    calibrator = feed(Calibrator(Parameters(), worker=AtOnce()), late[:-20])
    said = calibrator.doubts_so_far
    looks = len(asked)
    assert looks and calibrator.doubts_so_far == said and len(asked) == looks
    feed(calibrator, late[-20:])
    assert calibrator.doubts_so_far and len(asked) > looks


# ---------------------------------------------------------------------- pauses


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
