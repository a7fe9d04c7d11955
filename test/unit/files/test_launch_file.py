"""The launch file refuses what ROS 2 would only warn of, and start the node on its defaults."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from conftest import ROOT

from dvl_calib_ros.errors import InputError


class Action:
    """As much of a launch action as the file is made of."""

    def __init__(self, *names: str, **options: Any) -> None:
        self.names, self.options = names, options


class Node(Action):
    pass


class OpaqueFunction(Action):
    pass


class Said(dict):
    """Launch arguments as given, or as declared."""

    def take(self, name: str, default_value: str = "", **_: Any) -> None:
        self.setdefault(name, default_value)


def configuration(name: str) -> SimpleNamespace:
    return SimpleNamespace(perform=lambda context: context[name])


FAKES: dict[str, dict[str, Any]] = {
    "launch": {"LaunchDescription": list, "LaunchContext": dict},
    "launch.actions": {"DeclareLaunchArgument": Action, "OpaqueFunction": OpaqueFunction},
    "launch.substitutions": {"LaunchConfiguration": configuration},
    "launch_ros": {},
    "launch_ros.actions": {"Node": Node},
    "ament_index_python": {},
    "ament_index_python.packages": {"get_package_share_directory": lambda _: str(ROOT)},
}


def launch(monkeypatch, params_file) -> list[type]:
    """Run the launch file's actions, without ROS 2's launch; what it starts."""
    for name, content in FAKES.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("calibration_launch", ROOT / "launch" / "calibration.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    done = []
    said = Said(params_file=str(params_file))
    for action in module.generate_launch_description():
        if isinstance(action, OpaqueFunction):
            done += map(type, action.options["function"](said))
        else:
            said.take(*action.names, **action.options)
    return done


def test_the_shipped_parameter_file_is_launched(monkeypatch):
    assert launch(monkeypatch, ROOT / "config" / "calibration.yaml") == [Node]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such ROS 2 parameter file"),
        ("other: {ros__parameters: {min_speed: 0.5}}", "nothing in it is for node dvl_calibration"),
        ("/**: {ros__parameters: {min_speed: -1.0}}", "min_speed: -1 is outside"),
    ],
)
def test_a_file_that_is_missing_or_wrong_ends_the_launch(monkeypatch, tmp_path, text, said):
    path = tmp_path / "params.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=said):
        launch(monkeypatch, path)
