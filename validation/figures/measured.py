"""All measurements, in the order in which they are made."""

from __future__ import annotations

from . import examples, performance, played, positions, sea, trials
from .registry import MEASUREMENTS

__all__ = ["MEASUREMENTS", "examples", "performance", "played", "positions", "sea", "trials"]
