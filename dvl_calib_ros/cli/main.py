"""Entry point of ``dvl-calib``. Slow imports are inside `main`, where an interrupt is handled."""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # as in typing, whose import takes longer than the rest of this module
if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Return 0 for success, 1 for a negative answer, 2 for bad usage or input (one line)."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        from .command_line import run

        return run(argv)
    except KeyboardInterrupt:
        from ..standard_streams import say

        say(f"dvl-calib {next((word for word in argv if not word.startswith('-')), '')}: interrupted")
        return 130


if __name__ == "__main__":
    sys.exit(main())
