"""Who solves G2's blocks: whoever asks, at once, or a thread beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from .solver import Outcome


class Solved(Protocol):
    """What a worker was given to do, as `concurrent.futures.Future`."""

    def result(self) -> list[Outcome]:
        """The outcomes, waited for; raises what the solving raised."""


class Worker(Protocol):
    """Does one thing after the other, as a `concurrent.futures.ThreadPoolExecutor` with one thread."""

    def submit(self, work: Callable[[], list[Outcome]], /) -> Solved:
        """Do this after all that was submitted before."""


class _Now:
    """What was done at once."""

    def __init__(self, outcomes: list[Outcome]) -> None:
        self._outcomes = outcomes

    def result(self) -> list[Outcome]:
        """The outcomes."""
        return self._outcomes


class AtOnce:
    """A worker that has done what it is given before anything else goes on."""

    def submit(self, work: Callable[[], list[Outcome]], /) -> Solved:
        """Do it."""
        return _Now(work())
