"""Reasons: the tables of what is said, their calls throughout the package, and their page in the documentation."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import ROOT
from documentation import section

from dvl_calib_ros.verdict.kinds import Kind, Severity
from dvl_calib_ros.verdict.reasons import KINDS, TABLES, by_severity, finding, full, lookup, of_consequence


def test_a_finding_says_what_is_wrong_what_to_do_and_its_code():
    found = finding("DVL_DROPOUTS", count=3)
    assert str(found) == f"the DVL dropped out 3 times; {found.remedy} [DVL_DROPOUTS]"
    assert found.as_dict()["severity"] == "warning" and found.severity is Severity.WARNING


@pytest.mark.parametrize(("code", "given"), [("NO_SUCH_CODE", {}), ("DVL_DROPOUTS", {})])
def test_an_unknown_code_or_a_missing_field_is_an_error_of_the_program(code, given):
    with pytest.raises(KeyError):
        finding(code, **given)


@pytest.mark.parametrize("code", ["lower_case", "WITH SPACE", ""])
def test_a_code_is_one_word_in_capitals(code):
    with pytest.raises(ValueError, match="code"):
        Kind(code, "a", "b", "c")


@pytest.mark.parametrize("name", TABLES)
def test_the_troubleshooting_page_has_the_tables(name):
    assert section(name) == lookup(TABLES[name]).strip(), "take it from: python -m validation figures --render"


def test_no_code_stands_in_two_tables():
    codes = [kind.code for kinds in TABLES.values() for kind in kinds]
    assert len(codes) == len(set(codes)) == len(KINDS) > 80


def test_the_page_that_says_more_is_there_with_its_heading():
    for page, _, anchor in {kind.page.partition("#") for kind in KINDS.values()}:
        headings = [
            line.lstrip("# ").lower() for line in (ROOT / "docs" / page).read_text().splitlines() if line[:1] == "#"
        ]
        assert anchor in {"-".join(heading.split()) for heading in headings}, (page, anchor)


def test_json_has_the_numbers_as_numbers():
    found = finding("CLOCK_OR_ARM", metres=np.float64(0.25), degrees=1.0, seconds=0.5).as_dict()
    assert json.loads(json.dumps(found))["numbers"] == {"metres": 0.25, "degrees": 1.0, "seconds": 0.5}
    assert found["page"] == "troubleshooting.md#all-warnings"
    assert finding("RESULT_NOT_SAVED", reason=OSError("disk full")).as_dict()["numbers"] == {"reason": "disk full"}


def test_the_worst_comes_first_and_of_equal_ones_the_first():
    several = [
        finding("DVL_DROPOUTS", count=1),
        finding("GNSS_LOSSES", count=2),
        finding("DOCTOR_UNITS", factor=3.0, guess=""),
    ]
    assert [each.code for each in by_severity(several)] == ["DOCTOR_UNITS", "DVL_DROPOUTS", "GNSS_LOSSES"]
    assert by_severity([several[0], several[1].weighed(Severity.REJECT)])[0].code == "GNSS_LOSSES"


def test_a_reason_that_holds_another_says_its_sentence_and_gives_both_codes():
    late = finding("CLOCK_LATE", whose="the IMU's", seconds=0.5, way="late", parameter="imu_time_offset", offset=0.5)
    found = finding("CONFIGURATION_WRONG", says=late)
    assert late.sentence in found.says and found.causes == (late,)
    written = json.loads(json.dumps(found.as_dict()))
    assert written["numbers"] == {"says": late.sentence}
    assert [each["code"] for each in written["causes"]] == ["CLOCK_LATE"]
    assert written["causes"][0]["numbers"]["offset"] == 0.5


def test_of_an_accepted_calibration_ambiguities_within_the_target_are_no_warnings():
    """One of 0.0 degrees was, and a deviation of 0.3 ± 0.2 degrees."""
    heading = {"course": "with time", "most": 0.3, "most_at": 0.0, "least": -0.3, "least_at": 90.0, "first": ""}
    said = [
        finding("CLOCK_ON_TURN", degrees=0.04),
        finding("CLOCK_ON_TURN", degrees=0.6),
        finding("CLOCK_OR_ARM", metres=0.1, degrees=0.004, seconds=0.1),
        finding("HEADING_DEVIATION", rms=0.3, std=0.2, cost=5.2, **heading),
        finding("HEADING_DEVIATION", rms=0.3, std=0.1, cost=5.2, **heading),
        finding("HEADING_DEVIATION", rms=0.3, std=0.2, cost=5.2, **heading).weighed(Severity.MARGINAL),
        finding("ONE_SPEED", off=0.02, degrees=0.8, percent=1.4),
        finding("IMU_LEVEL"),
    ]
    kept = of_consequence(said, 2.0)
    assert [said.index(each) for each in kept] == [1, 4, 5, 7]


@pytest.mark.parametrize(
    ("sentence", "said"),
    [
        ("bags/short_00: empty", "bags/short_00: empty."),
        ("short_00: empty", "short_00: empty."),
        ("/dvl: empty", "/dvl: empty."),
        ("the DVL's z is negated", "The DVL's z is negated."),
        ("doctor: is it on?", "Doctor: is it on?"),
    ],
)
def test_a_sentence_begins_with_a_capital_unless_with_a_name(sentence, said):
    assert full(sentence) == said
