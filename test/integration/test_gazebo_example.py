"""examples/gazebo: what its page and its bridge say is what the export writes and what a replay reads."""

from __future__ import annotations

import heapq
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ROOT
from driver_fixtures import IMU, MARINE, ODOMETRY, write_driver_bag
from other_simulators import READERS, driven
from scipy.spatial.transform import Rotation

import dvl_calib_ros as dc
from dvl_calib_ros.calibration.numerics.samples import VelocityFrame

EXAMPLE = ROOT / "examples" / "gazebo"
BRIDGE = {each["ros_topic_name"]: each for each in yaml.safe_load((EXAMPLE / "bridge.yaml").read_text())}


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> Path:
    """The settings of a DVL that a calibration found, as step 1 of the page writes them."""
    folder = tmp_path_factory.mktemp("gazebo")
    vehicle = dc.simulate(folder / "vehicle", seconds=240.0, trajectory="free", mounting_rpy=(0.0, 0.0, 0.4))
    saved = dc.replay(vehicle, history=False, mounting_rpy=(0.0, 0.0, 0.4)).save(folder / "calibration.yaml")
    dc.export("gazebo", saved, folder / "dvl.sdf")
    return folder / "dvl.sdf"


def test_the_bridge_takes_the_topic_that_the_settings_name_in_types_that_are_read(settings):
    topic = ElementTree.parse(settings).getroot().findtext("model/link/sensor/topic")
    assert BRIDGE[topic]["gz_topic_name"] == topic
    types = {name: each["ros_type_name"] for name, each in BRIDGE.items() if name != "/clock"}
    assert types == {topic: MARINE, "/truth/odometry": ODOMETRY, "/imu/data": IMU}
    recorded = next(line for line in (EXAMPLE / "README.md").read_text().splitlines() if "bag record" in line)
    assert set(recorded.split()[5:]) == set(BRIDGE)


@pytest.mark.slow
def test_what_the_bridge_makes_of_those_settings_gives_the_exported_mounting_back(settings, tmp_path):
    """The bridge's messages, with the altitude of -1 that it leaves; Gazebo itself is not here."""
    dvl = READERS["gazebo"](settings)
    log = driven(240.0, 5, 0.02)
    samples = heapq.merge(*log.samples(dvl, VelocityFrame.BODY), key=lambda sample: sample.stamp_ns)
    no_altitude = {n: lambda message: setattr(message, "altitude", -1.0) for n in range(int(240.0 * dvl.rate) + 1)}
    (topic,) = (name for name, each in BRIDGE.items() if each["ros_type_name"] == MARINE)
    bag = write_driver_bag(tmp_path / "gazebo_bag", samples, MARINE, ODOMETRY, dvl_topic=topic, changes=no_altitude)
    found = dc.replay(bag, history=False)
    assert found.verdict != "reject", found.reasons
    rpy = Rotation.from_matrix(dvl.rotation).as_euler("xyz", degrees=True)
    off = np.abs(np.array(found.mounting.rpy_deg) - rpy) / found.mounting.std_deg
    assert (off < 3.0).all(), (found.mounting, rpy)
