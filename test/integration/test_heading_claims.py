"""What an IMU claims of its heading is taken for how it may deviate, within reason; what the user says stands."""

from __future__ import annotations

import math

import numpy as np
import pytest
from command_line import succeed
from io_fixtures import TOPICS, write_bag

from dvl_calib_ros.bags.reader import BagReader
from dvl_calib_ros.bags.writer import BagWriter, Storage
from dvl_calib_ros.simulation.scenario import Scenario, simulate


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Messages of a sound recording."""
    folder = tmp_path_factory.mktemp("sound")
    run = simulate(Scenario(seconds=60.0, imu_rate=10.0))
    write_bag(folder / "bag", sorted([*run.imu, *run.gnss, *run.dvl], key=lambda sample: sample.stamp_ns))
    with BagReader([folder / "bag"]) as bag:
        return [(topic, log_ns, message) for topic, log_ns, message, _ in bag.messages(TOPICS)]


def claiming(path, sound, degrees, storage="mcap"):
    """A bag of these messages, whose IMU claims its heading to so many degrees."""
    with BagWriter(path, storage=Storage(storage)) as bag:
        for topic, log_ns, message in sound:
            if topic == "imu/data":
                message.orientation_covariance = np.diag([0.0, 0.0, math.radians(degrees) ** 2]).ravel()
            bag.message(topic, TOPICS[topic], log_ns, message)
    return str(path)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_what_the_imu_claims_is_taken_and_said(sound, tmp_path, capsys, storage):
    said = " ".join("".join(succeed(capsys, "replay", claiming(tmp_path / "bag", sound, 2.0, storage))).split())
    assert "the IMU claims a heading good to ±2°, which is used (-p heading_deviation_std:=0.035)" in said


@pytest.mark.parametrize("degrees", [0.0, 100.0])
def test_no_claim_and_one_of_anything_are_no_claims(sound, tmp_path, capsys, degrees):
    assert "claims a heading" not in "".join(succeed(capsys, "replay", claiming(tmp_path / "bag", sound, degrees)))


def test_what_the_user_says_stands(sound, tmp_path, capsys):
    bag = claiming(tmp_path / "bag", sound, 2.0)
    assert "claims a heading" not in "".join(succeed(capsys, "replay", bag, "-p", "heading_deviation_std:=0.01"))
