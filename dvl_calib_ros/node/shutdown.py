"""Requests to end (Ctrl-C, kill, a terminal or a parent that is gone) as a flag, which cuts nothing short.

A KeyboardInterrupt would come up wherever Python happens to be: within the middleware, which makes another error of
it, or within the estimator, which would then have one half of a sample. Imports little: it must be there first.
"""

from __future__ import annotations

import select
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType, TracebackType

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Who is told and does not end is told again, s: a wake-up that the middleware loses would be waited for for ever.
AGAIN_S = 1.0


class Ending:
    """Whether to end. A context manager, to be entered in the main thread, as early as can be.

    Left after a request, further signals are ignored, as the process is about to end; else all is as before.

    Parameters
    ----------
    closed: File descriptor of a pipe; that its other end is closed is a request, too.

    """

    def __init__(self, closed: int | None = None) -> None:
        # no Event: setting one takes a lock, and the signal that comes meanwhile would wait for itself for ever
        self._requested = False
        self._told: list[Callable[[], object]] = []
        self._closed = closed

    def __enter__(self) -> Ending:
        self._reading, self._writing = socket.socketpair()
        self._writing.setblocking(False)
        # the interpreter writes to it at once; its own handlers wait for the middleware to come back
        self._wakeup_before = signal.set_wakeup_fd(self._writing.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, self._on_signal) for number in ENDING}
        self._thread = threading.Thread(target=self._watch, name="ending", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self.requested else handler)
        signal.set_wakeup_fd(self._wakeup_before)
        self._writing.close()
        self._thread.join()
        self._reading.close()

    @property
    def requested(self) -> bool:
        """Whether it has been asked for."""
        return self._requested

    def tell(self, function: Callable[[], object]) -> None:
        """Call a function, from another thread, when it is asked for, and again until `heard`; now, if it has been."""
        self._told.append(function)
        if self.requested:
            function()

    def heard(self) -> None:
        """Tell nobody any more."""
        self._told.clear()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._requested = True

    def _watch(self) -> None:
        watched = [self._reading.fileno(), *([] if self._closed is None else [self._closed])]
        while True:
            ready, _, _ = select.select(watched, [], [], AGAIN_S if self.requested else None)
            if not ready:
                self._tell()
                continue
            numbers = self._reading.recv(64) if watched[0] in ready else b"\0"
            if not numbers:  # left
                return
            if self._closed in ready:
                watched.remove(self._closed)
            if self._closed in ready or not set(ENDING).isdisjoint(numbers):
                self._requested = True
                self._tell()

    def _tell(self) -> None:
        for function in list(self._told):
            function()
