"""A clock is taken off while the node runs where two looks agree on it, at a moment that stamps decide."""

from __future__ import annotations

from dataclasses import dataclass

from runs import ONE_HERTZ, MatchedRun, make_samples

from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.delay.workers import AtOnce
from dvl_calib_ros.calibration.parameters import Parameters
from dvl_calib_ros.calibration.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.node.late_clocks import LateClocks
from dvl_calib_ros.verdict.reasons import Reason, finding


@dataclass(frozen=True)
class Look:
    """What is asked of a registration."""

    late: float

    @property
    def taken_off(self):
        return {"reference_time_offset": self.late}

    def told(self, name: str) -> Reason:
        return finding("CLOCK_OFF", whose=name, seconds=self.late, std=0.01, way="late")


def test_two_looks_that_agree_take_a_clock_off_once():
    clocks = LateClocks(given=())
    assert clocks.parameters(Look(2.5), Parameters()) is None
    found = clocks.parameters(Look(2.52), Parameters())
    assert found is not None and found.reference_time_offset == 2.52
    (said,) = clocks.found
    assert said.code == "CLOCK_TAKEN_OFF" and said.numbers["value"] == 2.52 and said.causes[0].code == "CLOCK_OFF"
    assert clocks.parameters(Look(3.0), Parameters()) is clocks.parameters(Look(3.01), Parameters()) is None


class Later:
    """A worker that does what it is given when somebody asks for it."""

    def submit(self, work):
        return _Waits(work)


class _Waits:
    def __init__(self, work):
        self._work, self._found = work, None

    def result(self):
        self._found = self._work() if self._found is None else self._found
        return self._found


def first_known(worker) -> int:
    """Stamp (ns) of the DVL sample from which on a running calibration knows how the clocks stand."""
    calibrator = Calibrator(Parameters(), worker=worker, models=("G1", "G2"))
    feed = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    for sample in make_samples(MatchedRun("box", 95.0, frame=VelocityFrame.ENU, gnss_std=0.01, **ONE_HERTZ)):
        feed[type(sample)](sample)
        if isinstance(sample, DvlSample) and calibrator.registration_so_far is not None:
            return sample.stamp_ns
    return 0


def test_when_a_clock_is_known_is_decided_by_stamps_however_busy_the_machine_is():
    assert 0 < first_known(AtOnce()) == first_known(Later())
