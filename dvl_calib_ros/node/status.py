"""The calibration's status in /diagnostics, for those who read it; without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


def status_name(node: str) -> str:
    """Name of a node's status, by the node's full name, as in /second/dvl_calibration."""
    return f"{node.strip('/')}: calibration"


@dataclass(frozen=True)
class Status:
    """One status as received. level: 0 OK, 1 WARN, 2 ERROR. received_s: monotonic time."""

    level: int
    message: str
    values: Mapping[str, str]
    received_s: float

    def get(self, key: str) -> str:
        """A value, '-' if there is none."""
        return self.values.get(key, "-")
