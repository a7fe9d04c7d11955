"""What is looked at of a long run: the newest blocks, and a verdict by them is that by all that is kept of a bag."""

from __future__ import annotations

import numpy as np
import pytest
from runs import MatchedRun, calibrate, make_samples

from dvl_calib_ros.calibration.estimators import registration_schedule
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.results.thinned_recording import NO_TERMS, ThinnedRecording


@pytest.fixture(scope="module")
def kept():
    """Blocks of a run of five minutes."""
    run = MatchedRun("free", 300.0, gnss_std=0.05, dvl_std=0.01, frame=registration_schedule.FRAMES[1])
    calibrator = calibrate(make_samples(run), verified=True, models=("full",))
    return calibrator._estimators["full"]._idle_solver().kept


def test_all_that_blocks_are_registered_and_judged_by_is_kept(kept):
    seen = registration_schedule._NewestBlocks()
    for each in kept:
        seen.add(each)
    motion = seen.motion()
    np.testing.assert_array_equal(motion.dvl.times, np.concatenate([each.dvl.times for each in kept]))
    np.testing.assert_array_equal(motion.dvl.velocity, np.concatenate([each.dvl.velocity for each in kept]))
    np.testing.assert_array_equal(motion.reference, np.concatenate([each.reference.velocity for each in kept]))
    whole, parameters = ThinnedRecording.of(kept), Parameters()
    at = np.arange(len(whole.dvl.times))
    compared = (each.compared(at, NO_TERMS, parameters) for each in (seen.recording(), whole))
    for own, other in zip(*compared, strict=True):
        np.testing.assert_array_equal(own, other)


def test_of_more_blocks_the_newest_are_kept_and_room_does_not_grow(kept, monkeypatch):
    monkeypatch.setattr(registration_schedule, "KEPT_BLOCKS", 5)
    seen = registration_schedule._NewestBlocks()
    seen.take_room()
    for each in [*kept, *kept]:
        seen.add(each)
    assert len(seen) == 5
    np.testing.assert_array_equal(seen.motion().dvl.times, np.concatenate([each.dvl.times for each in kept[-5:]]))
