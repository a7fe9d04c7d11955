"""Which topic is taken, where several would do."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from dvl_calib_ros.discovery.topic_choice import choose_dvl, choose_imu, choose_reference, may_be_dvl
from dvl_calib_ros.messages.drivers import IMU_TYPE, TWIST_TYPE
from dvl_calib_ros.recordings.topic_messages import Preview, Survey


def survey(*topics: str, msgtype: str = TWIST_TYPE) -> Survey:
    """Topics in the order in which a recording has them, alike in all but their names."""
    values = np.tile([1.0, 0.0, 0.0] if msgtype == TWIST_TYPE else [0.0] * 10, (10, 1))
    looks = {each: Preview(each, msgtype, 10, 5.0, "", np.arange(10.0), 0.0, values) for each in topics}
    return Survey(dict.fromkeys(topics, msgtype), dict.fromkeys(topics, 10), looks, (), ())


@pytest.mark.parametrize("order", [*permutations(["/b/dvl", "/a/dvl", "/c/dvl"])], ids=" ".join)
def test_of_dvls_that_are_alike_the_first_by_name_is_taken_in_whatever_order_they_are_recorded(order):
    assert choose_dvl(survey(*order), "dvl/twist", "bag") == "/a/dvl"


@pytest.mark.parametrize("order", [*permutations(["/b/gps", "/a/gps", "/c/gps"])], ids=" ".join)
def test_of_references_that_are_alike_the_first_by_name_is_taken_and_the_others_are_named(order):
    chosen, said = choose_reference(survey("/dvl", *order), "gnss/twist", "/dvl", lambda dvl, other: None)
    assert chosen == "/a/gps"
    assert [(each.code, each.numbers["others"]) for each in said] == [("SEVERAL_REFERENCES", "/b/gps, /c/gps")]


@pytest.mark.parametrize("order", [*permutations(["/b/imu", "/a/imu", "/c/imu"])], ids=" ".join)
def test_of_imus_that_are_alike_the_first_by_name_is_taken(order):
    assert choose_imu(survey(*order, msgtype=IMU_TYPE), "imu/data") == "/a/imu"


@pytest.mark.parametrize(
    ("topic", "msgtype", "may_be"),
    [
        ("/a50/velocity", TWIST_TYPE, True),
        ("/nav/velocity", TWIST_TYPE, False),
        ("/dvl/filtered", TWIST_TYPE, False),
        ("/anything", "dvl_msgs/msg/DVL", True),
        ("/dvl/imu", IMU_TYPE, False),
    ],
)
def test_a_topic_may_be_a_dvls_by_its_type_or_its_name(topic, msgtype, may_be):
    assert may_be_dvl(topic, msgtype) == may_be
