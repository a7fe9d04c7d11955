"""What the live tests stand on."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

import rclpy
import ros
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from ros import World
from std_srvs.srv import Trigger


def test_a_service_is_heard_whose_every_answer_comes_later_than_it_is_asked_again(monkeypatch):
    """On a machine that is so busy, "no answer" was said of a node that had answered every call."""
    monkeypatch.setattr(ros, "RETRY_S", 0.2)
    world, context = World(), rclpy.Context()
    rclpy.init(context=context, domain_id=world.domain)
    server = rclpy.create_node("server", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(server)

    def slow(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time.sleep(0.5)
        response.success = True
        return response

    server.create_service(Trigger, "slow", slow)
    spinning = threading.Thread(target=spin, args=(executor,))
    spinning.start()
    try:
        assert world.call(Trigger, "slow").success
    finally:
        executor.shutdown()
        spinning.join()
        rclpy.shutdown(context=context)
        world.close()


def spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException, ShutdownException):
        executor.spin()
