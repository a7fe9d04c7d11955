"""Names of the topics of the three streams."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

# suffix that a topic of poses gets as a topic of orientations (recording.py)
ORIENTATION = "/orientation"
# Name of a topic that is to be ignored
NONE = "none"


@dataclass(frozen=True)
class Topics:
    """Topic names; by default the node's."""

    dvl: str = "dvl/twist"
    gnss: str = "gnss/twist"
    imu: str = "imu/data"

    def found_in(self, present: Mapping[str, str]) -> Topics:
        """Return these topics as spelled in the bag: with or without a leading slash."""
        return Topics(*(spelled(name, present) or name for name in (self.dvl, self.gnss, self.imu)))


def spelled(name: str, present: Collection[str]) -> str | None:
    """Return a topic as spelled in a recording, with or without a leading slash; None if missing."""
    return next((spelling for spelling in (name, f"/{name}", name.lstrip("/")) if spelling in present), None)
