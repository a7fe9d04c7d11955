"""Where stamps show that a clock was set back."""

from __future__ import annotations

import numpy as np
import pytest

from dvl_calib_ros.diagnosis.model.recorded_streams import MAX_BACK_S, backward_steps, make_recording

TRUE = np.arange(0.0, 200.0, 0.2)
STAMPS = TRUE - 1.27 * (TRUE >= 60.0)


def sailed(time):
    """(N, 3) m/s in waves of five seconds."""
    return np.column_stack([1.0 + 0.2 * np.sin(1.25 * time), 0.1 * np.cos(1.25 * time), 0.05 * np.sin(0.9 * time)])


def test_what_was_stamped_twice_is_found_and_left_out():
    order = np.argsort(STAMPS)
    ((before, after, by),), once = backward_steps(STAMPS[order], sailed(TRUE)[order])
    assert before == pytest.approx(58.73, abs=0.2) and after == pytest.approx(59.8, abs=0.2)
    assert by == pytest.approx(1.27, abs=0.3)
    out = TRUE[order][~once]
    assert out.min() == pytest.approx(58.8, abs=0.3) and out.max() == pytest.approx(61.2, abs=0.3)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(TRUE), 1))
    mixed, claimed = (STAMPS[order], sailed(TRUE)[order]), np.full((len(TRUE), 3), 0.01)
    recording = make_recording("run", mixed, (TRUE, sailed(TRUE)), attitude=(TRUE, level), dvl_std=claimed)
    assert recording.backward_steps == ((before, after, by),) and recording.received == np.count_nonzero(once)
    assert not ((recording.dvl.time >= before) & (recording.dvl.time <= after)).any()


@pytest.mark.parametrize("by", [1.27, 1.23, 1.213])
def test_a_short_step_is_where_a_driver_threw_away_what_came_twice(by):
    """One that was shorter by a sixth was none: bins of a second had velocities of another second, and the leap was
    found six seconds late."""
    stamps = TRUE - by * (TRUE >= 60.0)
    kept = np.maximum.accumulate(np.append(-1.0, stamps[:-1])) < stamps
    events, once = backward_steps(stamps[kept], sailed(TRUE)[kept])
    assert [(each.before, each.by) for each in events] == [(pytest.approx(59.8), MAX_BACK_S)] and once.all()


def test_of_two_samples_that_are_stamped_as_one_and_measured_a_second_apart_one_is_kept():
    """A curve through both rang by metres a second: of what that made of noise a second leap was told, of 0.24 s."""
    stamps = TRUE - 1.199 * (TRUE >= 60.0)
    kept = np.maximum.accumulate(np.append(-1.0, stamps[:-1])) < stamps
    dvl = stamps[kept], sailed(TRUE)[kept]
    ((before, after, _),), once = backward_steps(*dvl)
    assert after - before == pytest.approx(0.001) and np.count_nonzero(~once) == 1
    recording = make_recording("run", dvl, (TRUE, sailed(TRUE)), dvl_std=np.full((len(once), 3), 0.01))
    assert np.diff(recording.dvl.time).min() > 0.1
    assert np.abs(recording.dvl(np.arange(50.0, 70.0, 0.01))).max() < 1.3


@pytest.mark.parametrize(
    "time",
    [
        np.concatenate([TRUE[:300], np.arange(60.0, 80.0, 0.1), TRUE[400:]]),
        TRUE + np.random.default_rng(3).normal(0.0, 0.03, len(TRUE)),
        np.delete(TRUE, slice(300, 310)),
        TRUE[:10],
    ],
    ids=["pings faster for a while", "jitter", "lost samples", "next to nothing"],
)
def test_no_clock_is_set_back_where(time):
    events, once = backward_steps(time, sailed(time))
    assert events == () and once.all()


def test_a_dvl_that_pings_faster_and_is_noisier_for_a_minute_loses_nothing():
    time = np.concatenate([TRUE[:300], np.arange(60.0, 100.0, 0.1), TRUE[500:]])
    noise = np.where((time >= 60.0) & (time < 100.0), 0.1, 0.01)[:, None] * np.random.default_rng(2).normal(
        size=(len(time), 3)
    )
    events, once = backward_steps(time, sailed(time) + noise)
    assert events == () and once.all()


def test_samples_that_are_mixed_and_alike_stay():
    time = np.sort(STAMPS)
    noise = np.random.default_rng(1).normal(0.0, 0.01, (len(time), 3))
    events, once = backward_steps(time, 1.0 + noise)
    assert events == () and once.all()
