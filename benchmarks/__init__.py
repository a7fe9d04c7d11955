"""Speed and memory against a peer in the same run: what `python -m benchmarks` measures."""

from __future__ import annotations

from typing import NamedTuple

# Both sides of a comparison do the same work where their states (rad, m/s) differ by no more than this.
SAME = 1e-9


class Measurement(NamedTuple):
    """One line of the table: what was measured, ours and the peer's, their ratio and what it should be.

    what: also its name in a baseline, so nothing that was measured. ratio_value: the ratio as a number, which
    `--against` compares; better where it is higher, or lower.
    """

    what: str
    ours: str
    peer: str
    ratio: str
    target: str
    met: bool
    ratio_value: float
    higher_is_better: bool = False


class DifferentWorkError(Exception):
    """The two sides of a comparison do not do the same work; the message says by how much they differ."""


def check_same(difference: float, what: str) -> None:
    """Raise DifferentWorkError unless the states of both sides, which differ by so much, are the same."""
    if not difference <= SAME:
        raise DifferentWorkError(
            f"{what}: the states of both sides differ by {difference:.0e}, not by {SAME:g} at most"
        )
