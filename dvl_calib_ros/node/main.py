"""Start and stop of the node: arguments, signals, exit codes."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from types import FrameType

from ..calibration.parameters import ParameterError
from ..errors import InputError, printable


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is told to stop; 0, or 2 on a bad configuration, said in one line on standard error."""
    try:
        import rclpy
        from rclpy.executors import ExternalShutdownException

        from .calibration_node import CalibrationNode
    except ImportError as error:
        print(
            f"calibration_node: ROS 2 is not available ({error}); source /opt/ros/jazzy/setup.bash, or "
            "pip install 'dvl_calib_ros[ros]'",
            file=sys.stderr,
        )
        return 2

    try:
        rclpy.init(args=None if args is None else ["calibration_node", *args])
    except Exception as error:  # rclpy raises types of its own for bad --ros-args and unreadable parameter files
        return _refused(error)
    signal.signal(signal.SIGHUP, _stop)  # the operator's terminal is gone: save, like on SIGTERM
    node = None
    try:
        node = CalibrationNode()
        rclpy.spin(node)
    except (ParameterError, InputError) as error:
        return _refused(error)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():  # when stopped in the middle of something, rclpy raises whatever that something runs into
            raise
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # a second Ctrl-C must not cut the saving short
        if node is not None:
            node.finish()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _refused(error: Exception) -> int:
    print(f"calibration_node: {printable(' '.join(str(error).split()))}", file=sys.stderr)
    return 2


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
