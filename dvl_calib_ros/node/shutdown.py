"""Requests to end (Ctrl-C, kill, a closed terminal or parent) as a flag that interrupts nothing.

A KeyboardInterrupt could be raised inside the middleware, which converts it to another error, or inside the estimator,
which would then have half a sample. This module imports little, because it must be active first.
"""

from __future__ import annotations

import select
import signal
import socket
import threading
from collections.abc import Callable
from types import FrameType

END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Interval of repeated calls to functions that have not ended, s: the middleware may lose a wake-up.
REPEATED_EVERY_S = 1.0


class Ending:
    """Context manager that notes an end as `requested`. Enter it in the main thread as early as possible.

    After a request, further signals are ignored on exit, because the process is about to end; else the previous signal
    handlers are restored.

    Parameters
    ----------
    closed: File descriptor of a pipe; closing its other end is a request, too.
    """

    def __init__(self, closed: int | None = None) -> None:
        # no threading.Event: setting it takes a lock, on which a signal handler could block itself
        self.requested = False
        self._functions: list[Callable[[], object]] = []
        self._closed = closed

    def __enter__(self) -> Ending:
        self._reading, self._writing = socket.socketpair()
        self._writing.setblocking(False)
        # the interpreter writes to it immediately; its own handlers wait until the middleware returns
        self._wakeup_before = signal.set_wakeup_fd(self._writing.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, self._on_signal) for number in END_SIGNALS}
        self._thread = threading.Thread(target=self._watch, name="ending", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self.requested else handler)
        signal.set_wakeup_fd(self._wakeup_before)
        self._writing.close()
        self._thread.join()
        self._reading.close()

    def call_on_request(self, function: Callable[[], object]) -> None:
        """Call a function repeatedly, from another thread, from a request until `stop_calling`."""
        self._functions.append(function)
        if self.requested:
            function()

    def stop_calling(self) -> None:
        """Stop calling the functions."""
        self._functions.clear()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.requested = True

    def _watch(self) -> None:
        """Wait for a signal or a closed terminal, then call the registered functions repeatedly until `__exit__`."""
        watched = [self._reading.fileno(), *([] if self._closed is None else [self._closed])]
        while True:
            ready, _, _ = select.select(watched, [], [], REPEATED_EVERY_S if self.requested else None)
            if not ready:
                self._call()
                continue
            numbers = self._reading.recv(64) if watched[0] in ready else b"\0"
            if not numbers:  # the context was left
                return
            if self._closed in ready:
                watched.remove(self._closed)
            if self._closed in ready or not set(END_SIGNALS).isdisjoint(numbers):
                self.requested = True
                self._call()

    def _call(self) -> None:
        for function in list(self._functions):
            function()
