"""Observer of the node for the demo, while a bag is played to it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistWithCovarianceStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rich.console import Group
from rich.table import Table

from ..calibration.results.results import NOT_ESTIMATED
from ..files.parameter_files import NODE_NAME
from ..node.calibration_node import QUEUE
from ..node.services import LATCHED, AnsweringNode
from ..recordings.topics import Topics
from .player import BagPlayer

# place in the covariance diagonal of ~/estimate, factor to the displayed unit
SHOWN = {
    "phi_x": ("φx °", 3, math.degrees(1.0)),
    "phi_y": ("φy °", 4, math.degrees(1.0)),
    "phi_z": ("φz °", 5, math.degrees(1.0)),
    "delta_k": ("δk %", 0, 100.0),
}

# keys of the node's counts of messages received
RECEIVED = {Topics.dvl: "dvl received", Topics.gnss: "reference received", Topics.imu: "imu received"}
# A busy machine falls behind a bag played fast. At most this number of messages of a topic may wait, half of the node's
# queue. A node silent for PATIENCE_S is not waited for.
WAITING, PATIENCE_S = QUEUE // 2, 30.0


class Watcher:
    """Player of bags to the node, with the node's answers for `render`. truth: in degrees and per cent."""

    def __init__(self, paths: Sequence[Path], truth: Mapping[str, float]) -> None:
        """Subscribe to the answers of the node, and create the publishers of the bags."""
        self._truth = truth
        self._node = AnsweringNode("dvl_calib_demo")
        self._node.create_subscription(TwistWithCovarianceStamped, f"{NODE_NAME}/estimate", self._on_estimate, LATCHED)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._parameters = AsyncParameterClient(self._node, NODE_NAME)
        self._player = BagPlayer(self._node, paths)
        self._time = 0.0
        self._estimate: TwistWithCovarianceStamped | None = None
        self._diagnostics: dict[str, str] = {}
        self._events: list[str] = []
        self._shown_why = ""

    def run(self, speed: float, switch_at_s: float, switch_to: str, back_at_s: float) -> None:
        """Play everything. Set parameter model to switch_to at switch_at_s, and back to auto at back_at_s."""
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)

        def spin() -> None:
            with suppress(ExternalShutdownException):  # Ctrl-C ends the demo without a traceback
                executor.spin()

        spinning = threading.Thread(target=spin, daemon=True)
        spinning.start()
        switches = [(switch_at_s, switch_to), (back_at_s, "auto")]

        def on_time(at: float, sent: Mapping[str, int]) -> None:
            """Switch the model when its time has come, and wait for the node to catch up."""
            self._time = at
            if switches and at >= switches[0][0]:
                self._switch(switches.pop(0)[1])
            self._wait_until_at_most(WAITING, sent)

        try:
            self._player.wait_for_subscribers()
            self._wait_until_at_most(0, self._player.play(speed, on_time))
        finally:
            executor.shutdown()
            spinning.join(5.0)
            self._node.destroy_node()

    def _wait_until_at_most(self, waiting: int, sent: Mapping[str, int]) -> None:
        """Wait until at most `waiting` messages of a topic wait in the node, by its own counts."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            received = (int(self._diagnostics.get(key, 0)) for key in RECEIVED.values())
            if all(sent.get(topic, 0) - n <= waiting for topic, n in zip(RECEIVED, received, strict=True)):
                return
            time.sleep(0.02)

    def _switch(self, model: str) -> None:
        self._events.append(f"{self._time:6.1f} s  ros2 param set /{NODE_NAME} model {model}")
        self._parameters.set_parameters([Parameter("model", value=model)])

    def _on_estimate(self, message: TwistWithCovarianceStamped) -> None:
        self._estimate = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep the newest values, and note a change of model."""
        self._diagnostics = {item.key: item.value for status in message.status for item in status.values}
        why = f"running {self._diagnostics.get('model')} ({self._diagnostics.get('why')})"
        if why != self._shown_why:
            self._shown_why = why
            self._events.append(f"{self._time:6.1f} s  {why}")

    def render(self) -> Any:
        """Return the current state for a rich display."""
        table = Table(title=f"{self._time:6.1f} s", title_justify="left")
        for column in ("", "truth", "estimate", "± 1σ"):
            table.add_column(column, justify="right", no_wrap=True, min_width=9)
        for name, (label, place, factor) in SHOWN.items():
            table.add_row(label, f"{self._truth[name]:+.2f}", *self._cells(place, factor))
        used, gated = self._diagnostics.get("samples used", "-"), self._diagnostics.get("samples gated", "-")
        state = self._diagnostics.get("convergence", "waiting for data")
        table.caption = f"model {self._diagnostics.get('model', '-')}, {state}, {used} used, {gated} gated"
        return Group(table, self._diagnostics.get("gnss", ""), *self._events[-10:])

    def _cells(self, place: int, factor: float) -> tuple[str, str]:
        """Return value and σ of one component of the estimate as text, in a unit by `factor` from SI."""
        if self._estimate is None:
            return "-", "-"
        twist = self._estimate.twist
        variance = float(twist.covariance[7 * place])
        if variance == NOT_ESTIMATED:
            return "-", "-"
        linear, angular = twist.twist.linear, twist.twist.angular
        value = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)[place]
        return f"{factor * value:+.2f}", f"{factor * math.sqrt(variance):.2f}"
