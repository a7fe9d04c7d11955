"""What waits on several topics is taken in the order in which it arrived."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2: pip install '.[ros]'")

from hypothesis import given
from hypothesis import strategies as st

from dvl_calib_ros.node.message_queue import Arrived, in_order_of_arrival


def take(queue):
    return queue.pop(0) if queue else None


def arrivals(topic, times):
    return [Arrived((topic, number, at), at) for number, at in enumerate(times)]


def taken_in_rounds(queues, at_most):
    """All messages, as an executor calls: again and again with the first of a topic on which something waits."""
    got = []
    while any(queues.values()):
        topic = next(topic for topic, queue in queues.items() if queue)
        first = {topic: queues[topic].pop(0)}
        got.append([message for _, message in in_order_of_arrival(queues, take, first, at_most)])
    return got


TIMES = st.lists(st.integers(0, 50), max_size=30)


@given(st.tuples(TIMES, TIMES, TIMES))
def test_all_is_taken_once_and_in_order_if_each_topic_is(times):
    queues = {topic: arrivals(topic, sorted(each)) for topic, each in zip("abc", times, strict=True)}
    expected = sorted(message for queue in queues.values() for message, _ in queue)
    rounds = taken_in_rounds(queues, at_most=1000)
    assert len(rounds) <= 1
    got = [message for each in rounds for message in each]
    assert [at for _, _, at in got] == sorted(at for _, _, at in expected)
    assert sorted(got) == expected


@given(st.tuples(TIMES, TIMES, TIMES), st.integers(0, 5))
def test_a_topic_keeps_its_own_order_whatever_the_times_and_however_little_is_taken_in_one_go(times, at_most):
    queues = {topic: arrivals(topic, each) for topic, each in zip("abc", times, strict=True)}
    rounds = taken_in_rounds(queues, at_most)
    assert all(len(each) <= at_most + 1 for each in rounds)
    got = [message for each in rounds for message in each]
    for topic, each in zip("abc", times, strict=True):
        assert [number for name, number, _ in got if name == topic] == list(range(len(each)))


def test_where_the_middleware_does_not_say_when_a_message_came_the_time_of_sending_counts():
    assert Arrived.of("it", {"received_timestamp": 0, "source_timestamp": 7}) == ("it", 7)
    assert Arrived.of("it", {"received_timestamp": 8, "source_timestamp": 7}) == ("it", 8)


def test_while_one_message_of_each_comes_only_those_are_asked_that_have_one_else_all_are_and_the_oldest_is_first():
    """To ask two topics in vain for every message, and once more all three, was a tenth of the node's CPU."""
    asked: list[str] = []

    def noted(queue):
        asked.append(next(topic for topic, each in queues.items() if each is queue))
        return take(queue)

    queues = {"a": arrivals("a", [3]), "b": arrivals("b", [1]), "c": arrivals("c", [0])}
    got = [topic for topic, _ in in_order_of_arrival(queues, noted, {}, ready=["a", "b"])]
    assert got == ["b", "a"] and set(asked) == {"a", "b"}
    queues = {"a": arrivals("a", [3, 9]), "b": arrivals("b", [4]), "c": arrivals("c", [5])}
    assert [at for _, (*_, at) in in_order_of_arrival(queues, noted, {}, ready=["a"])] == [3, 4, 5, 9]
