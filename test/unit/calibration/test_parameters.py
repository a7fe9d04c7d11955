"""One schema: what it checks, and that all that is derived from it is up to date."""

from __future__ import annotations

import pytest
from conftest import ROOT
from documentation import section

from dvl_calib_ros.calibration.models.parameters import SCHEMA, ParameterError, Parameters
from dvl_calib_ros.files.parameter_files import load_parameters, model_table, parameter_file_text, parameter_table

# interfaces.md, "Parameters that scripts rely on by name"
CONTRACT = {
    "model": "auto", "gnss_model": "M3", "gnss_free_model": "M7", "gnss_timeout": 2.0, "gnss_hysteresis": 3.0,
    "gnss_frame": "from_frame_id", "mounting_rpy": (0, 0, 0), "lever_arm": (0, 0, 0), "dvl_time_offset": 0.0,
    "initial_std_misalignment": 0.05, "initial_std_scale": 0.006, "process_std_misalignment": 0.0,
    "process_std_scale": 0.0, "use_message_covariance": True, "gnss_aided_std": 0.2, "gnss_free_std": 0.025,
    "prior_source": "fixed", "prior_window": 2.0, "prior_sway_heave": (0, 0), "gate_probability": 0.999,
    "min_speed": 0.3, "max_turn_rate": 0.0,
    "result_file": "", "initial_calibration": "",
}  # fmt: skip


def test_names_and_defaults_are_those_that_scripts_rely_on():
    parameters = Parameters()
    assert {name: getattr(parameters, name) for name in CONTRACT} == CONTRACT


@pytest.mark.parametrize(
    "values, said",
    [
        ({"gnss_timout": 1.0}, "gnss_timout: no such parameter, did you mean 'gnss_timeout'?"),
        ({"gnss_timeout": -1.0}, "gnss_timeout: -1 is outside 0.05 .. 60 s"),
        ({"gnss_timeout": float("nan")}, "gnss_timeout: nan is not finite"),
        ({"gnss_timeout": "2"}, "gnss_timeout: expected a number"),
        ({"gnss_timeout": True}, "gnss_timeout: expected a number"),
        ({"model": "M8"}, "model: 'M8' is not one of auto, iac, M1"),
        ({"model": 3}, "model: expected text"),
        ({"gnss_model": "M7"}, "gnss_model: 'M7' is not one of M3"),
        ({"gnss_free_model": "M3"}, "gnss_free_model: 'M3' is not one of M5"),
        ({"mounting_rpy": [0.0, 0.0]}, "mounting_rpy: expected an array of 3 numbers"),
        ({"mounting_rpy": "000"}, "mounting_rpy: expected an array of 3 numbers"),
        ({"lever_arm": [0.0, 1e9, 0.0]}, r"lever_arm\[1\]: 1e\+09 is outside -100 .. 100 m"),
        ({"use_message_covariance": 1}, "use_message_covariance: expected true or false"),
    ],
)
def test_a_bad_value_is_named_with_what_would_do(values, said):
    with pytest.raises(ParameterError, match=said):
        Parameters.from_mapping(values)


def test_whole_numbers_are_taken_where_doubles_are_meant():
    parameters = Parameters.from_mapping({"gnss_timeout": 3, "lever_arm": [1, 0, -2]})
    assert (parameters.gnss_timeout, parameters.lever_arm) == (3.0, (1.0, 0.0, -2.0))


def test_every_parameter_has_a_description_and_every_number_a_range():
    for name, spec in SCHEMA.items():
        assert spec.description.endswith((".", "...", "(0.1°) ...")), name
        if spec.kind.startswith("double"):
            assert spec.low is not None and spec.high is not None, name
            values = spec.default if isinstance(spec.default, tuple) else [spec.default]
            assert all(spec.low <= value <= spec.high for value in values), name


def test_the_shipped_parameter_file_is_the_schema():
    path = ROOT / "config" / "calibration.yaml"
    assert path.read_text() == parameter_file_text(), (
        "write it anew: dvl-calib parameters --yaml > config/calibration.yaml"
    )
    assert load_parameters(path) == Parameters()


def test_the_readme_lists_the_parameters_of_the_schema():
    assert section("parameters") == parameter_table().strip(), "take it from: dvl-calib parameters"


def test_the_readme_says_of_every_model_what_it_assumes_and_when_it_is_wrong():
    assert section("models") == model_table().strip(), "take it from: dvl-calib parameters --models"
