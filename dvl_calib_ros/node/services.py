"""A node that no request of a service can end, and that says which topic it cannot have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from ..errors import InputError, printable


class AnsweringNode(Node):  # type: ignore[misc]
    """As rclpy's, which makes its services of parameters by `create_service` as well, and lets their errors end it."""

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any) -> Any:
        """As rclpy's; a request that raises an error is logged and answered with nothing."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:  # rclpy raises ValueError for a parameter of a type that it does not know
                why = printable(f"{type(error).__name__}: {error}")
                self.get_logger().error(f"{srv_name}: a request cannot be answered ({why}); nothing more of it is done")
                return srv_type.Response()

        return super().create_service(srv_type, srv_name, answer, **options)

    def create_publisher(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
        """As rclpy's. Raises InputError."""
        make = super().create_publisher
        return _or_refused(topic, lambda: make(msg_type, topic, *arguments, **options))

    def create_subscription(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
        """As rclpy's. Raises InputError."""
        make = super().create_subscription
        return _or_refused(topic, lambda: make(msg_type, topic, *arguments, **options))


def _or_refused(topic: str, make: Callable[[], Any]) -> Any:
    try:
        return make()
    except Exception as error:  # rclpy has an error for names, and the middleware's own for one topic of two types
        why = printable(" ".join(str(error).split()))
        raise InputError(
            f"topic {topic!r} cannot be had ({why}); name another: one for each sensor, of letters, digits, _ and /"
        ) from error
