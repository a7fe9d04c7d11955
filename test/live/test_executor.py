"""The node's own executor: messages by a short way, and everything else as any executor does it."""

from __future__ import annotations

import threading
import time

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

import rclpy
from rclpy.node import Node
from ros import until
from std_msgs.msg import String
from std_srvs.srv import Trigger

from dvl_calib_ros.node.executor import ReceivingExecutor

FLOOD = 2000


class Hearing(Node):
    """Notes what it hears by which way."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("hearing", context=context)
        self.said: list[str] = []
        self.ticks = 0
        self.asked = 0
        self.turns = 0
        self.of_executor: list[str] = []
        self.create_subscription(String, "other", lambda message: self.of_executor.append(message.data), 10)
        self.inputs = [self.create_subscription(String, "said", lambda message: self.said.append(message.data), FLOOD)]
        self.create_service(Trigger, "ask", self._on_ask)
        self.create_timer(0.02, self._on_tick)

    def _on_tick(self) -> None:
        self.ticks += 1

    def _on_ask(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.asked += 1
        return response

    def deliver(self, ready) -> None:
        for each in ready:
            while taken := each.handle.take_message(each.msg_type, each.raw):
                self.said.append(taken[0].data)


@pytest.fixture
def running(world):
    """A node that is run by the executor in a thread, and the executor."""
    node = Hearing(world.context)
    executor = ReceivingExecutor(node)
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            executor.spin_once()
            node.turns += 1

    thread = threading.Thread(target=run)
    thread.start()
    yield node, executor
    ended.set()
    executor.wake()
    thread.join(10.0)
    assert not thread.is_alive()
    executor.shutdown()
    node.destroy_node()


def publishers(world) -> list:
    """Of what is said and of other things, heard by the node."""
    made = [world.node.create_publisher(String, topic, FLOOD) for topic in ("said", "other")]
    for publisher in made:
        until(publisher.get_subscription_count, "the node")
    return made


def test_messages_topics_services_timers_and_parameters_all_have_their_turn_under_a_flood(world, running):
    node, _ = running
    said, other = publishers(world)
    for number in range(FLOOD):
        said.publish(String(data=str(number)))
    other.publish(String(data="else"))
    ticks = node.ticks
    world.call(Trigger, "ask")
    until(lambda: len(node.said) == FLOOD and node.of_executor, "all that was said")
    assert node.said == [str(number) for number in range(FLOOD)] and node.of_executor == ["else"]
    until(lambda: node.ticks > ticks + 2, "the timer")
    assert node.asked >= 1


def test_what_came_by_another_topic_before_the_messages_is_dealt_with_before_them(world):
    node = Hearing(world.context)
    order: list[str] = []
    node.of_executor = node.said = order
    said, other = publishers(world)
    other.publish(String(data="first"))
    for number in range(100):
        said.publish(String(data=str(number)))
    time.sleep(1.0)  # all is there before anybody looks
    executor = ReceivingExecutor(node)
    while len(order) < 101:
        executor.spin_once(timeout_sec=10.0)
    assert order == ["first", *map(str, range(100))]
    executor.shutdown()
    node.destroy_node()


def test_work_that_another_thread_gives_it_is_done_at_once_though_nothing_else_comes(running):
    node, executor = running
    for timer in node.timers:
        timer.cancel()
    time.sleep(0.1)
    for _ in range(3):
        done = [threading.Event() for _ in range(3)]
        for each in done:
            executor.create_task(each.set)
        assert all(each.wait(10.0) for each in done)


def test_a_guard_condition_of_the_node_calls_its_callback(running):
    node, executor = running
    called = threading.Event()
    guards: list[rclpy.guard_condition.GuardCondition] = []
    executor.create_task(lambda: guards.append(node.create_guard_condition(called.set)))
    until(lambda: guards, "the guard condition")
    guards[0].trigger()
    assert called.wait(10.0)


def test_what_is_subscribed_or_given_up_while_it_runs_is_heard_or_not(world, running):
    node, executor = running
    publisher = world.node.create_publisher(String, "later", 10)
    heard: list[str] = []
    executor.create_task(lambda: node.create_subscription(String, "later", lambda m: heard.append(m.data), 10))
    until(lambda: publisher.get_subscription_count(), "the new subscription")
    publisher.publish(String(data="one"))
    until(lambda: heard, "what was said after")
    executor.create_task(lambda: node.destroy_subscription(list(node.subscriptions)[-1]))
    until(lambda: not publisher.get_subscription_count(), "the end of the subscription")
    publisher.publish(String(data="two"))
    ticks = node.ticks
    until(lambda: node.ticks > ticks + 3, "the timer, still")
    assert heard == ["one"]


def test_without_anything_to_do_it_waits_and_does_not_go_round(running):
    node, _ = running
    for timer in node.timers:
        timer.cancel()
    time.sleep(0.2)
    before = node.turns
    time.sleep(0.5)
    assert node.turns - before < 5
