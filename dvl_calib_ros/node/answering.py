"""A node that no request of a service can end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from ..errors import printable


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
