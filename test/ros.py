"""A ROS 2 world of one's own for a test: a domain that nobody else is on, this host only."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import pytest
import rclpy
from conftest import ROOT
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter, parameter_value_to_python

from dvl_calib_ros.cli.demo import give_back, take_domain
from dvl_calib_ros.node.main import main

PATIENCE_S = 60.0
RETRY_S = 3.0
NODE = "dvl_calibration"


def until(condition: Callable[[], Any], what: str | Callable[[], str]) -> Any:
    """Wait for a condition; fail, saying for what, if it does not come."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        late = time.monotonic() > deadline
        assert not late, f"waited {PATIENCE_S:.0f} s in vain for {what if isinstance(what, str) else what()}"
        time.sleep(0.01)
    return value


def refused_at_start(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What a node says on standard error that refuses to start, in this process, with ROS arguments."""
    capfd.readouterr()
    assert main(["--ros-args", *arguments]) == 2
    return capfd.readouterr().err


class World:
    """A domain with a client node that is spun in the background."""

    def __init__(self) -> None:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.domain = take_domain()
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=self.domain)
        self.node = rclpy.create_node("test_client", context=self.context)
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._ends = False
        self._spinning = threading.Thread(target=self._spin, daemon=True)
        self._spinning.start()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while self.context.ok() and not self._ends:
                with suppress(InvalidHandle):  # a test has destroyed what was about to be waited for
                    self._executor.spin()

    def close(self) -> None:
        self._ends = True
        self._executor.shutdown()
        self._spinning.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)
        give_back(self.domain)

    def call(self, service_type: type, name: str, request: Any = None) -> Any:
        """Answer of a service.

        A client is kept for later calls: an answer to a client that the server has only just discovered can get lost
        in the middleware, and then the call is made again. Whichever call is answered first counts: on a busy machine
        each answer may take longer than that.
        """
        if name not in self._clients:
            self._clients[name] = self.node.create_client(service_type, name)
            assert self._clients[name].wait_for_service(PATIENCE_S), f"no service {name}"
        answers: list[Any] = []
        answered = threading.Event()

        def on_answer(future: Any) -> None:
            answers.append(future.result())
            answered.set()

        for _ in range(round(PATIENCE_S / RETRY_S)):
            self._clients[name].call_async(request or service_type.Request()).add_done_callback(on_answer)
            if answered.wait(RETRY_S):
                return answers[0]
        raise AssertionError(f"no answer from {name}")

    def set_parameter(self, name: str, value: Any) -> Any:
        message: ParameterMessage = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self.call(SetParameters, f"{NODE}/set_parameters", request).results[0]

    def parameter(self, name: str) -> Any:
        request = GetParameters.Request(names=[name])
        return parameter_value_to_python(self.call(GetParameters, f"{NODE}/get_parameters", request).values[0])

    def received(self, message_type: type, topic: str, qos: Any = 10, publisher: Any = None) -> list[Any]:
        """A list that fills with what comes on a topic, once subscriber and publisher have found each other.

        publisher: the publisher itself, where it is in this process: only it knows when it has found us.
        """
        messages: list[Any] = []
        subscription = self.node.create_subscription(message_type, topic, messages.append, qos)
        until(lambda: subscription.get_publisher_count() > 0, f"a publisher of {topic}")
        if publisher is not None:
            until(lambda: publisher.get_subscription_count() > 0, f"the publisher of {topic} to find its subscriber")
        return messages

    @contextmanager
    def calibration_node(
        self,
        *ros_arguments: str,
        stop: signal.Signals = signal.SIGINT,
        entry: Sequence[str] = ("-m", "dvl_calib_ros.node.main"),
    ):
        """The node in a process of its own, with (name:=value) parameters; stopped at the end.

        entry: what Python is to run.
        """
        command = [sys.executable, *entry, "--ros-args"]
        for argument in ros_arguments:
            command += ["-p", argument]
        environment = os.environ | {"ROS_DOMAIN_ID": str(self.domain), "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT
        )
        try:
            yield process
            process.send_signal(stop)
            process.output = process.communicate(timeout=PATIENCE_S)[0]  # type: ignore[attr-defined]
        finally:
            process.kill()
            process.wait()
