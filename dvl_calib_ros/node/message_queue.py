"""Messages of several subscriptions in the order in which they arrived.

An executor takes one message of each topic in turn. After a stall a DVL at 5 Hz would so run ahead of an IMU at 100 Hz
by nearly the length of the stall, and go on without it where that is longer than max_latency.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from rclpy.exceptions import InvalidHandle
from rclpy.subscription import Subscription

# Messages that are taken in one go; then services and timers have their turn.
ROUND = 1000
Input = TypeVar("Input")


class Arrived(NamedTuple):
    """A message and when it arrived (ns, system clock)."""

    message: Any
    at_ns: int

    @classmethod
    def of(cls, message: Any, info: Mapping[str, int]) -> Arrived:
        """A message as rclpy gives it. A middleware that does not say when it came says when it was sent."""
        return cls(message, info["received_timestamp"] or info["source_timestamp"])


def take(subscription: Subscription) -> Arrived | None:
    """The next message that waits in a subscription; None if there is none."""
    try:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    except InvalidHandle:  # destroyed, as by the executor of a node that ends
        return None
    return None if taken is None else Arrived.of(*taken)


def in_order_of_arrival(
    inputs: Mapping[str, Input],
    take_from: Callable[[Input], Arrived | None],
    taken: Mapping[str, Arrived],
    at_most: int = ROUND,
    ready: Collection[str] | None = None,
) -> Iterator[tuple[str, Any]]:
    """Topic and message of all that waits, oldest first; those of one topic in the order in which they are taken.

    inputs: by topic, what messages are taken from. taken: what was taken before of some of them. at_most: how many
    more are taken. ready: on which alone something waited a moment ago, if that is known: while these bring no second
    message, the others are not asked, for to find that nothing waits costs a third of what a message does.
    """
    heads, left = dict(taken), at_most

    def take_more(names: Iterable[str]) -> bool:
        nonlocal left
        before = left
        for name in names:
            if left and name not in heads and (arrived := take_from(inputs[name])) is not None:
                heads[name] = arrived
                left -= 1
        return left < before

    take_more(inputs if ready is None else ready)
    while heads:
        oldest = min(heads, key=lambda name: heads[name].at_ns)
        yield oldest, heads.pop(oldest).message
        if ready is None:
            take_more(inputs)
        elif take_more(ready):  # what came by the others meanwhile may be older
            ready = None
            take_more(inputs)
