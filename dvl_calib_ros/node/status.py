"""The calibration's status in /diagnostics, for its readers; without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


def status_name(node: str) -> str:
    """Return the name of a node's status from the node's full name, such as /second/dvl_calibration."""
    return f"{node.strip('/')}: calibration"


@dataclass(frozen=True)
class Status:
    """One received status. level: 0 OK, 1 WARN, 2 ERROR. received_s: monotonic time."""

    level: int
    message: str
    values: Mapping[str, str]
    received_s: float

    def get(self, key: str) -> str:
        """Return a value, or '-' if missing."""
        return self.values.get(key, "-")
