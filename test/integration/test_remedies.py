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
from situations import DVL, REFERENCE, SITUATIONS, long_motion, sound
from stacks import IMU, START_NS, Told
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


def with_fault(
    path: Path, topic: str, change: Callable[[Any, float], None], from_s: float = 0.0, to_s: float = math.inf
) -> Path:
    """Write a part of a recording whose messages on a topic are changed."""
    told = Told(motion=long_motion())
    sound(told)
    for at_ns, name, _, message in told.rows:
        if name == topic:
            change(message, 1e-9 * (at_ns - START_NS))
    told.rows = [row for row in told.rows if from_s <= 1e-9 * (row[0] - START_NS) < to_s]
    return told.write(path)


def with_nothing_wrong(path: Path) -> Path:
    return with_fault(path, "", lambda *_: None)


def without_declination(degrees: float) -> Case:
    """A compass that gives magnetic headings."""
    east = Rotation.from_euler("z", -degrees, degrees=True)

    def write(path: Path) -> Path:
        told = Told()
        sound(told)
        for message in told.said(IMU):
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


def rounded(message: Any, seconds: float) -> None:
    v = message.twist.twist.linear
    v.x, v.y, v.z = (0.2 * round(5.0 * each) for each in (v.x, v.y, v.z))


def dead(message: Any, seconds: float) -> None:
    message.twist.twist.linear.y = 0.0


def of_another_dvl(message: Any, seconds: float) -> None:
    if round(5.0 * seconds) % 2:
        v = message.twist.twist.linear
        v.x, v.y, v.z = 0.5 * v.x, 0.5 * v.y, 0.5 * v.z


def in_frame(name: str) -> Callable[[Any, float], None]:
    def change(message: Any, seconds: float) -> None:
        message.header.frame_id = name

    return change


def times(field: str, factor: float) -> Callable[[Any, float], None]:
    def change(message: Any, seconds: float) -> None:
        v = getattr(message, field)
        v.x, v.y, v.z = factor * v.x, factor * v.y, factor * v.z

    return change


def stamped(drift: float = 0.0, step_s: float = 0.0) -> Callable[[Any, float], None]:
    def change(message: Any, seconds: float) -> None:
        stamp = message.header.stamp
        late_ns = round(1e9 * (drift * seconds + step_s * (seconds > 200.0)))
        stamp.sec, stamp.nanosec = divmod(10**9 * stamp.sec + stamp.nanosec + late_ns, 10**9)

    return change


# faults of a driver or a clock that a person mends: topic, and the change of its messages by time (s)
FAULTS = {
    "DVL_ROUNDED": (DVL, rounded),
    "DVL_AXIS_DEAD": (DVL, dead),
    "DVL_TWO_ON_TOPIC": (DVL, of_another_dvl),
    "DVL_FRAME_NOT_OWN": (DVL, in_frame("map")),
    "REFERENCE_FRAME_OTHER": (REFERENCE, in_frame("ned")),
    "IMU_NO_RATES": ("/imu/data", times("angular_velocity", 0.0)),
    "IMU_CONTRADICTS": ("/imu/data", times("angular_velocity", -1.0)),
    "GRAVITY_SIGN": ("/imu/data", times("linear_acceleration", -1.0)),
    "GRAVITY_IN_G": ("/imu/data", times("linear_acceleration", 1.0 / 9.81)),
    "GRAVITY_SIZE": ("/imu/data", times("linear_acceleration", 0.5)),
    "CLOCK_DRIFTS": (REFERENCE, stamped(drift=5e-3)),
    "CLOCK_LEAPS": (REFERENCE, stamped(step_s=1.0)),
}
# codes whose remedy another module executes
ELSEWHERE = {
    "DVL_SIDE_INVERTED": "unit/discovery/test_axis_signs.py",
    "DVL_SIGN_OPEN": "unit/discovery/test_axis_signs.py",
    "GRAVITY_UPSIDE_DOWN": "unit/node/test_gravity_seen.py",
    "BAGS_OVERLAP": "integration/test_several_bags.py",
    "FRAMES_AMBIGUOUS": "integration/test_frame_choice.py",
    "LEVER_ARM_NOT_SHOWN": "unit/calibration/test_full.py",
    "LEVER_ARM_TURNS_ANGLE": "unit/calibration/test_full.py",
}
# codes whose remedy no test executes: more data, another instrument, a question, or a pointer to a command
OPEN = {
    "BAGS_DELAY_CHANGED", "BODY_OR_EARTH", "CLOCKS_NOT_TOLD_APART", "DELAY_CHANGED", "DRIFT_OPEN", "DRIFT_WORSE",
    "DVL_AXIS_SCALED", "GAP_REFERENCE_CONSTANT", "GAP_REFERENCE_VERTICAL", "GAP_TOO_SHORT",
    "HELD_OUT_SEVERAL_TIMES", "IMU_CONTRADICTS_EITHER", "MOUNTING_SUSPECTED", "MOUNTING_SUSPICIOUS",
    "NOTHING_COMPARED", "SCALE_CHANGED",
}  # fmt: skip


def judged(bag: Path, case: Case, **parameters: Any) -> Result:
    if case.is_discovered:
        return dc.replay(bag, history=False, **{**case.given, **parameters}).replayed.result
    return replay([bag], Parameters(**{**case.given, **parameters})).result


@pytest.mark.spread(2)
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


@pytest.fixture(scope="module")
def mended(tmp_path_factory) -> dc.Calibration:
    return dc.replay(with_nothing_wrong(tmp_path_factory.mktemp("mended") / "bag"), history=False)


def codes_of(calibration: dc.Calibration) -> set[str]:
    reasons = calibration.replayed.result.verifications[calibration.model].reasons
    return {each.code for each in causes([*reasons, *calibration.discovery.contradictions])}


@pytest.mark.spread(1)
@pytest.mark.parametrize("code", FAULTS)
def test_a_fault_that_is_named_and_mended_is_not_named_again(code, mended, tmp_path):
    found = dc.replay(with_fault(tmp_path / "bag", *FAULTS[code]), history=False)
    assert code in codes_of(found)
    assert found.verdict == ("accept" if "FRAME" in code or "GRAVITY" in code else "reject")
    if found.verdict == "accept":
        assert Severity.REJECT not in {each.severity for each in found.discovery.contradictions}
    assert mended.verdict == "accept" and code not in codes_of(mended)


@pytest.mark.slow
def test_either_part_of_a_recording_that_is_cut_at_a_step_of_a_clock_is_calibrated_with(tmp_path):
    bag = with_fault(tmp_path / "bag", *FAULTS["CLOCK_LEAPS"])
    (step,) = [each for each in dc.replay(bag, history=False).discovery.contradictions if each.code == "CLOCK_LEAPS"]
    at_s = step.numbers["at"]
    for name, part in (("before", {"to_s": at_s}), ("after", {"from_s": at_s})):
        calibration = dc.replay(with_fault(tmp_path / name, *FAULTS["CLOCK_LEAPS"], **part), history=False)
        assert "CLOCK_LEAPS" not in codes_of(calibration) and calibration.verdict != "reject", calibration.reasons


def test_every_remedy_is_executed_or_known_to_be_open():
    reasons = {code: kind for code, kind in KINDS.items() if kind.remedy and kind.severity in BETTER[:2]}
    typed = {code for code, kind in reasons.items() if is_typed(kind)}
    undone = {code for *_, code in WRONG.values()} | FAULTS.keys()
    executed = {code for code, _ in CASES} | {each.cause for each in SITUATIONS.values()} | ELSEWHERE.keys()
    assert typed - executed == set()
    assert reasons.keys() - executed - undone == OPEN
    for code, module in ELSEWHERE.items():
        text = (ROOT / "test" / module).read_text()
        assert code in text and (code not in typed or "changes(" in text)


def test_a_remedy_that_names_what_is_set_is_a_fault():
    remedy = finding("CLOCK_LATE", whose="", seconds=1.0, way="", parameter="imu_time_offset", offset=1.0).remedy
    assert changes(remedy, Parameters()) == options(remedy) == {"imu_time_offset": 1.0}
    with pytest.raises(AssertionError, match="already set"):
        changes(remedy, Parameters(imu_time_offset=1.0))
