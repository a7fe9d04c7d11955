"""What commands write with --json is as docs/json_schema.json says: keys that users read stay."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import jsonschema
import pytest
from conftest import ROOT
from report_fixtures import comparison, cross_checked, diagnosis, evaluation

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.comparison.mounting_change import comparison_document
from dvl_calib_ros.diagnosis.answer.results import diagnosis_document
from dvl_calib_ros.disk.text_files import write_json
from dvl_calib_ros.evaluation.cross_check import cross_check_document
from dvl_calib_ros.evaluation.documents import evaluation_document

SCHEMA = json.loads((ROOT / "docs" / "json_schema.json").read_text())
DOCUMENTS: dict[str, Callable[[], Any]] = {
    "compare": lambda: comparison_document(comparison("it")),
    "diagnose": lambda: diagnosis_document(diagnosis()),
    "evaluate": lambda: evaluation_document(evaluation(published={"E1": {"M1": 0.03}, "E2": {"M1": 0.03}})),
    "evaluate_bags": lambda: cross_check_document(cross_checked("it")),
}


def errors(name: str, document: Any) -> list[str]:
    """What a document lacks or has otherwise than the schema says, and what it has beyond the keys there."""
    validator = jsonschema.Draft202012Validator(SCHEMA | {"$ref": f"#/$defs/{name}"})
    found = [f"{list(each.path)}: {each.message}" for each in validator.iter_errors(document)]
    beyond = document.keys() - SCHEMA["$defs"][name]["properties"].keys()
    return found + [f"{key}: not in the schema" for key in sorted(beyond)]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_result_is_written_as_the_schema_says(name, tmp_path):
    write_json(tmp_path / "out.json", DOCUMENTS[name]())
    assert errors(name, json.loads((tmp_path / "out.json").read_text())) == []


def test_an_examination_is_written_as_the_schema_says():
    examined = dc.doctor(ROOT / "bags" / "straight_leg")
    assert examined.findings and errors("doctor", json.loads(json.dumps(examined.document()))) == []


@pytest.mark.parametrize("bag", ["harbour_box", "straight_leg"])
def test_a_replay_is_written_as_the_schema_says(bag):
    """The golden answers, which are compared with what is written now in test_shipped_bags."""
    golden = json.loads((ROOT / "bags" / "golden" / f"{bag}.json").read_text())
    assert errors("replay", golden) == []
    for key in golden:
        without = copy.copy(golden)
        del without[key]
        assert errors("replay", without), key


def test_every_command_that_writes_json_has_its_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    described = {name: each.get("description", "") for name, each in SCHEMA["$defs"].items()}
    commands = {name.partition("_")[0] for name, words in described.items() if "--json" in words}
    assert commands == {"replay", "compare", "doctor", "diagnose", "evaluate"}
