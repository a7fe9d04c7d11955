"""Start and stop of the node: arguments, signals, exit codes, and return of memory to the system.

Slow imports are inside functions, so that signals are handled from the first moment.

By default glibc keeps the memory of large freed arrays and fragments it with small ones, so a node's memory grows for
hours although it holds no more than at the start.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription

if TYPE_CHECKING:
    from pathlib import Path

    from .calibration_node import CalibrationNode
    from .shutdown import Ending


# Executor of the node's program, with a fast path for sensor messages.
#
# An rclpy executor rebuilds its wait set in Python twice for every callback, entity by entity, and makes a task of each
# callback. This takes two thirds of a subscriber's CPU time at 50 Hz. Here the wait set is collected once, and if only
# sensor messages arrive, the node takes them itself. Services, parameters, timers and events of the middleware are left
# to rclpy in its own order, as soon as one is ready.

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
        self._once_more = False
        self.add_node(node)

    def create_task(self, callback: Any, *args: Any, **kwargs: Any) -> Any:
        """Create a task as rclpy; from any thread."""
        task = super().create_task(callback, *args, **kwargs)
        self._unfinished.append(task)
        self._woken.trigger()
        return task

    def wake(self) -> None:
        """Wake up as rclpy; called after the node created or destroyed an entity."""
        self._waiting = None
        super().wake()
        self._woken.trigger()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until something is ready, at most `timeout_sec` seconds, and handle some of it."""
        if self._once_more:
            timeout_sec = 0.0
        waiting = self._waiting
        if waiting is None:
            waiting = self._waiting = _Waiting(self._node, self._woken)
        inputs, others_ready = waiting.wait(-1 if timeout_sec is None else round(timeout_sec * 1e9))
        if others_ready or self._once_more:  # the configuration of the vehicle may come before its measurements
            super().spin_once(timeout_sec=0.0)
        elif inputs:
            self._node.deliver(inputs)
        while self._unfinished and self._unfinished[0].done():
            self._unfinished.popleft()
        # one call handles one item, and a callback may have added more
        self._once_more = others_ready or bool(self._unfinished)


# A computing thread yields to one with a message after this time, s; Python's default is 0.005.
GIVES_WAY_S = 0.0005
# option: standard input is a pipe, and the node ends when its other end closes
ENDS_WITH_STDIN = "--ends-with-stdin"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until a signal or a closed pipe ends it.

    Returns 0; 1 if the result could not be saved, and was printed; 2 for a bad configuration (one line on standard
    error).
    """
    try:
        from ..standard_streams import open_streams
        from .shutdown import Ending

        open_streams()
        given = list(sys.argv[1:] if args is None else args)
        with_parent = ENDS_WITH_STDIN in given
        with Ending(closed=sys.stdin.fileno() if with_parent else None) as ending:
            return run_until(ending, [arg for arg in given if arg != ENDS_WITH_STDIN])
    except KeyboardInterrupt:  # before `Ending` was set up, so nothing was started
        return 0


def run_until(ending: Ending, args: Sequence[str]) -> int:
    """Run the node as `main`, until `ending` is requested."""
    from ..errors import InputError, needing_ros

    try:
        with needing_ros("the node"):
            import rclpy
            from rclpy.signals import SignalHandlerOptions

            from ..calibration.models.parameters import ParameterError
            from .calibration_node import CalibrationNode
    except InputError as error:
        return _refused(error)
    if ending.requested:
        return 0
    try:
        rclpy.init(args=["calibration_node", *args], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises its own types for bad --ros-args and unreadable parameter files
        return _refused(error)
    node, is_saved = None, True
    give_back_at_once()
    sys.setswitchinterval(GIVES_WAY_S)
    try:
        node = CalibrationNode(parameter_files(args))
        executor = ReceivingExecutor(node)
        gc.freeze()  # objects of the start stay; a collection that examines them would delay a message by 0.01 s
        # spin_until_future_complete would keep one more callback for every message
        ending.tell(lambda: executor.create_task(lambda: None))
        while not ending.requested:
            executor.spin_once()
    except (ParameterError, InputError) as error:
        return _refused(error)
    finally:
        ending.heard()
        if node is not None:
            is_saved = node.finish()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0 if is_saved else 1


def parameter_files(args: Sequence[str]) -> list[Path]:
    """Return the parameter files in ROS arguments, as rcl reads them: between --ros-args and --."""
    from pathlib import Path

    files, is_ros = [], False
    for word, following in zip(args, [*args[1:], ""], strict=False):
        if word in ("--ros-args", "--"):
            is_ros = word == "--ros-args"
        elif is_ros and word == "--params-file":
            files.append(Path(following))
    return files


def _refused(error: Exception | str) -> int:
    from ..standard_streams import say

    say(f"calibration_node: {' '.join(str(error).split())}")
    return 2


# mallopt(3): setting these disables glibc's automatic increase after a large array is freed
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Smallest array, bytes, with its own memory mapping; arrays of one message are smaller.
LARGE = 1 << 17


def give_back_at_once() -> bool:
    """Make glibc return large arrays to the system when they are freed. Return False without glibc."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no glibc
        return False
    return all(mallopt(what, LARGE) for what in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


if __name__ == "__main__":
    sys.exit(main())
