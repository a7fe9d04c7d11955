"""Entry point of ``dvl-calib``. What takes long to import is imported below, where an interrupt is looked after."""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # as in typing, which takes longer than all else here
if TYPE_CHECKING:
    from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; 0 on success, 1 for an answer against the data, 2 for bad usage or input (one line)."""
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
