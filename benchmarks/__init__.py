"""Speed and memory against a peer in the same run: what `python -m benchmarks` measures."""

from __future__ import annotations

from typing import NamedTuple


class Measurement(NamedTuple):
    """One line of the table: what was measured, ours and the peer's, their ratio and what it should be."""

    what: str
    ours: str
    peer: str
    ratio: str
    target: str
    met: bool
