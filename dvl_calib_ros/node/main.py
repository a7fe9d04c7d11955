"""Start and stop of the node: arguments, signals, exit codes, and return of memory to the system.

Slow imports are inside functions, so that signals are handled from the first moment.

By default glibc keeps the memory of large freed arrays and fragments it with small ones, so a node's memory grows for
hours although it holds no more than at the start.
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

# A computing thread yields to one with a message after this time, s; Python's default is 0.005.
GIVES_WAY_S = 0.0005
# option: standard input is a pipe, and the node ends when its other end closes
ENDS_WITH_STDIN = "--ends-with-stdin"


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until a signal or a closed pipe ends it.

    Returns 0; 1 if the result could not be saved, and was printed; 2 for a bad configuration (one line on standard
    error).
    """
    try:
        from ..standard_streams import open_streams
        from .shutdown import Ending

        open_streams()
        given = list(sys.argv[1:] if args is None else args)
        with_parent = ENDS_WITH_STDIN in given
        with Ending(closed=sys.stdin.fileno() if with_parent else None) as ending:
            return run_until(ending, [arg for arg in given if arg != ENDS_WITH_STDIN])
    except KeyboardInterrupt:  # before `Ending` was set up, so nothing was started
        return 0


def run_until(ending: Ending, args: Sequence[str]) -> int:
    """Run the node as `main`, until `ending` is requested."""
    from ..errors import InputError, needing_ros

    try:
        with needing_ros("the node"):
            import rclpy

            from ..calibration.models.parameters import ParameterError
            from .calibration_node import CalibrationNode
            from .executor import ReceivingExecutor
            from .services import init_ros
    except InputError as error:
        return _report_refusal(error)
    if ending.requested:
        return 0
    node, is_saved = None, True
    give_back_at_once()
    sys.setswitchinterval(GIVES_WAY_S)
    try:
        init_ros(["calibration_node", *args])
        node = CalibrationNode(parameter_files(args))
        executor = ReceivingExecutor(node)
        gc.freeze()  # objects of the start stay; a collection that examines them would delay a message by 0.01 s
        # spin_until_future_complete would keep one more callback for every message
        ending.call_on_request(lambda: executor.create_task(lambda: None))
        while not ending.requested:
            executor.spin_once()
    except (ParameterError, InputError) as error:
        return _report_refusal(error)
    finally:
        ending.stop_calling()
        if node is not None:
            is_saved = node.finish()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0 if is_saved else 1


def parameter_files(args: Sequence[str]) -> list[Path]:
    """Return the parameter files in ROS arguments, as rcl reads them: between --ros-args and --."""
    from pathlib import Path

    files, is_ros = [], False
    for word, following in zip(args, [*args[1:], ""], strict=False):
        if word in ("--ros-args", "--"):
            is_ros = word == "--ros-args"
        elif is_ros and word == "--params-file":
            files.append(Path(following))
    return files


def _report_refusal(error: Exception | str) -> int:
    """Print why the node cannot start. Return exit code 2."""
    from ..standard_streams import say

    say(f"calibration_node: {' '.join(str(error).split())}")
    return 2


# mallopt(3): setting these disables glibc's automatic increase after a large array is freed
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Smallest array, bytes, with its own memory mapping; arrays of one message are smaller.
LARGE = 1 << 17


def give_back_at_once() -> bool:
    """Make glibc return large arrays to the system when they are freed. Return False without glibc."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # no glibc
        return False
    return all(mallopt(what, LARGE) for what in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))


if __name__ == "__main__":
    sys.exit(main())
