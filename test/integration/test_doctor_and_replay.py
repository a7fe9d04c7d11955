"""`doctor` never says yes where `replay` rejects, nor no where `replay` is usable."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from situations import contradicts

import dvl_calib_ros as dc
from dvl_calib_ros.errors import InputError
from validation.stacks import shared_folder

CASES = shared_folder() / "cases"
# Faults that test_situations.py and test_stacks.py judge by this rule, or that another case here has, and formats.
ELSEWHERE = {
    "covariance_not_meant", "driver_signs", "dvl_clock_far", "imu_orientation_wrong", "instrument_text_logs",
    "moving_bed", "pd0_alignment", "reference_fused_from_dvl", "wrong_transform_without_reference",
    "beams_rotated", "yaw_sign_135", "z_flipped", "noref_swapped", "ros1_recordings", "simulated_time",
    "team_dvl_types",
}  # fmt: skip
SCRIPTS = [*sorted(CASES.glob("axes/*.py")), *sorted(CASES.glob("public/*.py"))]
SCRIPTS = [each for each in SCRIPTS if each.stem not in ELSEWHERE]
TRAPS = sorted(each for each in CASES.glob("traps/*.py") if each.stem not in ("helpers", "judge", "phys"))
BAGS = ".mcap", ".db3", ".bag"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SCRIPTS, reason=f"no cases in {CASES}; name their folder's parent in DVL_CALIB_SHARED"),
]


def answers(bag: Path, **parameters: Any) -> tuple[str, str]:
    """Return the verdicts of doctor and replay; a refusal is a no."""
    return (
        answer(lambda: dc.doctor(bag, **parameters).verdict, "no"),
        answer(lambda: dc.replay(bag, history=False, **parameters).verdict, "reject"),
    )


def answer(ask: Callable[[], str], refused: str) -> str:
    try:
        return str(ask())
    except InputError:
        return refused


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_doctor_and_replay_agree_on_a_shared_case(script, tmp_path):
    made = tmp_path / script.stem
    subprocess.run([sys.executable, script, made], check=True, capture_output=True)
    bags = sorted({each.parent for each in made.rglob("*") if each.suffix in BAGS})
    if not bags:
        (log,) = made.iterdir()
        bags = [*dc.import_files(log, output=tmp_path / "imported")]
    doctor, replay = answers(bags[0])
    assert not contradicts(doctor, replay), (doctor, replay)


class JudgedError(Exception):
    """The first trap of a file was judged: the others are not built."""


@pytest.mark.parametrize("script", TRAPS, ids=lambda script: script.stem)
def test_doctor_and_replay_agree_on_the_first_trap_of_a_file(script, tmp_path, monkeypatch):
    """The traps of a file are judged as it is run, by a function of the module `judge`."""
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script)])
    import judge

    said = []
    written = judge.write

    def ask(name: str, streams: Any, bags: Callable[[], Path] | None = None, quiet: bool = False, **given: Any) -> None:
        bag = bags() if bags else written(tmp_path / "bag", streams)
        said.append(answers(bag, **given))
        shutil.rmtree(bag)
        raise JudgedError

    monkeypatch.setattr(
        judge, "write", lambda path, streams, **more: lambda: written(tmp_path / "bag", streams, **more)
    )
    monkeypatch.setattr(judge, "judge", ask)
    with pytest.raises(JudgedError):
        runpy.run_path(str(script))
    assert said and not contradicts(*said[0]), said
