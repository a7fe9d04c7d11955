"""Executor of the node's program, with a fast path for sensor messages.

An rclpy executor rebuilds its wait set in Python twice for every callback, entity by entity, and makes a task of each
callback. This takes two thirds of a subscriber's CPU time at 50 Hz. Here the wait set is collected once, and if only
sensor messages arrive, the node takes them itself. Services, parameters, timers and events of the middleware are left
to rclpy in its own order, as soon as one is ready.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription

if TYPE_CHECKING:
    from .calibration_node import CalibrationNode

# attributes of rclpy.waitable.NumberOfEntities, in the order of a wait set's arguments
_COUNTS = ("num_subscriptions", "num_guard_conditions", "num_timers", "num_clients", "num_services", "num_events")


class _Waiting:
    """Wait set with the node's current entities and a guard condition."""

    def __init__(self, node: CalibrationNode, woken: GuardCondition) -> None:
        self.inputs = list(node.inputs)
        others = [
            each
            for each in node.subscriptions
            # subscriptions that no executor serves are polled elsewhere
            if each not in self.inputs and each.callback_group.can_execute(each)
        ]
        self.guards, self.waitables = list(node.guards), list(node.waitables)
        kinds: list[tuple[str, list[Any]]] = [
            ("subscription", [*self.inputs, *others]),
            ("guard_condition", [*self.guards, woken]),
            ("timer", list(node.timers)),
            ("client", list(node.clients)),
            ("service", list(node.services)),
        ]
        inside = [sum(getattr(each.get_num_entities(), name) for each in self.waitables) for name in _COUNTS]
        sizes = [own + within for own, within in zip([*(len(each) for _, each in kinds), 0], inside, strict=True)]
        self._wait_set = rclpy_implementation.WaitSet(*sizes, node.context.handle)
        self._add = [(getattr(self._wait_set, f"add_{kind}"), each.handle) for kind, all_ in kinds for each in all_]

    def wait(self, timeout_ns: int) -> tuple[list[Subscription], bool]:
        """Wait (-1: for ever). Return the inputs with messages, and whether anything else is ready."""
        wait_set = self._wait_set
        wait_set.clear_entities()  # waiting removes the entities that were not ready
        for add, handle in self._add:
            add(handle)
        for waitable in self.waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(timeout_ns)
        inputs = [each for number, each in enumerate(self.inputs) if wait_set.is_ready("subscription", number)]
        others = len(wait_set.get_ready_entities("subscription")) > len(inputs)
        others = others or any(wait_set.get_ready_entities(kind) for kind in ("timer", "client", "service"))
        if ready := wait_set.get_ready_entities("guard_condition"):
            others = True
            for guard in self.guards:  # waiting has consumed the trigger that rclpy must see, too
                if guard.handle.pointer in ready:
                    guard.trigger()
        return inputs, others or any(each.is_ready(wait_set) for each in self.waitables)


class ReceivingExecutor(SingleThreadedExecutor):
    """Executor for one node."""

    def __init__(self, node: CalibrationNode) -> None:
        super().__init__(context=node.context)
        # rclpy does not share its own guard condition
        self._woken = GuardCondition(None, None, context=node.context)
        self._node = node
        self._unfinished: deque[Any] = deque()  # other threads append
        self._waiting: _Waiting | None = None
        self._is_more_ready = False
        self.add_node(node)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Create a task, as rclpy's executor does. Any thread may call this."""
        task = super().create_task(callback, *args, **kwargs)
        self._unfinished.append(task)
        self._woken.trigger()
        return task

    def wake(self) -> None:
        """Wake the executor up. rclpy calls this after the node created or destroyed an entity."""
        self._waiting = None
        super().wake()
        self._woken.trigger()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until something is ready, at most `timeout_sec` seconds, and handle some of it."""
        if self._is_more_ready:
            timeout_sec = 0.0
        waiting = self._waiting
        if waiting is None:
            waiting = self._waiting = _Waiting(self._node, self._woken)
        inputs, others_ready = waiting.wait(-1 if timeout_sec is None else round(timeout_sec * 1e9))
        if others_ready or self._is_more_ready:  # the configuration of the vehicle may come before its measurements
            super().spin_once(timeout_sec=0.0)
        elif inputs:
            self._node.deliver(inputs)
        while self._unfinished and self._unfinished[0].done():
            self._unfinished.popleft()
        # one call handles one item, and a callback may have added more
        self._is_more_ready = others_ready or bool(self._unfinished)
