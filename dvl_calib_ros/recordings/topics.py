"""Which topics hold the three streams, by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

# What follows the name of a topic of poses in that of its orientations (pose_orientation.py).
ORIENTATION = "/orientation"


@dataclass(frozen=True)
class Topics:
    """Topic names; the node's by default."""

    dvl: str = "dvl/twist"
    gnss: str = "gnss/twist"
    imu: str = "imu/data"

    def found_in(self, present: Mapping[str, str]) -> Topics:
        """These topics as the bag spells them: with or without a leading slash."""
        return Topics(*(spelled(name, present) or name for name in (self.dvl, self.gnss, self.imu)))


def spelled(name: str, present: Collection[str]) -> str | None:
    """A topic as a recording spells it, with or without a leading slash; None if it is not there."""
    return next((each for each in (name, f"/{name}", name.lstrip("/")) if each in present), None)
