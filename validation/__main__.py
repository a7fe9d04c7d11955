"""What is claimed of this package, measured again. Needs the `test` and `ros` extras."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

# as `dvl-calib` does: more threads of BLAS only wait for each other. Before numpy is imported
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dvl_calib_ros.errors import InputError

PROGRAM = "python -m validation"
# name: what it does. Each is a module of this package with `main(argv) -> int`, imported when it is asked for
COMMANDS = {
    "combinations": "one thing at a time that recordings have, drawn at random on physics not ours: as surveys",
    "figures": "the figures and pictures of README.md and docs/: measured, written, checked",
    "frames": "frames and signs drawn at random, on physics not ours: usable and wrong, rejected, contradictions",
    "late_clocks": "late references and late DVLs: that doctor, replay and diagnose name one cause, by its size",
    "mutants": "faults put into ten rules, each of which the tests must see",
    "peers": "the diagnosis beside four other ways to answer, on the same bags: right, intervals, error, CPU",
    "second_trial": "the diagnosis on recordings of a second generator, written without a look at its code",
    "size": "lines of code, modules, arrows between the rooms of the package",
    "stacks": "bags as real stacks record them, each with its truth, judged through the command line",
    "surveys": "surveys drawn at random, by physics of their own: usable and wrong, right and rejected",
    "trial": "the diagnosis, blindly, on bags whose truth stays sealed until it has answered",
    "repeat": "the suite, or its live part, many times: what fails once in a while",
}
# Commands whose module has another name
MODULES = {"frames": "frame_cases"}


def main(argv: Sequence[str]) -> int:
    """Run the command that is named first; 0, 1 if something is not as claimed, 2 with one line for a wrong call."""
    if not argv or argv[0] in ("-h", "--help"):
        print(f"usage: {PROGRAM} COMMAND ...\n\n{(__doc__ or '').strip()}\n")
        for name, what in COMMANDS.items():
            print(f"  {name:<12}  {what}")
        return 0 if argv else 2
    name, *rest = argv
    try:
        if name not in COMMANDS:
            raise InputError(f"{name!r} is no command; there are {', '.join(COMMANDS)}")
        code: int = importlib.import_module(f"{__package__}.{MODULES.get(name, name)}").main(rest)
    except InputError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 2
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
