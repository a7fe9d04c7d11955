"""What a diagnosis reads of recordings before it looks at them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvl_calib_ros.diagnosis.recordings import make_recording, recording_names


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
    """Rates of an attitude that is read to 0.05°, 20 times a second: noise of 1.4°/s over waves of 1°/s. Noise in a
    regressor makes a lever arm of 2 m one of 0.7 m."""
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
