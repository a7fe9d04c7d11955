"""Bags of fourteen realistic stacks, replayed without options: the right mounting, or one line that says what lacks."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, succeed
from conftest import few, made_once
from scipy.spatial.transform import Rotation
from situations import contradicts
from stacks import A50, LEVER_ARM, STACKS, TWIST, YAW_45, Stack, Told, true_mounting

import dvl_calib_ros as dc
from dvl_calib_ros.bag_replay.replay import Replayed, replay
from dvl_calib_ros.calibration.filters.observability import body_angle_std
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.calibration.numerics.frames import FLU_FROM_FRD, rotation_from_rpy
from dvl_calib_ros.discovery.discover import discover
from dvl_calib_ros.discovery.discovery import Discovery, Given
from dvl_calib_ros.errors import InputError

ANSWERED = [name for name, stack in STACKS.items() if not stack.missing]
WAITED_FOR = ("bluerov_with_mavros", "water_linked_driver_at_45_degrees", "imu_on_its_side", "simulator_with_truth")
# the yaw of a DVL whose place nothing in the bag says is wrong by what half a metre turns it, and the answer says so
UNPLACED = "lever_arm:="


class Bags(dict[str, Path]):
    """Each written once, by the first process whose test asks for it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __missing__(self, name: str) -> Path:
        self[name] = made_once(self._folder / name, STACKS[name].write)
        return self[name]


@pytest.fixture(scope="module")
def bags(shared_folder) -> Bags:
    return Bags(shared_folder)


def answered(bag: Path, given: Given | None = None, **parameters) -> tuple[Discovery, Replayed]:
    found = discover([bag], Parameters(**parameters), given)
    return found, replay([bag], found.parameters, found.topics)


def errors_in_sigmas(found: Discovery, replayed: Replayed, stack: Stack) -> np.ndarray:
    """Roll, pitch, yaw errors of the corrected mounting about the body's axes, in standard deviations."""
    estimate = replayed.result.estimate
    corrected = estimate.rotation_body_from_dvl(found.parameters.rotation_dvl_from_body)
    truth = true_mounting(stack.mounting_rpy)
    if corrected[:, 2] @ truth[:, 2] < 0.0:  # the bag's transform is of axes forward-right-down
        truth = truth @ FLU_FROM_FRD
    error = Rotation.from_matrix(corrected @ truth.T).as_rotvec()
    return np.abs(error) / body_angle_std(estimate.covariance, found.parameters)


def test_there_are_fourteen_stacks():
    assert len(STACKS) == 14


@pytest.mark.parametrize("name", few(ANSWERED, WAITED_FOR))
@pytest.mark.spread(2)
def test_a_bag_as_it_is_gives_the_right_mounting_or_says_what_is_missing(bags, name):
    found, replayed = answered(bags[name])
    if name in list(STACKS)[:10]:
        assert_mounting_and_lever_arm_are_those_of_the_transforms(found, STACKS[name])
    says_what_is_missing = any(UNPLACED in sentence for sentence in found.found)
    assert (errors_in_sigmas(found, replayed, STACKS[name]) < 3.0).all() or says_what_is_missing
    verdict = replayed.result.verifications[replayed.result.selected].verdict.value
    assert not contradicts(dc.doctor(bags[name]).verdict, verdict)
    # without a lever arm it is nearly right all the same
    corrected = replayed.result.estimate.rotation_body_from_dvl(found.parameters.rotation_dvl_from_body)
    truth = true_mounting(STACKS[name].mounting_rpy)
    off = min(Rotation.from_matrix(corrected.T @ each).magnitude() for each in (truth, truth @ FLU_FROM_FRD))
    assert math.degrees(off) < 3.0


@pytest.mark.parametrize("name", ["no_attitude", "no_dvl"])
def test_a_bag_that_cannot_do_is_told_in_one_line_what_it_lacks(bags, capsys, name):
    if name == "no_dvl":
        assert STACKS[name].missing in fail(capsys, "replay", bags[name])
    else:
        _, errors = succeed(capsys, "replay", bags[name])
        (line,) = errors.splitlines()
        assert STACKS[name].missing in line


def assert_mounting_and_lever_arm_are_those_of_the_transforms(found: Discovery, stack: Stack) -> None:
    placed = [sentence for sentence in found.found if "from /tf_static" in sentence or "robot_description" in sentence]
    if placed:
        np.testing.assert_allclose(found.parameters.lever_arm, LEVER_ARM, atol=1e-9)
        assert "lever arm -0.6 0.15 -0.3 m" in placed[0]
    nominal = rotation_from_rpy(stack.mounting_rpy)
    begun = rotation_from_rpy(found.parameters.mounting_rpy)
    assert min(np.abs(begun - each).max() for each in (nominal, nominal @ FLU_FROM_FRD)) < 1e-9


@pytest.mark.slow
def test_rtk_positions_alone_give_the_yaw_to_a_few_hundredths_of_a_degree(bags):
    found, replayed = answered(bags["rtk_positions_only"])
    assert "reference /rtk/fix (NavSatFix, enu, 5 Hz)" in found.found[0]
    corrected = replayed.result.estimate.rotation_body_from_dvl(found.parameters.rotation_dvl_from_body)
    roll, pitch, yaw = np.degrees(Rotation.from_matrix(true_mounting((0.0, 0.0, 0.0)).T @ corrected).as_rotvec())
    assert abs(yaw) < 0.1 and abs(pitch) < 0.1 and abs(roll) < 2.0


def test_what_is_given_stands_and_is_not_looked_for(bags):
    bag = bags["water_linked_driver_at_45_degrees"]
    given = Given(parameters=frozenset({"mounting_rpy", "lever_arm"}))
    found = discover([bag], Parameters(mounting_rpy=(0.0, 0.0, 0.7), lever_arm=(1.0, 0.0, 0.0)), given)
    assert found.parameters.mounting_rpy == (0.0, 0.0, 0.7)
    assert found.parameters.lever_arm == (1.0, 0.0, 0.0)
    given = Given(gnss_topic="none", imu_topic="none")
    assert discover([bag], Parameters(), given).topics == discover([bag], Parameters(), given).topics
    assert "no reference; no IMU" in discover([bag], Parameters(), given).found[0]


def test_a_mounting_that_the_data_contradicts_is_doubted_with_the_option_to_type(tmp_path):
    def tell(told: Told) -> None:
        told.dvl("/dvl/twist", TWIST, "dvl_link", YAW_45)
        told.reference("/gps/vel", TWIST, "enu", "enu")
        told.imu("/imu/data", "base_link")
        told.tf_static(told.transform("base_link", "dvl_link", (0.0, 0.0, 0.0), LEVER_ARM))

    found = discover([Stack(tell).write(tmp_path / "bag")], Parameters())
    assert found.parameters.mounting_rpy == (0.0, 0.0, 0.0)
    (doubt,) = found.doubts
    assert "try -p mounting_rpy:=[0deg,0deg,45deg]" in doubt


def test_a_declared_frame_that_does_not_fit_is_not_taken_silently(bags):
    found = discover([bags["odometry_in_the_world"]], Parameters())
    assert found.parameters.gnss_frame == "enu"
    (doubt,) = found.doubts
    assert "'base_link' says body" in doubt and "correct the frame" in doubt


def test_a_velocity_that_has_the_dvl_in_it_is_no_reference(tmp_path):
    def tell(told: Told) -> None:
        told.dvl("/dvl/data", A50, "dvl_link")
        told.reference("/dvl/odometry", TWIST, "odom", "body")
        told.reference("/odometry/filtered", TWIST, "odom", "enu")
        told.imu("/imu/data", "base_link")

    found = discover([Stack(tell).write(tmp_path / "bag")], Parameters())
    assert "no reference" in found.found[0]
    assert sum("not taken as a reference" in doubt for doubt in found.doubts) == 2


def test_the_answer_says_what_was_found_the_mounting_to_paste_and_what_to_type(bags, capsys, tmp_path):
    bag = bags["water_linked_driver_at_45_degrees"]
    out, errors = succeed(capsys, "replay", bag, "--json", tmp_path / "o.json")
    assert errors == ""
    assert "from /robot_description" in out and "accept" in out
    assert '<origin xyz="-0.6 0.15 -0.3" rpy="' in out
    assert f"next  dvl-calib replay {bag} --save calibration.yaml" in out
    assert "m of drift per km as mounted" in out
    assert "gated" not in out and "M1" not in out
    assert "The paper's own selection (iac, M3): roll" in out
    document = json.loads((tmp_path / "o.json").read_text())
    assert document["discovery"]["topics"]["gnss"] == "/ins/velocity"


@pytest.mark.slow
def test_from_a_bare_bag_to_an_applied_urdf_in_three_commands(bags, capsys, tmp_path):
    from stacks import URDF_45

    bag, urdf, saved = bags["water_linked_driver_at_45_degrees"], tmp_path / "robot.urdf", tmp_path / "c.yaml"
    urdf.write_text(URDF_45)
    succeed(capsys, "replay", bag)
    succeed(capsys, "replay", bag, "--save", saved)
    out, _ = succeed(capsys, "apply", saved, "--urdf", urdf)
    assert f"{urdf}: written" in out
    assert urdf.read_text() != URDF_45 and f'rpy="0 0 {YAW_45[2]}"' not in urdf.read_text()


def test_angles_on_the_command_line_may_be_in_degrees(bags, capsys, tmp_path):
    bag = bags["ins_odometry_in_the_body"]
    for text in ("[0, 0, 45deg]", "0 0 45deg", "[0,0,45°]"):
        succeed(capsys, "replay", bag, "-p", f"mounting_rpy:={text}", "--json", tmp_path / "o.json")
        parameters = json.loads((tmp_path / "o.json").read_text())["parameters"]
        assert parameters["mounting_rpy"] == [0.0, 0.0, math.radians(45.0)]
    assert "mounting_rpy" in fail(capsys, "replay", bag, "-p", "mounting_rpy:=[0, 0, 45degrees]")


def test_an_empty_or_foreign_recording_is_refused_in_one_line(tmp_path):
    from io_fixtures import write_bag

    with pytest.raises(InputError, match="no topics"):
        discover([write_bag(tmp_path / "empty", [])], Parameters())


def test_clocks_are_looked_for_with_the_imu_turned_as_its_transform_says(bags):
    found = discover([bags["imu_on_its_side"]], Parameters())
    assert found.clocks is not None
    assert found.clocks.parameters.imu_rpy == found.parameters.imu_rpy != (0.0, 0.0, 0.0)
    registered = found.clocks.registration
    assert registered.residual < 0.15
    assert np.degrees(np.abs(Rotation.from_matrix(registered.rotation_body_from_dvl).as_rotvec())).max() < 5.0
