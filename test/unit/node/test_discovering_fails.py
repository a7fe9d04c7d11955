"""Looking for topics never ends the node: where nothing can be recorded, it is said."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.messages.drivers import TWIST_TYPE
from dvl_calib_ros.node.live_discovery import Discovering

NONE_NAMED = {"dvl": None, "gnss": None, "imu": None}


def searching(*topics):
    node = SimpleNamespace(
        get_fully_qualified_name=lambda: "/dvl_calibration",
        get_topic_names_and_types=lambda: [(topic, [TWIST_TYPE]) for topic in topics],
        count_publishers=lambda _: 1,
        get_publishers_info_by_topic=lambda _: [],
        create_subscription=lambda _, topic, taken, *__, **___: SimpleNamespace(topic_name=topic, taken=taken),
        destroy_subscription=lambda _: None,
        info=lambda _: None,
        warn=lambda _: None,
    )
    return Discovering(node, Parameters(), (), ThreadPoolExecutor(1))


def test_nothing_is_recorded_while_no_topic_may_be_a_dvls_nor_of_what_the_node_says_itself():
    search = searching("/odometry", "/cmd_vel", "/dvl_calibration/calibrated_twist")
    assert search.step(NONE_NAMED) is None and search._recording is None


def test_without_what_reads_recordings_it_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "dvl_calib_ros.bags.writer", None)
    with pytest.raises(InputError, match="discover needs rosbags"):
        searching("/dvl").step(NONE_NAMED)


def test_a_full_disk_ends_the_search(monkeypatch):
    search = searching("/dvl")
    assert search.step(NONE_NAMED) is None
    recorder = search._recording.recorder

    def full(*_):
        raise InputError("no space left")

    monkeypatch.setattr(recorder._writer, "raw", full)
    for each in recorder._subscriptions:
        each.taken(b"")
    with pytest.raises(InputError, match="no space left"):
        search.step(NONE_NAMED)
    search.close()
    assert search._recording is None


@pytest.mark.parametrize(("heard", "after", "is_enough"), [(3, 21.0, True), (2, 21.0, False), (2, 61.0, True)])
def test_a_topic_that_brings_something_each_10_s_is_listened_to_for_longer(monkeypatch, heard, after, is_enough):
    """As a USBL: of two positions there is one difference, of one none."""
    now = 100.0
    monkeypatch.setattr("dvl_calib_ros.node.live_discovery.time", SimpleNamespace(monotonic=lambda: now))
    search = searching("/dvl")
    search.step(NONE_NAMED)
    recorder = search._recording.recorder
    search._recording = search._recording._replace(began=now)
    monkeypatch.setattr(recorder, "look", lambda: False)
    monkeypatch.setattr(type(recorder), "topics", property(lambda _: ["/dvl", "/usbl"]))
    recorder.counts.update({"/dvl": 100, "/usbl": heard})
    now += after
    search.step(NONE_NAMED)
    assert (search._recording is None) == is_enough
    search.close()
