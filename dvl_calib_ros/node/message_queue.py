"""Messages of several subscriptions in order of arrival.

An executor takes one message per topic in turn. After a stall, a DVL at 5 Hz would overtake an IMU at 100 Hz by nearly
the length of the stall, and be used without the IMU if that exceeds max_latency.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from rclpy.exceptions import InvalidHandle
from rclpy.subscription import Subscription

# messages that wait in the middleware while Python is busy: 5 s at 1 kHz
QUEUE = 5000
# messages taken before services and timers get their turn
ROUND = 1000
Input = TypeVar("Input")


class Arrived(NamedTuple):
    """A message and its time of arrival (ns, system clock)."""

    message: Any
    at_ns: int

    @classmethod
    def of(cls, message: Any, info: Mapping[str, int]) -> Arrived:
        """Wrap a message of rclpy. Some middlewares report the time of sending instead of arrival."""
        return cls(message, info["received_timestamp"] or info["source_timestamp"])


def take(subscription: Subscription) -> Arrived | None:
    """Take the next waiting message of a subscription; None if there is none."""
    try:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    except InvalidHandle:  # destroyed, for example by the executor of a node that ends
        return None
    return None if taken is None else Arrived.of(*taken)


def in_order_of_arrival(
    inputs: Mapping[str, Input],
    take_from: Callable[[Input], Arrived | None],
    taken: Mapping[str, Arrived],
    at_most: int = ROUND,
    ready: Collection[str] | None = None,
) -> Iterator[tuple[str, Any]]:
    """Yield topic and message of all waiting messages, oldest first; messages of one topic keep their order.

    inputs: sources by topic.
    taken: messages already taken from some of them.
    at_most: limit of further messages.
    ready: the only topics with messages a moment ago, if known. While these have no second message, the others are not
      polled: an empty poll costs a third of a message.
    """
    oldest_by_topic, remaining = dict(taken), at_most

    def take_more(names: Iterable[str]) -> bool:
        """Take the first waiting message of each named input without one. Return whether any arrived."""
        nonlocal remaining
        before = remaining
        for name in names:
            if remaining and name not in oldest_by_topic and (arrived := take_from(inputs[name])) is not None:
                oldest_by_topic[name] = arrived
                remaining -= 1
        return remaining < before

    take_more(inputs if ready is None else ready)
    while oldest_by_topic:
        oldest = min(oldest_by_topic, key=lambda name: oldest_by_topic[name].at_ns)
        yield oldest, oldest_by_topic.pop(oldest).message
        if ready is None:
            take_more(inputs)
        elif take_more(ready):  # a message that arrived meanwhile on another topic may be older
            ready = None
            take_more(inputs)
