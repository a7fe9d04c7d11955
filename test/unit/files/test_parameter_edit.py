"""Values set in a parameter file by hand: they are read as meant, and nothing else is touched."""

from __future__ import annotations

import pytest

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.files.parameter_files import load_parameters, new_file, with_parameters

VALUES = {"mounting_rpy": [0.1, -0.2, 3.0], "dvl_time_offset": -1.25, "lever_arm": [1.0, 0.0, 1e-05]}
BLOCK = """# our vehicle é\r
/**:
  ros__parameters:   # all
    max_speed: 4.0

    lever_arm:
      - 0.5   # bow
      - 0.0
      - 0.0
    # the mounting is from the drawing
    mounting_rpy: [0, 0.0,
                   3.1]   # yaw
other_node: {ros__parameters: {lever_arm: [9, 9, 9]}}
"""


@pytest.mark.parametrize(
    "text",
    [
        BLOCK,
        "/**:\n  ros__parameters:\n    model: full",
        "/**: {ros__parameters: {}}",
        "/auv/dvl_calibration: {ros__parameters: {model: full, mounting_rpy: [0, 0, 3]}}\n",
        "/**: {ros__parameters: {lever_arm: [1, 2, 3]}}\ndvl_calibration:\n ros__parameters:\n  lever_arm: [3, 2, 1]\n",
        "auv:\n    dvl_calibration:\n        ros__parameters:\n            'lever_arm': [3, 2, 1]\n",
    ],
    ids=["by hand", "no last line end", "empty", "flow", "two sections", "nested"],
)
def test_what_is_set_is_read_again_and_the_rest_stays(tmp_path, text):
    path = tmp_path / "p.yaml"
    path.write_bytes(text.encode())
    before = load_parameters(path)
    path.write_bytes(with_parameters(path, VALUES))
    assert load_parameters(path) == before.replace(**VALUES)
    assert with_parameters(path, VALUES) == path.read_bytes()
    path.write_bytes(with_parameters(path, {name: getattr(before, name) for name in VALUES} | {"max_fom": 0.4}))
    assert load_parameters(path) == before


def test_comments_line_ends_and_other_nodes_stay_as_they_were(tmp_path):
    path = tmp_path / "p.yaml"
    path.write_bytes(BLOCK.encode())
    found = with_parameters(path, VALUES).decode()
    for kept in ("# our vehicle é\r\n", "# all\n", "# the mounting is from the drawing\n", "# yaw\n", "[9, 9, 9]"):
        assert kept in found
    assert "    dvl_time_offset: -1.25\n    max_speed: 4.0\n" in found


@pytest.mark.parametrize("text", ["", "a: 1\n", "/other:\n  ros__parameters:\n    a: 1\n", "/**: [\n"])
def test_what_is_no_parameter_file_of_ours_is_refused(tmp_path, text):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"p\.yaml"):
        with_parameters(path, VALUES)


def test_a_new_file_holds_what_is_not_at_its_default(tmp_path):
    path = tmp_path / "p.yaml"
    parameters = Parameters(min_speed=0.5)
    path.write_bytes(new_file(parameters, VALUES, "made by a test"))
    assert load_parameters(path) == parameters.replace(**VALUES)
    assert path.read_text().count("\n") == 7
