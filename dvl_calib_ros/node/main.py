"""Start and stop of the node: arguments, signals, exit codes.

What takes long to import is imported below, so that signals are looked after from the first moment on.

Memory that goes back to the system once it is free.

What glibc learns from arrays that come and go is to keep their room, and small ones that stay then cut it into pieces:
a node's memory climbs for hours although it holds no more than at the start.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from .shutdown import Ending

# A thread that computes gives way to one with a message after so long, s; by default after 0.005.
GIVES_WAY_S = 0.0005
# Says that standard input is a pipe, and that the node is to end with the process that holds its other end.
ENDS_WITH_STDIN = "--ends-with-stdin"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop.

    0; 1 where the result could not be saved, which is printed then; 2 on a bad configuration, said in one line on
    standard error.
    """
    try:
        from ..standard_streams import open_streams
        from .shutdown import Ending

        open_streams()
        given = list(sys.argv[1:] if args is None else args)
        with_parent = ENDS_WITH_STDIN in given
        with Ending(closed=sys.stdin.fileno() if with_parent else None) as ending:
            return run_until(ending, [arg for arg in given if arg != ENDS_WITH_STDIN])
    except KeyboardInterrupt:  # before there was an `Ending`, so nothing had begun
        return 0


def run_until(ending: Ending, args: Sequence[str]) -> int:
    """As `main`, with what asks it to stop."""
    from ..errors import InputError, needing_ros

    try:
        with needing_ros("the node"):
            import rclpy
            from rclpy.signals import SignalHandlerOptions

            from ..calibration.models.parameter_spec import ParameterError
            from .calibration_node import CalibrationNode
            from .executor import ReceivingExecutor
    except InputError as error:
        return _refused(error)
    if ending.requested:
        return 0
    try:
        rclpy.init(args=["calibration_node", *args], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises types of its own for bad --ros-args and unreadable parameter files
        return _refused(error)
    node, is_saved = None, True
    give_back_at_once()
    sys.setswitchinterval(GIVES_WAY_S)
    try:
        node = CalibrationNode(parameter_files(args))
        executor = ReceivingExecutor(node)
        gc.freeze()  # what the start has made stays: to look through it takes 0.01 s now and then, and a message waits
        # spin_until_future_complete would remember one callback more with every message
        ending.tell(lambda: executor.create_task(lambda: None))
        while not ending.requested:
            executor.spin_once()
    except (ParameterError, InputError) as error:
        return _refused(error)
    finally:
        ending.heard()
        if node is not None:
            is_saved = node.finish()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0 if is_saved else 1


def parameter_files(args: Sequence[str]) -> list[Path]:
    """The files that ROS arguments name, as rcl reads them: between --ros-args and --."""
    from pathlib import Path

    files, is_ros = [], False
    for word, following in zip(args, [*args[1:], ""], strict=False):
        if word in ("--ros-args", "--"):
            is_ros = word == "--ros-args"
        elif is_ros and word == "--params-file":
            files.append(Path(following))
    return files


def _refused(error: Exception | str) -> int:
    from ..standard_streams import say

    say(f"calibration_node: {' '.join(str(error).split())}")
    return 2


# Of `mallopt` (3). Set, they stay what they are: glibc raises them otherwise with the largest array that is given back.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Arrays of at least so many bytes have memory of their own: what comes with each message is smaller.
LARGE = 1 << 17


def give_back_at_once() -> bool:
    """Have large arrays be given back to the system when they are freed; False where that cannot be asked for."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no glibc
        return False
    return all(mallopt(what, LARGE) for what in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


if __name__ == "__main__":
    sys.exit(main())
