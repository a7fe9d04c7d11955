"""A ROS domain that nobody on this host is on, nor is about to be."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="participants need ROS 2: pip install '.[ros]'")

from command_line import fail
from conftest import ROOT
from ros import World

from dvl_calib_ros.cli import demo
from dvl_calib_ros.errors import InputError


def test_a_domain_with_a_participant_is_not_free_and_without_a_free_one_the_demo_says_so(monkeypatch, capsys):
    world = World()
    monkeypatch.setattr(demo, "DOMAINS", range(world.domain, world.domain + 1))
    demo.give_back(world.domain)
    with pytest.raises(InputError, match="every ROS domain"):
        demo.take_domain()
    assert "every ROS domain from" in fail(capsys, "demo")
    assert demo._claim_domain(world.domain)
    world.close()
    assert demo.take_domain() == world.domain
    demo.give_back(world.domain)


def test_of_many_that_ask_at_once_before_any_participant_is_there_no_two_get_one_domain():
    script = (
        "from dvl_calib_ros.cli.demo import take_domain\n"
        "print(*(take_domain() for _ in range(15)), flush=True)\ninput()"
    )
    command = [sys.executable, "-c", script]
    asking = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) for _ in range(4)
    ]
    got = [number for process in asking for number in process.stdout.readline().split()]
    for process in asking:
        process.communicate("end\n")
        assert process.returncode == 0
    assert len(got) == len(set(got)) == 60


def test_a_domain_is_free_again_when_the_process_that_took_it_was_killed(monkeypatch):
    script = "from dvl_calib_ros.cli.demo import take_domain\nprint(take_domain(), flush=True)\ninput()"
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    taken = int(process.stdout.readline())
    monkeypatch.setattr(demo, "DOMAINS", range(taken, taken + 1))
    with pytest.raises(InputError, match="every ROS domain"):
        demo.take_domain()
    process.kill()
    process.communicate()
    assert demo.take_domain() == taken
    demo.give_back(taken)
