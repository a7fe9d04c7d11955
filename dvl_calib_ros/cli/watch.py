"""Watch a calibration node that runs somewhere on the ROS domain: mounting, what it is worth, what to drive next.

Ctrl-C or q ends the view, not the node; s saves, r twice forgets all. ``dvl-calib run --watch`` starts a node and
watches it; there they end both.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import IO, TYPE_CHECKING

from ..node.main import ENDS_WITH_STDIN
from ..streams import say
from . import common

if TYPE_CHECKING:
    from ..node.listener import Listener
    from ..node.shutdown import Ending

# How long a node may take to save, s.
PATIENCE_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--node", metavar="NAME", help="full name of the node, if it was given another")


def run(arguments: argparse.Namespace) -> None:
    """Watch until Ctrl-C."""
    from ..files.parameter_files import NODE_NAME
    from ..node.shutdown import Ending
    from .live_view import show

    with Ending() as ending, _listener(arguments.node or NODE_NAME) as listener:
        show(common.console(), listener, lambda: not ending.requested)


def _listener(node: str) -> Listener:
    from ..errors import needing_ros

    with needing_ros("watch"):
        import rich  # noqa: F401

        from ..node.listener import Listener
    return Listener(node)


def run_and_watch(ros_arguments: Sequence[str], ending: Ending) -> int:
    """Start the node in a process of its own and watch it; its exit code.

    Ctrl-C, SIGTERM and SIGHUP end the node as they would without the view: it saves. It is in a session of its own, so
    that they reach it through here only, by the pipe that closes with this process, however that ends.
    """
    from .live_view import show

    with _listener(_node_name(ros_arguments)) as listener:
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(
            node_command(ros_arguments), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=environment, start_new_session=True,
        )  # fmt: skip
        try:
            assert process.stdout is not None  # a pipe
            log = _Log(process.stdout)
            show(common.console(), listener, lambda: process.poll() is None and not ending.requested, log.lines)
            said = len(log.lines) if process.poll() is None else 0  # lines that are on the screen already
        finally:
            code = _ended(process)
        for text in log.finished()[said:]:
            say(text)
    return code


def _node_name(ros_arguments: Sequence[str]) -> str:
    """Full name of the node that is started with these: __ns and __node remap it."""
    from ..files.parameter_files import NODE_NAME

    rules = dict(word.split(":=", 1) for word in ros_arguments if ":=" in word)
    return f"{rules.get('__ns', '')}/{rules.get('__node', NODE_NAME)}"


def node_command(ros_arguments: Sequence[str]) -> list[str]:
    """What runs a node that ends with this process, or when its standard input is closed before."""
    return [sys.executable, "-m", "dvl_calib_ros.node.main", ENDS_WITH_STDIN, *ros_arguments]


def _ended(process: subprocess.Popen[bytes]) -> int:
    assert process.stdin is not None  # a pipe
    process.stdin.close()
    try:
        return process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        say(f"the node did not end within {PATIENCE_S:.0f} s and is killed; it may not have saved")
        process.kill()
        return process.wait()


class _Log:
    """Collects what the node writes, so that it neither garbles the view nor is lost."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self.lines: list[str] = []
        self._pipe = pipe
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for raw in self._pipe:
            self.lines.append(raw.decode(errors="replace").rstrip())

    def finished(self) -> list[str]:
        """All lines of a node that has ended."""
        self._thread.join()
        return self.lines
