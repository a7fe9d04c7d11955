"""A clock is taken off while the node runs where two looks agree on it, at a moment that stamps decide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from runs import ONE_HERTZ, MatchedRun, make_samples

from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.assessor import Assessor
from dvl_calib_ros.calibration.calibrator import Calibrator
from dvl_calib_ros.calibration.estimators.estimator import AtOnce
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, Stream, VelocityFrame
from dvl_calib_ros.messages import live_feed
from dvl_calib_ros.messages.live_feed import MessageFeed
from dvl_calib_ros.node.diagnostics import LateClocks
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.verdict.reasons import Reason, finding


@dataclass(frozen=True)
class Look:
    """What is asked of a registration."""

    late: float

    @property
    def corrections(self):
        return {"reference_time_offset": self.late}

    def clock_reason(self, name: str) -> Reason:
        return finding("CLOCK_OFF", whose=name, seconds=self.late, std=0.01, way="late", against="IMU")


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
    asked = 0

    def __init__(self, work):
        self._work, self._found = work, None

    def result(self):
        _Waits.asked += 1
        self._found = self._work() if self._found is None else self._found
        return self._found


def first_known(worker) -> int:
    """Stamp (ns) of the DVL sample from which on a running calibration knows how the clocks stand."""
    calibrator = Calibrator(Parameters(), worker=worker, models=("full",))
    feed = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    for sample in make_samples(MatchedRun("box", 95.0, frame=VelocityFrame.ENU, gnss_std=0.01, **ONE_HERTZ)):
        feed[type(sample)](sample)
        if isinstance(sample, DvlSample) and calibrator.registration_so_far is not None:
            return sample.stamp_ns
    return 0


def test_when_a_clock_is_known_is_decided_by_stamps_however_busy_the_machine_is():
    assert 0 < first_known(AtOnce()) == first_known(Later())


def test_what_is_said_on_the_way_waits_for_no_block_and_is_thought_of_when_blocks_have_told_more(monkeypatch):
    """It waited for the block that was being solved, and messages with it; and was thought of with every status."""
    thought, real = [], Assessor.doubts
    monkeypatch.setattr(Assessor, "doubts", lambda *of, **how: thought.append(1) or real(*of, **how))
    calibrator = Calibrator(Parameters(), worker=Later())
    feed = {DvlSample: calibrator.feed_dvl, ReferenceSample: calibrator.feed_reference, ImuSample: calibrator.feed_imu}
    for sample in make_samples(MatchedRun("box", 65.0, frame=VelocityFrame.ENU, gnss_std=0.01, **ONE_HERTZ)):
        feed[type(sample)](sample)
        before = _Waits.asked
        assert calibrator.suggestion_so_far is None
        said = calibrator.doubts_so_far
        assert _Waits.asked == before
    assert 5 <= len(thought) <= 10  # a block is 10 s, and one model gives way to the other
    assert said == calibrator.doubts(fresh=False)


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """A bag whose reference is stamped late."""
    path = tmp_path_factory.mktemp("late") / "bag"
    effects = injection("lever_arm:x_m=-0.6"), injection("reference_time_offset:seconds=2.5")
    errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
    write_bag(
        Scenario("free", 200.0, 3, errors, gnss_std=0.05, imu_rate=10, effects=effects),
        path,
        Storage.MCAP,
        Compression.NONE,
    )
    return path


@pytest.mark.slow
def test_what_came_before_a_clock_was_taken_off_is_fed_again_so_that_live_is_what_a_replay_is(late):
    """It was forgotten: the answer was that of the rest of the bag."""
    calibrator = Calibrator(Parameters(), worker=AtOnce())
    feed, clocks, topics, taken_off = MessageFeed(calibrator), LateClocks(given=()), Topics(), 0
    with BagReader([late]) as bag:
        for topic, log_ns, message, _ in bag.messages(bag.topics):
            if topic == topics.dvl:
                now = feed.calibrator
                if parameters := clocks.parameters(now.registration_so_far, now.parameters):
                    taken_off = now.counts["dvl"]["accepted"]
                    feed.begin_again(Calibrator(parameters, worker=AtOnce()))
                feed.dvl(message, log_ns)
            elif topic == topics.gnss:
                feed.reference(message, log_ns)
            elif topic == topics.imu:
                feed.imu(message, log_ns)
    assert taken_off > 200
    live, replayed = feed.calibrator.result(), replay([late], feed.calibrator.parameters).result
    assert live.counts == replayed.counts and live.first_ns == replayed.first_ns
    for name, estimate in live.estimates.items():
        np.testing.assert_allclose(estimate.state, replayed.estimates[name].state, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(estimate.covariance, replayed.estimates[name].covariance, rtol=1e-9, atol=1e-12)


def test_what_is_more_than_is_kept_is_not_fed_again(monkeypatch):
    monkeypatch.setattr(live_feed, "MOST", 3)
    messages = live_feed.KeptMessages()
    for i in range(3):
        messages.add(Stream.DVL, DvlSample(i, (1.0, 0.0, 0.0)))
    assert messages.streams is not None and len(messages.streams.dvl) == 3
    messages.add(Stream.IMU, "no_data")
    assert messages.streams is None


def test_the_room_for_what_is_kept_is_taken_before_it_comes():
    """It grew by 10 MB in the first hour."""
    messages = live_feed.KeptMessages()
    room = messages.values
    for i in range(20_000):
        messages.add(Stream.IMU, ImuSample(i, None, (0.0, 0.0, 0.1)))
    assert messages.values is room and len(room) == live_feed.MOST
    messages.forget()
    assert not len(messages.values)


def test_what_is_kept_is_what_came():
    came = {
        Stream.DVL: [DvlSample(3, (1.0, 2.0, 3.0)), "no_data", DvlSample(4, (1.0, 2.0, 4.0), np.eye(3))],
        Stream.REFERENCE: [ReferenceSample(5, (1.0, 0.0, 0.0), 2.0 * np.eye(3), VelocityFrame.NED)],
        Stream.IMU: [ImuSample(6, None, (0.1, 0.2, 0.3)), "no_stamp", ImuSample(7, (0.0, 0.0, 0.6, 0.8), None)],
    }
    messages = live_feed.KeptMessages()
    for stream, samples in came.items():
        for sample in samples:
            messages.add(stream, sample)
    assert {block.stream: str([*block.samples()]) for block in messages.streams} == {
        stream: str(samples) for stream, samples in came.items()
    }
