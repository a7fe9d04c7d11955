"""Clocks are compared by so many messages as are enough, however long a recording is."""

from __future__ import annotations

import numpy as np
import pytest
from runs import MatchedRun, feed, feed_columns, make_samples, shifted

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import ReferenceSample
from dvl_calib_ros.calibration.registration import clock_domains
from dvl_calib_ros.calibration.registration.clock_domains import MOST, _ThinnedValues
from dvl_calib_ros.verdict.kinds import Severity


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
