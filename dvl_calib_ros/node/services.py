"""Start of ROS 2, its parameters from the schema, and a node that survives errors in service requests.

The node prints only what is fit for a terminal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, ParameterType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from ..calibration.models.parameters import SCHEMA, Parameters, ParameterSpec
from ..errors import InputError, printable
from ..files.parameter_files import is_ros_parameter, names_of_others

# of topics that late subscribers receive, too
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def init_ros(args: list[str], context: rclpy.Context | None = None) -> None:
    """Initialise ROS 2 without its signal handlers. Raises InputError for arguments that it refuses."""
    try:
        rclpy.init(args=args, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises its own types for bad --ros-args and unreadable parameter files
        raise InputError(" ".join(str(error).split())) from error


class AnsweringNode(Node):  # type: ignore[misc]
    """Node of rclpy whose services, parameter services included, log an error instead of ending the node.

    What it logs, and what its services say, may hold names from outside: control characters are escaped.
    """

    # a method for each: rclpy refuses a second severity of one line of code
    def info(self, text: str) -> None:
        """Log a text."""
        self.get_logger().info(printable(text))

    def warn(self, text: str) -> None:
        """Log a warning."""
        self.get_logger().warning(printable(text))

    def error(self, text: str) -> None:
        """Log an error."""
        self.get_logger().error(printable(text))

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any) -> Any:
        """Create a service; a request that raises an error is logged and answered with an empty response."""

        def answer(request: Any, response: Any) -> Any:
            """Run the callback; log an error and answer with an empty response if it raises."""
            try:
                return _printable(callback(request, response))
            except Exception as error:  # rclpy raises ValueError for an unknown parameter type
                why = f"{type(error).__name__}: {error}"
                self.error(f"{srv_name}: a request cannot be answered ({why}); the request is dropped")
                return srv_type.Response()

        return super().create_service(srv_type, srv_name, answer, **options)

    def create_publisher(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
        """Create a publisher. Raises InputError."""
        make = super().create_publisher
        return _create_or_refuse(topic, lambda: make(msg_type, topic, *arguments, **options))

    def create_subscription(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
        """Create a subscription. Raises InputError."""
        make = super().create_subscription
        return _create_or_refuse(topic, lambda: make(msg_type, topic, *arguments, **options))

    def subscribe(
        self, msg_type: type, topic: str, callback: Callable[..., None], depth: int, on_best_effort: Callable[[], None],
        reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE,
    ) -> Subscription:  # fmt: skip
        """Subscribe reliably; on_best_effort must subscribe again once a best-effort publisher appears.

        A reliable subscription loses nothing but receives nothing from a best-effort publisher; best effort receives
        from both.
        """

        def on_incompatible(event: Any) -> None:
            if event.last_policy_kind == QoSPolicyKind.RELIABILITY and reliability is ReliabilityPolicy.RELIABLE:
                assert self.executor is not None  # it runs this callback
                self.executor.create_task(on_best_effort)

        profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability)
        events = SubscriptionEventCallbacks(incompatible_qos=on_incompatible, use_default_callbacks=False)
        return self.create_subscription(msg_type, topic, callback, profile, event_callbacks=events)


def _printable(response: Any) -> Any:
    """Escape control characters in what a response says: std_srvs' message, and reasons of parameters' results."""
    for part in (response, getattr(response, "result", None), *getattr(response, "results", ())):
        for name in ("message", "reason"):
            if hasattr(part, name):
                setattr(part, name, printable(getattr(part, name)))
    return response


def _create_or_refuse(topic: str, make: Callable[[], Any]) -> Any:
    """Make a publisher or subscription. Raises InputError for an invalid name or type."""
    try:
        return make()
    # rclpy raises its own type for names, the middleware another for one topic with two types
    except Exception as error:
        why = " ".join(str(error).split())
        raise InputError(
            f"topic {topic!r} cannot be used ({why}); name another: one for each sensor, of letters, digits, _ and /"
        ) from error


_TYPES = {
    "string": ParameterType.PARAMETER_STRING,
    "bool": ParameterType.PARAMETER_BOOL,
    "double": ParameterType.PARAMETER_DOUBLE,
    "double_array": ParameterType.PARAMETER_DOUBLE_ARRAY,
}


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the descriptor for `ros2 param describe`."""
    constraints = []
    if spec.choices:
        constraints.append("one of " + ", ".join(spec.choices))
    if spec.kind == "double_array":
        constraints.append(f"{spec.length} numbers, each {spec.low:g} .. {spec.high:g}")
    described = ParameterDescriptor(
        type=_TYPES[spec.kind],
        description=spec.description + (f" [{spec.unit}]" if spec.unit else ""),
        additional_constraints="; ".join(constraints),
        read_only=spec.read_only,
    )
    if spec.kind == "double" and spec.low is not None and spec.high is not None:
        described.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)]
    return described


def declare_parameters(node: AnsweringNode, files: Sequence[Path] = ()) -> Parameters:
    """Declare every parameter with its value at the start. Raises ParameterError and InputError.

    The node must have declared its overrides automatically: unknown names are then seen, which ROS 2 would ignore, and
    integers are accepted for doubles, now and later. files: the parameter files of the start. Unknown names in their
    sections for all nodes belong to other nodes.
    """
    names_elsewhere: set[str] = set()
    for path in files:
        names_elsewhere |= names_of_others(path, node.get_fully_qualified_name())
    given: dict[str, Any] = {
        name: node.get_parameter(name).value for name in node.get_parameters_by_prefix("") if not is_ros_parameter(name)
    }
    for name in given:
        node.undeclare_parameter(name)
    ignored = sorted(names_elsewhere & given.keys())
    if ignored:
        node.info(f"set for all nodes, but no parameters of this node: {', '.join(ignored)}")
    parameters = Parameters.from_mapping({name: value for name, value in given.items() if name not in names_elsewhere})
    for name, spec in SCHEMA.items():
        node.declare_parameter(name, parameters.as_dict()[name], descriptor(spec), ignore_override=True)
    node.add_pre_set_parameters_callback(_as_declared)
    return parameters


def _as_declared(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return parameters with integers converted to doubles, which ROS 2 would refuse by their type."""
    found = []
    for parameter in parameters:
        kind = SCHEMA[parameter.name].kind if parameter.name in SCHEMA else ""
        if kind == "double" and parameter.type_ is Parameter.Type.INTEGER:
            parameter = Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
        elif kind == "double_array" and parameter.type_ is Parameter.Type.INTEGER_ARRAY:
            parameter = Parameter(parameter.name, Parameter.Type.DOUBLE_ARRAY, [*map(float, parameter.value)])
        found.append(parameter)
    return found
