"""Parameter files mean the same offline as to ROS 2, and what is wrong in one is named with file and parameter."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.calibration.models.parameters import SCHEMA, Parameters
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import (
    given_parameters,
    load_parameters,
    names_of_others,
    parameter_file_text,
    ros_override,
)


def file_with(folder: Path, text: str) -> Path:
    path = folder / "params.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "/**: {ros__parameters: {min_speed: 0.5}}",
        "/*: {ros__parameters: {min_speed: 0.5}}",
        "dvl_calibration: {ros__parameters: {min_speed: 0.5}}",
        "/dvl_calibration: {ros__parameters: {min_speed: 0.5}}",
        "/auv/dvl_calibration: {ros__parameters: {min_speed: 0.5}}",
        "/auv/*: {ros__parameters: {min_speed: 0.5}}",
        "/**/dvl_calibration: {ros__parameters: {min_speed: 0.5}}",
        "auv: {sensors: {dvl_calibration: {ros__parameters: {min_speed: 0.5}}}}",
        "other: {ros__parameters: {min_speed: 9, unknown: 1}}\n/**: {ros__parameters: {min_speed: 0.5}}",
        "/**: {ros__parameters: {min_speed: 2.0}}\ndvl_calibration: {ros__parameters: {min_speed: 0.5}}",
        "/**: {ros__parameters: {use_sim_time: true, qos_overrides: {/clock: {depth: 1}}, min_speed: 0.5}}",
        "/**: {ros__parameters: {min_speed: 5e-1}}",
        "/**:\n  ros__parameters:\n    min_speed: 5.0e-1\n",
    ],
)
def test_parameters_are_found_under_every_name_the_node_can_have(tmp_path, text):
    assert load_parameters(file_with(tmp_path, text)) == Parameters(min_speed=0.5)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("min_speed", "1", 1.0),
        ("lever_arm", "[1, 0, -2]", (1.0, 0.0, -2.0)),
        ("initial_std_scale", "1e-3", 0.001),
        ("initial_std_scale", "1E-3", 0.001),
        ("initial_std_scale", ".5e-2", 0.005),
        ("dvl_frame", "1:30", "1:30"),
        ("dvl_frame", "1_0", "1_0"),
        ("mounting_rpy", "[1e-3, -2e-1, +3e0]", (0.001, -0.2, 3.0)),
        ("use_message_covariance", "false", False),
        ("model", "M4", "M4"),
        ("base_frame", "2026-05-01", "2026-05-01"),
        ("result_file", "/data/a b.yaml", "/data/a b.yaml"),
        ("result_file", "''", ""),
    ],
)
def test_a_value_means_the_same_in_a_file_and_as_an_override(tmp_path, name, text, value):
    in_file = load_parameters(file_with(tmp_path, f"/**: {{ros__parameters: {{{name}: {text}}}}}"))
    overridden = load_parameters(None, [f"{name}:={text}"])
    assert getattr(in_file, name) == getattr(overridden, name) == value
    assert type(getattr(in_file, name)) is type(value)


@given(name=st.sampled_from([name for name, spec in SCHEMA.items() if spec.kind == "double"]), part=st.floats(0, 1))
def test_every_double_survives_being_written_as_text(name, part):
    spec = SCHEMA[name]
    value = min(max(spec.low + part * (spec.high - spec.low), spec.low), spec.high)
    assert getattr(load_parameters(None, [f"{name}:={value!r}"]), name) == value


WRONG = [
    ("{mim_speed: 1.0}", "mim_speed: no such parameter, did you mean 'min_speed'"),
    ("{min_speed: -1.0}", "min_speed: -1 is outside 0 .. 10 m/s"),
    ("{min_speed: .nan}", "min_speed: nan is not finite"),
    ("{min_speed: 1e999}", "min_speed: inf is not finite"),
    ("{min_speed: '0.5'}", "min_speed: expected a number, got '0.5'"),
    ("{min_speed: true}", "min_speed: expected a number"),
    ("{min_speed: [1.0]}", "min_speed: expected a number"),
    ("{min_speed: }", "min_speed: expected a number"),
    ("{use_message_covariance: 1}", "use_message_covariance: expected true or false"),
    ("{lever_arm: [1, 2]}", "lever_arm: expected an array of 3 numbers"),
    ("{lever_arm: 1.0}", "lever_arm: expected an array of 3 numbers"),
    ("{lever_arm: [1, 2, x]}", "lever_arm[2]: expected a number"),
    ("{mounting_rpy: [0, 0, 7]}", "mounting_rpy[2]: 7 is outside"),
    ("{model: M9}", "model: 'M9' is not one of auto, iac, M1"),
    ("{gnss_model: M7}", "gnss_model: 'M7' is not one of M3"),
    ("{model: 3}", "model: expected text"),
    ("[min_speed, 1]", "is not a list of name: value"),
    ("", "is not a list of name: value"),
    ("{min_speed: 1" + "0" * 400 + "}", "too large"),
    ("{min_speed: 1" + "0" * 5000 + "}", "not valid YAML"),
    ("{min_speed: [" + "[" * 3000 + "]}", "not valid YAML"),
    ("&a {min_speed: *a}", "without aliases"),
    ("{min_speed: !!python/object/apply:os.getcwd []}", "not valid YAML"),
]


@pytest.mark.parametrize(("parameters", "expected"), WRONG)
def test_what_is_wrong_in_a_file_is_said_with_the_name_of_file_and_parameter(tmp_path, parameters, expected):
    path = file_with(tmp_path, f"/**:\n  ros__parameters: {parameters}\n")
    with pytest.raises(InputError) as caught:
        load_parameters(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert expected in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "no ROS 2 parameter file"),
        (b"min_speed: 0.5\n", "no ros__parameters in it"),
        (b"format: dvl_calib_ros result 1\n", "it is a result file, which -p initial_calibration"),
        (b"- a\n- b\n", "no ROS 2 parameter file"),
        (b"/**: [\n  x: {\n", "not valid YAML"),
        (b"/**:\n\tros__parameters: 1\n", "not valid YAML"),
        (b"/**: {ros__parameters: {base_frame: \xff\xfe}}", "no ROS 2 parameter file, because it is not text"),
        (bytes(range(256)), "no ROS 2 parameter file"),
        (b"\x00\x01\x02", "not valid YAML"),
        (b"dvl_calibratoin: {ros__parameters: {min_speed: 0.5}}", "only for dvl_calibratoin"),
    ],
)
def test_a_file_that_is_no_parameter_file_is_refused_by_name(tmp_path, content, expected):
    (tmp_path / "x.yaml").write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_parameters(tmp_path / "x.yaml")
    assert str(caught.value).startswith(f"{tmp_path / 'x.yaml'}: ") and expected in str(caught.value)


@pytest.mark.parametrize("section", ["/**", "/*/*", "/auv/*", "/auv/**"])
def test_what_a_file_sets_for_all_nodes_and_is_not_ours_is_ignored_as_ros_does(tmp_path, section):
    names = "{min_speed: 0.5, frame_rate: 30, camera: {exposure: 0.1}, robot_description: '<robot/>'}"
    path = file_with(tmp_path, f"{section}: {{ros__parameters: {names}}}")
    assert load_parameters(path) == Parameters(min_speed=0.5)
    assert names_of_others(path, "/auv/dvl_calibration") == {"frame_rate", "camera.exposure", "robot_description"}


@pytest.mark.parametrize("section", ["dvl_calibration", "/auv/dvl_calibration", "/**/dvl_calibration"])
def test_what_a_file_sets_for_our_node_by_its_name_must_be_ours(tmp_path, section):
    path = file_with(tmp_path, f"/**: {{ros__parameters: {{rate: 1}}}}\n{section}: {{ros__parameters: {{rate: 2}}}}")
    with pytest.raises(InputError, match="rate: no such parameter"):
        load_parameters(path)
    assert names_of_others(path, "/auv/dvl_calibration") == (set() if "auv" in section or "*" in section else {"rate"})


@given(name=st.sampled_from(list(SCHEMA)), data=st.data())
def test_one_of_ours_with_a_letter_too_few_is_never_taken_for_another_nodes(tmp_path_factory, name, data):
    at = data.draw(st.integers(0, len(name) - 1))
    misspelt = name[:at] + name[at + 1 :]
    if misspelt in SCHEMA:
        return
    path = file_with(tmp_path_factory.mktemp("misspelt"), f"/**: {{ros__parameters: {{{misspelt}: 1}}}}")
    with pytest.raises(InputError, match=f"{misspelt}: no such parameter, did you mean"):
        load_parameters(path)


MATCHES = {
    "/**": True, "/*": False, "/*/*": True, "**": True, "dvl_calibration": False, "auv/dvl_calibration": True,
    "/auv/dvl_calibration": True, "/auv/*": True, "/**/dvl_calibration": True, "/port/dvl_calibration": False,
    "/auv": False, "/auv/dvl": False, "/*/dvl_calibration": True, "/auv/**": True, "/auv/dvl_calibration/**": True,
}  # fmt: skip


@pytest.mark.parametrize("section", MATCHES)
def test_a_file_that_has_nothing_for_the_node_by_its_full_name_is_refused(tmp_path, section):
    path = file_with(tmp_path, f"'{section}': {{ros__parameters: {{min_speed: 0.5}}}}")
    if MATCHES[section]:
        assert names_of_others(path, "/auv/dvl_calibration") == set()
    else:
        with pytest.raises(InputError, match="nothing in it is for node /auv/dvl_calibration, only for"):
            names_of_others(path, "/auv/dvl_calibration")


@pytest.mark.parametrize(
    "text",
    [
        "/**: {ros__parameters: {min_speed: 0.5}}\n/**: {ros__parameters: {max_speed: 9.0}}\n",
        "/**:\n  ros__parameters:\n    min_speed: 0.5\n    min_speed: 0.6\n",
        "/**:\n  ros__parameters: {min_speed: 0.5, max_speed: 9.0, min_speed: 0.6}\n",
        "/**:\n  ros__parameters: {min_speed: 0.5}\n  ros__parameters: {max_speed: 9.0}\n",
    ],
)
def test_a_key_that_stands_twice_is_refused_for_only_one_of_both_would_count(tmp_path, text):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"is there twice, first in line [123]; keep one"):
        load_parameters(path)


def test_overrides_win_over_the_file_and_the_last_of_them_over_the_others(tmp_path):
    path = file_with(tmp_path, "/**: {ros__parameters: {min_speed: 0.5, model: M4}}")
    parameters = load_parameters(path, ["min_speed:=0.6", "min_speed:=0.7"])
    assert (parameters.min_speed, parameters.model) == (0.7, "M4")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("min_speed=1", "name:=value"),
        ("min_speeed:=1", "did you mean 'min_speed'"),
        ("min_speed:=fast", "min_speed: expected a number, got 'fast'"),
        ("min_speed:=2026-13-45", "min_speed: expected a number, got '2026-13-45'"),
        ("min_speed:=1" + "0" * 400, "too large"),
        ("lever_arm:=[1, 2", "lever_arm: expected an array"),
        ("min_speed:=", "min_speed: expected a number"),
    ],
)
def test_a_wrong_override_is_said_with_its_name(override, expected):
    with pytest.raises(InputError) as caught:
        load_parameters(None, [override])
    assert expected in str(caught.value)


def test_parameters_of_ros_itself_can_be_given_as_overrides():
    assert load_parameters(None, ["use_sim_time:=true"]) == Parameters()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mounting_rpy:=[0, 0, 45deg]", (0.0, 0.0, math.radians(45.0))),
        ("mounting_rpy:=0 -1.5deg 45°", (0.0, math.radians(-1.5), math.radians(45.0))),
        ("mounting_rpy:=[0.0, 0.0, 0.7]", (0.0, 0.0, 0.7)),
        ("imu_rpy:=180deg, 0, 0", (math.pi, 0.0, 0.0)),
    ],
)
def test_angles_of_an_override_may_be_in_degrees_and_ros_gets_radians(text, expected):
    name = text.partition(":=")[0]
    assert getattr(load_parameters(None, [text]), name) == pytest.approx(expected)
    assert getattr(load_parameters(None, [ros_override(text)]), name) == pytest.approx(expected)
    assert "deg" not in ros_override(text) and "°" not in ros_override(text)


def test_an_override_that_is_no_angle_goes_to_ros_as_it_was_typed():
    for text in ("min_speed:=0.5", "model:=M3", "result_file:=", "result_file:=a b.yaml", "lever_arm:=[1,2,3]"):
        assert ros_override(text) == text


def test_what_a_file_leaves_at_its_default_is_not_given(tmp_path):
    path = file_with(tmp_path, parameter_file_text().replace("min_speed: 0.3", "min_speed: 0.4"))
    assert given_parameters(path, ["mounting_rpy:=[0,0,0]"]) == {"min_speed", "mounting_rpy"}
