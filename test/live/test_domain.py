"""A ROS domain that nobody on this host is on."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="participants need ROS 2: pip install '.[ros]'")

from command_line import fail
from ros import World

from dvl_calib_ros.errors import InputError
from dvl_calib_ros.node import domain


def test_a_domain_with_a_participant_is_not_free_and_without_a_free_one_the_demo_says_so(monkeypatch, capsys):
    world = World()
    monkeypatch.setattr(domain, "DOMAINS", range(world.domain, world.domain + 1))
    with pytest.raises(InputError, match="every ROS domain"):
        domain.free_domain()
    assert "every ROS domain from" in fail(capsys, "demo")
    world.close()
    assert domain.free_domain() == world.domain
