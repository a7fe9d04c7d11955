"""Who solves what takes long: whoever asks, at once, or a thread beside it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

Found = TypeVar("Found")
Given = TypeVar("Given", covariant=True)


class Solved(Protocol[Given]):
    """What a worker was given to do, as `concurrent.futures.Future`."""

    def result(self) -> Given:
        """What was found, waited for; raises what the solving raised."""


class Worker(Protocol):
    """Does one thing after the other, as a `concurrent.futures.ThreadPoolExecutor` with one thread."""

    def submit(self, work: Callable[[], Found], /) -> Solved[Found]:
        """Do this after all that was submitted before."""


class _Now(Generic[Found]):
    """What was done at once."""

    def __init__(self, found: Found) -> None:
        self._found = found

    def result(self) -> Found:
        """What was found."""
        return self._found


class AtOnce:
    """A worker that has done what it is given before anything else goes on."""

    def submit(self, work: Callable[[], Found], /) -> Solved[Found]:
        """Do it."""
        return _Now(work())
