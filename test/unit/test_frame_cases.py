"""Random vehicles of `python -m validation frames`: their bags hold what their truth says."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from validation.frame_cases import (
    DOWN,
    NED_FROM_ENU,
    NWU_FROM_ENU,
    SAME,
    STEP_S,
    Answer,
    Case,
    draw,
    errors_of,
    line_of,
    motion_of,
    write,
)
from validation.surveys.physics import EPOCH_S

# An upright vehicle and one that is z down, each with every reference, and each fault of a DVL.
CHOSEN = {
    "clean": lambda case: not case.faults() and not case.z_down and case.reference == "velocity",
    "odometry": lambda case: case.reference == "odometry" and case.reference_axes == "declared" and not case.z_down,
    "odometry in the earth": lambda case: case.reference_axes == "undeclared enu" and not case.z_down,
    "odometry forward-right-down": lambda case: case.reference_axes == "undeclared frd",
    "positions": lambda case: case.reference == "positions" and bool(case.transform) and not case.z_down,
    "z down, velocity": lambda case: case.z_down and case.reference == "velocity" and case.mounting_yaw == 45.0,
    "z down, odometry": lambda case: case.z_down and case.reference == "odometry" and case.reference_axes == "declared",
    "velocity in north-west-up": lambda case: case.reference_axes == "undeclared nwu",
    "IMU in NED": lambda case: case.imu == "undeclared ned",
    "IMU in north-west-up": lambda case: case.imu == "undeclared nwu" and case.acceleration,
    "DVL forward-right-down": lambda case: case.dvl == "undeclared frd",
    "DVL mirrored": lambda case: case.dvl.startswith("mirrored"),
    "wrong yaw": lambda case: case.dvl.startswith("wrong") and case.transform == "/tf_static",
    "wrong yaw in a URDF": lambda case: case.dvl.startswith("wrong") and case.transform == "URDF",
}


def read(path: Path) -> dict[str, tuple[list[int], list[object]]]:
    """Return places in the motion and messages by topic."""
    topics: dict[str, tuple[list[int], list[object]]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            places, messages = topics.setdefault(connection.topic, ([], []))
            messages.append(message)
            if hasattr(message, "header"):
                stamp = message.header.stamp
                places.append(round((stamp.sec - EPOCH_S + stamp.nanosec * 1e-9) / STEP_S))
    return topics


def xyz(messages: list[object], *path: str) -> np.ndarray:
    """Return a vector of each message."""
    found = []
    for each in messages:
        for name in path:
            each = getattr(each, name)
        found.append((each.x, each.y, each.z))
    return np.array(found)


def rotations(messages: list[object], *path: str) -> Rotation:
    """Return the orientation of each message."""
    found = []
    for each in messages:
        for name in path:
            each = getattr(each, name)
        found.append((each.x, each.y, each.z, each.w))
    return Rotation.from_quat(found)


def told_of_the_dvl(topics: dict[str, tuple[list[int], list[object]]]) -> tuple[np.ndarray, Rotation]:
    """Return position and orientation of the DVL as /tf_static or the URDF has them."""
    if "/tf_static" in topics:
        (told,) = (each for each in topics["/tf_static"][1][0].transforms if each.child_frame_id == "dvl_link")
        return xyz([told], "transform", "translation")[0], rotations([told], "transform", "rotation")[0]
    origin = ElementTree.fromstring(topics["/robot_description"][1][0].data).find(
        "joint[@name='dvl_link_joint']/origin"
    )
    place, rpy = (np.array(origin.get(name).split(), float) for name in ("xyz", "rpy"))
    return place, Rotation.from_euler("xyz", rpy)


@pytest.mark.spread(5)
@pytest.mark.parametrize("name", CHOSEN)
def test_without_noise_a_bag_holds_what_the_truth_predicts(tmp_path, name):
    case: Case = next(case for case in map(draw, range(400)) if CHOSEN[name](case))
    case = replace(case, noise=False, seconds=60.0)
    write(case, tmp_path / "bag")
    topics, motion = read(tmp_path / "bag"), motion_of(case)
    # the DVL, in the axes of this vehicle's base_link, by its first accepted orientation
    places, messages = topics["/dvl/velocity"]
    body = case.to_base.apply(motion.velocity[places])
    turned = np.cross(case.to_base.apply(motion.rate[places]), case.to_base.apply(case.arm))
    predicted = (1.0 + case.scale) * case.accepted()[0].inv().apply(body + turned)
    if case.dvl.startswith("mirrored"):
        predicted[:, "xyz".index(case.dvl[-1])] *= -1.0
    recorded = xyz(messages, "twist", "twist", "linear")
    np.testing.assert_allclose(recorded, predicted, atol=1e-9)
    assert np.abs(predicted).max() > 0.2
    # the IMU: attitude, rate and force in the axes that it has
    places, messages = topics["/imu/data"]
    world = NED_FROM_ENU if case.imu.endswith("ned") else NWU_FROM_ENU if case.imu.endswith("nwu") else SAME
    axes = DOWN if case.imu.endswith("ned") else SAME
    seen = world.inv() * rotations(messages, "orientation") * axes
    assert (seen.inv() * motion.attitude[places]).magnitude().max() < 1e-6
    np.testing.assert_allclose(axes.apply(xyz(messages, "angular_velocity")), motion.rate[places], atol=1e-9)
    if case.acceleration:
        up = (world.inv() * rotations(messages, "orientation")).apply(xyz(messages, "linear_acceleration"))
        np.testing.assert_allclose(up.mean(axis=0), [0.0, 0.0, 9.81], atol=0.1)
    # the reference, and the rates and positions against velocities
    over_ground = motion.attitude.apply(motion.velocity)
    np.testing.assert_allclose(np.gradient(motion.position, STEP_S, axis=0)[5:-5], over_ground[5:-5], atol=0.02)
    if case.reference == "velocity":
        places, messages = topics["/gnss/velocity"]
        sent = xyz(messages, "twist", "twist", "linear")
        ned = case.reference_axes == "undeclared ned" or case.reference_frame.endswith("ned")
        world = NED_FROM_ENU if ned else NWU_FROM_ENU if case.reference_axes == "undeclared nwu" else SAME
        np.testing.assert_allclose(world.inv().apply(sent), over_ground[places], atol=1e-9)
    elif case.reference == "odometry":
        places, messages = topics["/ins/odometry"]
        twist = xyz(messages, "twist", "twist", "linear")
        if case.reference_axes == "undeclared frd":
            twist = DOWN.apply(twist)
        in_world = twist if case.reference_axes == "undeclared enu" else (
            rotations(messages, "pose", "pose", "orientation").apply(twist))  # fmt: skip
        world = NED_FROM_ENU if case.z_down else SAME
        np.testing.assert_allclose(world.inv().apply(in_world), over_ground[places], atol=1e-6)
    if case.transform:
        place, told = told_of_the_dvl(topics)
        wrong = case.dvl.startswith("wrong") or case.dvl == "undeclared frd"
        assert (np.degrees((told.inv() * case.accepted()[0]).magnitude()) > 5.3) == wrong
        np.testing.assert_allclose(place, case.to_base.apply(case.arm), atol=1e-6)


def test_a_case_is_its_seed_and_half_of_them_have_nothing_wrong():
    assert draw(7) == draw(7) != draw(8)
    cases = [draw(seed) for seed in range(600)]
    assert 0.45 < sum(not case.faults() for case in cases) / 600 < 0.55
    faults = Counter(fault for case in cases for fault in case.faults())
    assert len(faults) == 10 and min(faults.values()) > 10


def test_each_vehicle_turns_to_both_sides_and_has_two_speeds():
    for seed in range(12):
        motion = motion_of(draw(seed))
        turned = motion.rate[:, 2]
        assert turned.max() > 0.05 and turned.min() < -0.05
        slow, fast = np.percentile(motion.velocity[500:, 0], [20, 80])
        assert fast > 1.1 * slow and np.degrees(motion.attitude.as_euler("ZYX")[:, 1:].std(axis=0)).min() > 0.2


def test_the_judge_of_frames_sees_a_wrong_angle_and_what_contradicts():
    truth = Rotation.from_euler("xyz", (179.9, 1.0, -45.0), degrees=True)
    assert errors_of(np.radians((-179.8, 1.0, -45.0)), np.full(3, 0.1), truth) == []
    wrong = errors_of(np.radians((179.9, 1.8, 45.0)), np.full(3, 0.1), truth)
    assert [each.split()[0] for each in wrong] == ["pitch", "yaw"]
    assert errors_of(np.radians((179.9, 1.8, -45.0)), np.full(3, 0.3), truth) == []
    contradict = [Answer("", *each).contradicts for each in (("yes", "reject"), ("no", "accept"), ("no", "marginal"))]
    assert all(contradict) and not Answer("", "partly", "marginal").contradicts
    assert not Answer("", "no", "reject").contradicts
    assert "wrong: nothing" in line_of(replace(draw(1), imu="enu", reference_axes="declared", dvl="own axes"),
                                       Answer("right"))  # fmt: skip
