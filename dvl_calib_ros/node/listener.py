"""Client of a calibration node anywhere on the domain: receives its /diagnostics and calls its services."""

from __future__ import annotations

import itertools
import sys
import time
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from ..errors import printable
from .services import AnsweringNode, init_ros
from .status import Status, status_name

# services of the node
SERVICES = ("save", "save_anyway", "reset")


class Listener:
    """Context manager with its own node in its own ROS context, without signal handlers.

    node: full name of the calibration node. Raises InputError for bad --ros-args.
    """

    def __init__(self, node: str) -> None:
        self._status_name = status_name(node)
        self._full_name = f"/{node.strip('/')}"
        self.answer = ""
        """Answer to the last call."""
        self.is_waiting = False
        """Whether the last call is still unanswered."""

    def __enter__(self) -> Listener:
        """Start a node that listens to /diagnostics and can call the services of the calibration node."""
        self._context = rclpy.Context()
        # without the command's own -p NAME:=VALUE, which ROS takes for a remapping and warns of on the view
        ros_arguments = list(itertools.dropwhile(lambda word: word != "--ros-args", sys.argv))
        init_ros(ros_arguments, self._context)
        self._node = AnsweringNode("dvl_calib_watch", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._latest: Status | None = None
        self._clients = {name: self._node.create_client(Trigger, f"{self._full_name}/{name}") for name in SERVICES}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def latest(self, wait_s: float) -> Status | None:
        """Listen for `wait_s` seconds and return the latest status, also an earlier one."""
        deadline = time.monotonic() + wait_s
        while (remaining := deadline - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=remaining)
        return self._latest

    def call(self, service: str) -> None:
        """Call one of `SERVICES`. The result is in `answer` after `latest` has received it."""
        client = self._clients[service]
        if not client.service_is_ready():
            self.answer, self.is_waiting = f"{service}: the node does not answer", False
            return
        self.answer, self.is_waiting = f"{service} ...", True
        client.call_async(Trigger.Request()).add_done_callback(self._on_answer)

    def _on_answer(self, future: Any) -> None:
        """Keep the answer of a service with its time."""
        error = future.exception()
        text = printable(future.result().message if error is None else str(error))
        self.is_waiting = False
        self.answer = f"{time.strftime('%H:%M:%S')} {text}"  # the time distinguishes equal answers

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep the newest status of the watched node."""
        for status in message.status:
            if status.name == self._status_name:
                values = {item.key: item.value for item in status.values}
                self._latest = Status(ord(status.level), status.message, values, time.monotonic())
