"""What the remedy of a reason says to type is done, and improves the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from conftest import ROOT
from io_fixtures import write_bag
from remedies import causes, changes, is_typed, options
from runs import shifted
from scipy.spatial.transform import Rotation
from situations import SITUATIONS, long_motion, sound
from stacks import IMU, Told
from test_wrong_configurations import WRONG, run

import dvl_calib_ros as dc
from dvl_calib_ros.bag_replay.replay import replay
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.samples import ImuSample, ReferenceSample
from dvl_calib_ros.calibration.results.results import Result
from dvl_calib_ros.verdict.kinds import Severity
from dvl_calib_ros.verdict.reasons import KINDS, finding

BETTER = Severity.REJECT, Severity.MARGINAL, Severity.ACCEPT


class Case(NamedTuple):
    """A recording with its fault. given: parameters. is_discovered: as `dvl-calib replay` does, else as the node."""

    write: Callable[[Path], Path]
    given: dict[str, Any]
    is_discovered: bool = False


def of_wrong(name: str) -> Case:
    samples, given, _ = WRONG[name]
    return Case(lambda path: write_bag(path, samples()), given)


def late(**seconds: float) -> Case:
    """Clocks that are late."""
    kinds = {"reference": ReferenceSample, "imu": ImuSample}

    def write(path: Path) -> Path:
        moved = [each for each in run() if not isinstance(each, tuple(kinds[name] for name in seconds))]
        for name, value in seconds.items():
            moved += shifted([each for each in run() if isinstance(each, kinds[name])], round(1e9 * value))
        return write_bag(path, sorted(moved, key=lambda each: each.stamp_ns))

    return Case(write, {})


def with_nothing_wrong(path: Path) -> Path:
    told = Told(motion=long_motion())
    sound(told)
    return told.write(path)


def without_declination(degrees: float) -> Case:
    """A compass that gives magnetic headings."""
    east = Rotation.from_euler("z", -degrees, degrees=True)

    def write(path: Path) -> Path:
        told = Told()
        sound(told)
        for _, _, kind, message in told.rows:
            if kind == IMU:
                q = message.orientation
                q.x, q.y, q.z, q.w = (east * Rotation.from_quat([q.x, q.y, q.z, q.w])).as_quat().tolist()
        return told.write(path)

    return Case(write, {}, is_discovered=True)


CASES = {
    ("MOUNTING_FITS", "yaw off by 45 degrees"): of_wrong("yaw off by 45 degrees"),
    ("DVL_AXES_TURNED", "axes by the messages"): of_wrong("z flipped"),
    ("DVL_AXES_TURNED", "axes given"): of_wrong("z flipped")._replace(given={"dvl_axes": "flu"}),
    ("REFERENCE_LOOKS", "ENU, body claimed"): of_wrong("ENU, body claimed"),
    ("REFERENCE_LOOKS", "NED, body claimed"): of_wrong("NED, body claimed"),
    ("IMU_LOOKS_NED", "IMU in NED"): of_wrong("IMU in NED"),
    ("IMU_LOOKS_NED", "IMU in ENU, NED given"): Case(
        lambda path: write_bag(path, run()), {"imu_frame": "ned", "imu_rpy": (math.pi, 0.0, 0.0)}
    ),
    ("CLOCK_LATE", "IMU"): late(imu=1.0),
    ("CLOCK_LATE", "reference"): late(reference=1.0),
    ("CLOCK_LATE", "offset of the reference given"): Case(
        with_nothing_wrong, {"reference_time_offset": 1.0}, is_discovered=True
    ),
    ("CLOCK_LATE", "offset given"): Case(with_nothing_wrong, {"imu_time_offset": 1.0}, is_discovered=True),
    ("CLOCKS_LATE", "reference and DVL"): late(reference=0.6)._replace(given={"dvl_time_offset": 0.5}),
    ("CLOCK_DRIFTS_DVL", "drift given"): Case(with_nothing_wrong, {"dvl_clock_drift": 0.009}, is_discovered=True),
    ("MOUNTING_CONTRADICTED", "declination of 14 degrees"): without_declination(14.0),
    ("MOUNTING_CONTRADICTED", "declination of -60 degrees"): without_declination(-60.0),
}
# codes whose remedy another module executes
ELSEWHERE = {
    "DVL_SIDE_INVERTED": "unit/discovery/test_axis_signs.py",
    "GRAVITY_UPSIDE_DOWN": "unit/node/test_gravity_seen.py",
}


def judged(bag: Path, case: Case, **parameters: Any) -> Result:
    if case.is_discovered:
        return dc.replay(bag, history=False, **{**case.given, **parameters}).replayed.result
    return replay([bag], Parameters(**{**case.given, **parameters})).result


@pytest.mark.spread(4)
@pytest.mark.parametrize(("code", "name"), CASES)
def test_the_options_of_a_remedy_improve_the_verdict_and_set_something_new(code, name, tmp_path):
    case = CASES[code, name]
    bag = case.write(tmp_path / "bag")
    found = judged(bag, case)
    verification = found.verifications[found.selected]
    remedies = [each.remedy for each in causes(verification.reasons) if each.code == code]
    assert remedies, verification.reasons
    mended = judged(bag, case, **changes(remedies[0], Parameters.from_mapping(found.parameters)))
    after = mended.verifications[mended.selected]
    assert code not in [each.code for each in causes(after.reasons)]
    assert BETTER.index(after.verdict) > BETTER.index(verification.verdict), after.reasons


def test_every_remedy_that_can_be_typed_is_executed():
    typed = {code for code, kind in KINDS.items() if is_typed(kind) and kind.severity in BETTER}
    executed = {code for code, _ in CASES} | {each.cause for each in SITUATIONS.values()} | ELSEWHERE.keys()
    assert typed - executed == set()
    for code, module in ELSEWHERE.items():
        text = (ROOT / "test" / module).read_text()
        assert code in text and "changes(" in text


def test_a_remedy_that_names_what_is_set_is_a_fault():
    remedy = finding("CLOCK_LATE", whose="", seconds=1.0, way="", parameter="imu_time_offset", offset=1.0).remedy
    assert changes(remedy, Parameters()) == options(remedy) == {"imu_time_offset": 1.0}
    with pytest.raises(AssertionError, match="already set"):
        changes(remedy, Parameters(imu_time_offset=1.0))
