"""The executor that the node's program runs in: sensors' messages go to the node by a short way.

An rclpy executor builds a wait set in Python, entity by entity, twice for every callback, and makes a task of each;
that is two thirds of the CPU of a subscriber at 50 Hz. Here the wait set is filled in one go, and when only sensors'
messages have come, the node takes them itself, as it does anyway (`inbox`). All else, services, parameters, timers,
events of the middleware, is left to rclpy, in its own order, as soon as any of it is there.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation

if TYPE_CHECKING:
    from .calibration_node import CalibrationNode

_OTHER_KINDS = ("timer", "service", "client")
# of rclpy.waitable.NumberOfEntities, in the order in which a wait set is told
_COUNTS = ("num_subscriptions", "num_guard_conditions", "num_timers", "num_clients", "num_services", "num_events")


class _Entities(NamedTuple):
    """What is waited for."""

    inputs: list[Any]
    subscriptions: list[Any]
    guards: list[Any]
    timers: list[Any]
    clients: list[Any]
    services: list[Any]
    waitables: list[Any]


class ReceivingExecutor(SingleThreadedExecutor):
    """Runs one node."""

    def __init__(self, node: CalibrationNode) -> None:
        super().__init__(context=node.context)
        # rclpy's own is not for others to wait for
        self._woken = GuardCondition(None, None, context=node.context)
        self._node = node
        self._unfinished: deque[Any] = deque()  # other threads add to it
        self._entities: _Entities | None = None
        self._wait_set: Any = None
        self._once_more = False
        self.add_node(node)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """As rclpy's; from any thread."""
        task = super().create_task(callback, *args, **kwargs)
        self._unfinished.append(task)
        self._woken.trigger()
        return task

    def wake(self) -> None:
        """As rclpy's."""
        super().wake()
        self._woken.trigger()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until there is something to do, but no longer than so (s), and do some of it."""
        if self._once_more:
            timeout_sec = 0.0
        inputs_ready, others_ready = self._wait(-1 if timeout_sec is None else round(timeout_sec * 1e9))
        if others_ready or self._once_more:  # what is said of the vehicle may come before what it measures
            super().spin_once(timeout_sec=0.0)
        elif inputs_ready:
            self._node.deliver()
        while self._unfinished and self._unfinished[0].done():
            self._unfinished.popleft()
        # one call does one thing, and a callback may have given it more to do
        self._once_more = others_ready or bool(self._unfinished)

    def _wait(self, timeout_ns: int) -> tuple[bool, bool]:
        """Wait (-1: for ever); whether sensors' messages have come, and whether anything else has."""
        entities = self._gathered()
        wait_set = self._filled(entities)
        wait_set.wait(timeout_ns)
        n_inputs = len(entities.inputs)
        ready = [wait_set.is_ready("subscription", n) for n in range(n_inputs + len(entities.subscriptions))]
        others = any(ready[n_inputs:]) or any(wait_set.get_ready_entities(kind) for kind in _OTHER_KINDS)
        if guards_ready := wait_set.get_ready_entities("guard_condition"):
            others = True
            for guard in self._node.guards:  # waiting has taken what rclpy is to be told as well
                if guard.handle.pointer in guards_ready:
                    guard.trigger()
        return any(ready[:n_inputs]), others or any(each.is_ready(wait_set) for each in entities.waitables)

    def _gathered(self) -> _Entities:
        node, inputs = self._node, list(self._node.inputs)
        return _Entities(
            inputs,
            [each for each in node.subscriptions if each not in inputs],
            [*node.guards, self._woken],
            list(node.timers),
            list(node.clients),
            list(node.services),
            list(node.waitables),
        )

    def _filled(self, entities: _Entities) -> Any:
        """The wait set with all of them in it: those that were not ready leave it with every waiting."""
        if entities != self._entities:
            counts = [sum(getattr(each.get_num_entities(), name) for each in entities.waitables) for name in _COUNTS]
            own = [len(entities.inputs) + len(entities.subscriptions), *map(len, entities[2:6]), 0]
            sizes = [mine + others for mine, others in zip(own, counts, strict=True)]
            self._wait_set = rclpy_implementation.WaitSet(*sizes, self.context.handle)
            self._entities = entities
        wait_set = self._wait_set
        wait_set.clear_entities()
        for subscription in entities.inputs:
            wait_set.add_subscription(subscription.handle)
        for subscription in entities.subscriptions:
            wait_set.add_subscription(subscription.handle)
        for guard in entities.guards:
            wait_set.add_guard_condition(guard.handle)
        for timer in entities.timers:
            wait_set.add_timer(timer.handle)
        for client in entities.clients:
            wait_set.add_client(client.handle)
        for service in entities.services:
            wait_set.add_service(service.handle)
        for waitable in entities.waitables:
            waitable.add_to_wait_set(wait_set)
        return wait_set
