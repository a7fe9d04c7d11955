"""Clocks further apart than a diagnosis can fit are refused in one line; what is nearer is left to the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.registration.delay_search import STEP_S
from dvl_calib_ros.calibration.registration.unregistrable_clocks import lag
from dvl_calib_ros.diagnosis.diagnose import diagnose_recordings
from dvl_calib_ros.diagnosis.model.recorded_streams import RecordedStreams, load_recordings, make_recording
from dvl_calib_ros.diagnosis.model.stream_curve import Curve
from dvl_calib_ros.diagnosis.search.initial_guess import check_clocks
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, simulate
from dvl_calib_ros.simulation.sensors import DvlErrors


@pytest.fixture(scope="module", params=["free", "figure8"])
def recording(request) -> RecordedStreams:
    errors = DvlErrors((0.02, -0.02, 0.03), (0.005,) * 3, beam_std=0.005)
    run = simulate(Scenario(request.param, 300.0, 3, errors, gnss_std=0.05, effects=(injection("lever_arm:x_m=-1.9"),)))
    first_ns = run.dvl[0].stamp_ns

    def stream(samples, field):
        time = np.array([1e-9 * (sample.stamp_ns - first_ns) for sample in samples])
        return time, np.array([getattr(sample, field) for sample in samples])

    return make_recording(
        request.param, stream(run.dvl, "velocity"), stream(run.gnss, "velocity"),
        attitude=stream(run.imu, "orientation"), rates=stream(run.imu, "angular_velocity"),
    )  # fmt: skip


def late(recording: RecordedStreams, stream: str, seconds: float) -> RecordedStreams:
    curve = getattr(recording, stream)
    return replace(recording, **{stream: Curve(curve.time + seconds, curve.values)})


@pytest.mark.parametrize("seconds", [0.0, 1.5, -4.0, 7.9, -30.0, 59.0])
@pytest.mark.parametrize("stream", ["dvl", "reference", "attitude"])
def test_a_clock_that_can_be_fitted_is_left_to_the_fit(recording, stream, seconds):
    check_clocks(late(recording, stream, seconds), np.eye(3))


def test_an_outage_of_the_reference_is_no_reason_to_refuse_clocks_that_agree():
    """The shipped bag: three laps of a box, and two minutes without GNSS, across which a curve is anything."""
    loaded = load_recordings([ROOT / "bags" / "harbour_box"], Parameters(), Topics())
    for recording in loaded.recordings:
        check_clocks(recording, np.eye(3))


def test_legs_that_repeat_between_two_steps_of_the_grid_are_no_reason_to_refuse_clocks():
    """Without noise, a quarter of a second apart: on the grid, the lag of one lap agrees better than any near one."""
    time, lap = STEP_S * np.arange(600), 100.25
    courses = [np.exp(2j * np.sin(2.0 * np.pi * (time + shift) / lap)) for shift in (0.0, 0.25)]
    late, is_far = lag(courses[0], 0.0, courses[1], 0.0)
    assert not is_far and abs(late) <= STEP_S


def test_a_constant_speed_shows_no_lag():
    """Of a vehicle on circles with motion capture that was silent, the IMU was said to be 257 s late."""
    speeds = 0.3 + np.random.default_rng(2).normal(0.0, 0.01, (2, 800))
    assert lag(speeds[0].astype(complex), 0.0, speeds[1].astype(complex), 0.0) == (0.0, False)


@pytest.mark.parametrize(("stream", "whose"), [("dvl", "the DVL's"), ("attitude", "the IMU's")])
@pytest.mark.parametrize("seconds", [75.0, 100.0, -100.0, 500.0, 1.7e9])
def test_a_clock_that_is_too_far_off_is_refused_in_one_line_whatever_is_common_to_the_streams(
    recording, stream, whose, seconds
):
    if recording.name == "figure8" and abs(seconds) <= 100.0:
        pytest.skip("it agrees with itself a round later, which is nearer than what is refused")
    with pytest.raises(InputError) as caught:
        check_clocks(late(recording, stream, seconds), np.eye(3))
    assert whose in str(caught.value) and "\n" not in str(caught.value)
    if recording.name == "free":  # a figure of eight agrees with itself a round later
        assert ("later" if seconds > 0.0 else "earlier") in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [75.0, 100.0])
def test_a_diagnosis_of_such_clocks_ends_in_that_line_and_not_in_an_answer(recording, seconds):
    if recording.name == "figure8" and seconds == 100.0:
        pytest.skip("it agrees with itself a round later, which is nearer than what is refused")
    with pytest.raises(InputError, match="set that clock; use the recording times"):
        diagnose_recordings([late(recording, "dvl", seconds)], Parameters())


def test_a_speed_that_hardly_changes_refuses_no_clock():
    """Near and far lags agree as well; the near one is worse on the few samples that the far one has."""
    time, rng = np.arange(0.0, 600.0, STEP_S), np.random.default_rng(0)
    speed = 1.5 + 0.05 * (np.mod(time, 100.0) < 8.0)
    one, other = (np.asarray(speed + 0.01 * rng.standard_normal(len(time)), dtype=complex) for _ in range(2))
    other[time < 150.0] += 0.2 * rng.standard_normal(int((time < 150.0).sum()))
    for late in (0.0, 300.0, -300.0):
        assert not lag(one, late, other, 0.0)[1]
