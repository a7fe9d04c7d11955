"""What a diagnosis reads of recordings before it looks at them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.diagnosis.model.recorded_streams import load_recordings, make_recording, recording_names
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["T01", "T03"], ["T01", "T03"]),
        (["a/run.mcap", "a/other.db3.zstd"], ["run", "other"]),
        (["run.2024", "run.2025"], ["run.2024", "run.2025"]),
        (["monday/run", "tuesday/run.mcap", "tuesday/last"], ["monday-run", "tuesday-run", "last"]),
        (["a/day/run", "b/day/run"], ["day-run-1", "day-run-2"]),
    ],
)
def test_every_recording_has_a_name_of_its_own(paths, names):
    assert recording_names([Path(path) for path in paths]) == names


def test_turn_rates_are_without_the_noise_of_frequencies_that_hold_no_motion():
    """Rates of an attitude that is read to 0.05°, 20 times a second: noise of 1.4°/s over waves of 1°/s."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 400.0, 0.05)
    waves = np.cumsum([0.02 * np.sin(2.0 * np.pi * f * time + f) for f in (0.13, 0.21, 0.34)], axis=0)[-1]
    true = np.column_stack([0.5 * waves, 0.3 * waves, 0.1 * np.sin(0.05 * time)])
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    noise = np.gradient(rng.normal(0.0, np.deg2rad(0.05), true.shape), time, axis=0) * 2.0
    velocity = (time[::4], rng.normal((1.0, 0.0, 0.0), 0.01, (len(time[::4]), 3)))
    recording = make_recording("run", velocity, velocity, attitude=(time, level), rates=(time, true + noise))
    inside = slice(20, -20)
    used = recording.angular_velocity(time)[inside]
    share = (used * true[inside]).sum(axis=0) / (used**2).sum(axis=0)
    as_measured = ((true + noise) * true).sum(axis=0) / ((true + noise) ** 2).sum(axis=0)
    np.testing.assert_allclose(share, 1.0, atol=0.03)
    assert (as_measured[:2] < 0.5).all()


def test_messages_that_nobody_asks_for_again_are_let_go_of_and_the_samples_are_the_same():
    """Those of five hours at 50 Hz stood beside a diagnosis with 250 MB."""
    path = ROOT / "bags" / "harbour_box"
    opened = open_recording([path])
    (kept,) = load_recordings(opened, Parameters(), Topics()).recordings
    assert opened.columns
    (let_go,) = load_recordings(opened, Parameters(), Topics(), forget=True).recordings
    assert not opened.columns
    for name in ("dvl", "reference", "attitude", "rates"):
        one, other = getattr(kept, name), getattr(let_go, name)
        np.testing.assert_array_equal(one.time, other.time)
        np.testing.assert_array_equal(one.values, other.values)
