"""`doctor`, `replay` and `diagnose` give one answer: no contradicting verdicts, and one first cause of a rejection."""

from __future__ import annotations

import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from situations import ask_once, contradicts

import dvl_calib_ros as dc
from dvl_calib_ros.diagnosis import diagnose
from dvl_calib_ros.diagnosis.answer.results import Diagnosis, DiagnosisVerdict
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.verdict.reasons import is_cause
from validation.stacks import shared_folder

CASES = shared_folder() / "cases"
# Variants, by the arguments of their scripts; of the others the first. These have no bag or no messages of a DVL.
VARIANTS = {
    "antenna_on_mast_positions": ("2.2 10",),
    "driver_signs": ("pmp 0.3",),
    "dvl_in_earth_axes": ("level enu",),
    "imu_orientation_wrong": ("zeros",),
    "ins_odometry_axes": ("ned",),
    "pd0_alignment": ("declination",),
}
# Situations of test_situations.py and test_frame_choice.py, which ask doctor and replay, too
ELSEWHERE = (
    "covariance_not_meant", "dvl_clock_far", "fixes_before_and_after", "moving_bed", "reference_fused_from_dvl",
    "stack_z_down", "tank_with_mocap", "wrong_transform_without_reference", "yaw_sign_135", "z_flipped",
)  # fmt: skip
# First cause of a rejection, '' for a usable recording.
CAUSES = {
    "antenna_on_mast_positions 2.2 10": "", "fix_ddmm": "DOCTOR_UNITS",
    "pd0_alignment declination": "MOUNTING_CONTRADICTED", "velocity_turned_90": "", "z_half": "DVL_AXIS_SCALED",
}  # fmt: skip
NO_DVL = "ros1_recordings", "simulated_time", "team_dvl_types"
SCRIPTS = [*sorted(CASES.glob("axes/*.py")), *sorted(CASES.glob("public/*.py"))]
SHARED = [
    (each, words)
    for each in SCRIPTS
    if each.stem not in (*NO_DVL, *ELSEWHERE)
    for words in VARIANTS.get(each.stem, ("",))
]
GAPS = sorted(CASES.glob("gap/*/a"))
TRAPS = sorted(each for each in CASES.glob("traps/*.py") if each.stem not in ("helpers", "judge", "phys"))
BAGS = ".mcap", ".db3", ".bag"
# A diagnosis that names an effect; the real one takes minutes, and what it begins with is the calibration's.
NAMED = Diagnosis(DiagnosisVerdict.AMBIGUOUS, (), None, (), (), (), {}, {}, (), ())
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not SCRIPTS, reason=f"no cases in {CASES}; name their folder's parent in DVL_CALIB_SHARED"),
]


def assert_one_answer(bag: Path, monkeypatch: pytest.MonkeyPatch, **parameters: Any) -> str:
    """Ask all three, and return the code of the first cause of a rejection. A refusal is a no."""
    ask_once(monkeypatch)
    monkeypatch.setattr(diagnose, "diagnose", lambda *_: NAMED)
    try:
        examined = dc.doctor(bag, **parameters)
    except InputError:
        with pytest.raises(InputError):
            dc.replay(bag, history=False, **parameters)
        return "refused"
    try:
        calibration = dc.replay(bag, history=False, **parameters)
    except InputError as error:
        assert examined.verdict == "no" and examined.cannot in str(error)
        return "refused"
    first, *_ = calibration.replayed.result.verifications[calibration.model].reasons
    assert not contradicts(examined.verdict, calibration.verdict), first
    if calibration.verdict != "reject":
        return ""
    if is_cause(first):
        assert examined.why in ("", first.full_sentence)  # nothing of a missing IMU, which is said before
        assert examined.reasons[0].sentence == first.sentence
        (cause,) = dc.diagnose(bag, **parameters).reasons[0].causes
        assert cause.sentence == first.sentence
    return next(iter(first.causes), first).code


@pytest.mark.parametrize(("script", "words"), SHARED, ids=lambda each: each.stem if isinstance(each, Path) else each)
def test_a_shared_case_has_one_answer(script, words, tmp_path, monkeypatch):
    made = tmp_path / script.stem
    monkeypatch.setattr(sys, "argv", [str(script), str(made), *words.split()])
    runpy.run_path(str(script), run_name="__main__")
    bags = sorted({each.parent for each in made.rglob("*") if each.suffix in BAGS})
    if not bags:
        (log,) = made.iterdir()
        bags = [*dc.import_files(log, output=tmp_path / "imported")]
    cause, case = assert_one_answer(bags[0], monkeypatch), f"{script.stem} {words}".strip()
    assert cause == CAUSES.get(case, cause)


@pytest.mark.parametrize("bag", GAPS, ids=lambda bag: bag.parent.name)
def test_a_recording_of_the_trial_has_one_answer(bag, monkeypatch):
    assert_one_answer(bag, monkeypatch)


class JudgedError(Exception):
    """The first trap of a file was judged: the others are not built."""


@pytest.mark.parametrize("script", TRAPS, ids=lambda script: script.stem)
def test_the_first_trap_of_a_file_has_one_answer(script, tmp_path, monkeypatch):
    """The traps of a file are judged as it is run, by a function of the module `judge`."""
    monkeypatch.syspath_prepend(str(script.parent))
    monkeypatch.setattr(sys, "argv", [str(script)])
    import judge

    written = judge.write

    def ask(name: str, streams: Any, bags: Callable[[], Path] | None = None, quiet: bool = False, **given: Any) -> None:
        bag = bags() if bags else written(tmp_path / "bag", streams)
        assert_one_answer(bag, monkeypatch, **given)
        shutil.rmtree(bag)
        raise JudgedError

    monkeypatch.setattr(
        judge, "write", lambda path, streams, **more: lambda: written(tmp_path / "bag", streams, **more)
    )
    monkeypatch.setattr(judge, "judge", ask)
    with pytest.raises(JudgedError):
        runpy.run_path(str(script))
