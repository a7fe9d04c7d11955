"""What packages, package.xml, the changelog and the launch file say is true."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from conftest import ROOT

import dvl_calib_ros
from dvl_calib_ros.errors import InputError

SETUP = (ROOT / "setup.py").read_text()
PROJECT = (ROOT / "pyproject.toml").read_text()
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
MODULES = sorted((ROOT / "dvl_calib_ros").rglob("*.py"))
# how distributions call what we import, where it is not the module's own name
DISTRIBUTIONS = {"yaml": "pyyaml", "backports": "backports.zstd"}
# of ROS, of an extra, of Python 3.14, or replaced where it is missing
NOT_REQUIRED = {"compression", "rclpy", "ament_index_python", "rosbag2_py", "tf2_ros"}
NOT_REQUIRED |= {"argcomplete", "distributed", "pandas", "pymavlink", "pyarrow", "fsspec"}


def required() -> dict[str, str]:
    """Lowest version of every distribution that is asked for."""
    asked = PROJECT.partition("\ndependencies = [")[2].partition("\n]")[0]
    return dict(re.findall(r'["\']([a-z][a-z0-9_.]*)>=([\d.]+)', asked))


def parts(version: str) -> list[int]:
    return [int(part) for part in version.split(".")]


def test_the_version_is_the_same_everywhere():
    (in_setup,) = re.findall(r"version=\"(\d+\.\d+\.\d+)\",", SETUP)  # the form that catkin_prepare_release looks for
    (to_cite,) = re.findall(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert PACKAGE.findtext("version") == in_setup == to_cite == dvl_calib_ros.__version__


def test_the_lowest_versions_that_ci_tries_are_those_that_are_asked_for():
    tried = dict(re.findall(r"^([\w.]+)==([\d.]+)$", (ROOT / ".ci" / "lowest.txt").read_text(), re.M))
    assert tried.keys() == required().keys()
    for name, lowest in required().items():
        assert parts(tried[name])[: len(parts(lowest))] == parts(lowest), name


def test_package_xml_has_the_keys_of_all_that_the_node_imports():
    keys = {element.text for element in PACKAGE.findall("exec_depend")}
    node = (ROOT / "dvl_calib_ros" / "node").glob("*.py")
    messages = {
        name.partition(".")[0]
        for path in node
        for name in re.findall(r"^ *from (\w+)[\w.]* import", path.read_text(), re.M)
        if name.endswith(("_msgs", "_srvs", "_interfaces")) or name == "rclpy"
    }
    assert len(messages) >= 5 and messages <= keys
    assert {"python3-numpy", "python3-scipy", "python3-yaml", "launch_ros"} <= keys


def test_a_release_finds_maintainer_licence_and_a_changelog_of_its_version():
    assert PACKAGE.find("maintainer").get("email") and PACKAGE.findtext("license") == "Apache-2.0"
    changelog = (ROOT / "CHANGELOG.rst").read_text()
    versions = re.findall(r"^(Forthcoming|\d+\.\d+\.\d+ \(\d{4}-\d\d-\d\d\))\n-+$", changelog, re.M)
    assert versions[0] == "Forthcoming" and any(each.startswith(dvl_calib_ros.__version__) for each in versions)


def test_types_are_handed_on():
    assert (ROOT / "dvl_calib_ros" / "py.typed").is_file() and '"py.typed"' in SETUP


def test_only_the_package_is_installed(monkeypatch):
    """Benchmarks, validation and tests are for who has the sources."""
    given = {}
    monkeypatch.setattr("setuptools.setup", lambda **what: given.update(what))
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"))
    folders = {path.parent for path in MODULES}
    assert {name.replace(".", "/") for name in given["packages"]} == {str(path.relative_to(ROOT)) for path in folders}


class Anything:
    """Stands in for a class of launch: remembers what it was made of."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


class Configuration(Anything):
    def perform(self, context: dict) -> str:
        return context[self.args[0]]


@pytest.fixture
def launched(monkeypatch):
    """launch is no wheel: the file runs against stand-ins, and gives the node as it would be started."""
    modules = {
        "ament_index_python.packages": {"get_package_share_directory": lambda _: str(ROOT)},
        "launch": {"LaunchContext": dict, "LaunchDescription": Anything},
        "launch.actions": {"DeclareLaunchArgument": Anything, "OpaqueFunction": Anything},
        "launch.substitutions": {"LaunchConfiguration": Configuration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": Anything},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    path = ROOT / "launch" / "calibration.launch.py"
    spec = importlib.util.spec_from_file_location("calibration_launch", path)
    launch_file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launch_file)
    *declared, opaque = launch_file.generate_launch_description().args[0]
    defaults = {each.args[0]: each.kwargs["default_value"] for each in declared}

    def start(**given):
        assert given.keys() <= defaults.keys()
        (node,) = opaque.kwargs["function"]({**defaults, **given})
        return node.kwargs

    return start


def test_the_launch_file_remaps_the_topics_it_is_given_and_no_other(launched):
    assert launched()["remappings"] == []
    assert launched(dvl_topic="/a50/velocity")["remappings"] == [("dvl/twist", "/a50/velocity")]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such ROS 2 parameter file"),
        ("other: {ros__parameters: {min_speed: 0.5}}", "nothing in it is for node dvl_calibration"),
        ("/**: {ros__parameters: {min_speed: -1.0}}", "min_speed: -1 is outside"),
    ],
)
def test_a_parameter_file_that_is_missing_or_wrong_ends_the_launch(launched, tmp_path, text, said):
    """ROS 2 would only warn, and start the node on its defaults."""
    path = tmp_path / "params.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=said):
        launched(params_file=str(path))


def test_the_launch_file_leaves_use_sim_time_of_a_parameter_file_alone(launched, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("/**: {ros__parameters: {use_sim_time: true}}")
    assert launched(params_file=str(mine))["parameters"] == [str(mine)]
    assert launched(use_sim_time="true")["parameters"][1] == {"use_sim_time": True}
    assert launched(use_sim_time="false")["parameters"][1] == {"use_sim_time": False}


def test_the_launch_file_starts_a_node_again_only_if_told_to(launched):
    assert launched()["respawn"] is False and launched(respawn="true")["respawn"] is True


def test_the_launch_files_default_parameters_are_there(launched):
    assert Path(launched()["parameters"][0]).is_file()
