"""What a diagnosis reads of recordings before it looks at them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dvl_calib_ros.diagnosis.recordings import recording_names


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
