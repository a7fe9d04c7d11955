"""How large the package is: lines of code (neither blank, comment nor docstring), modules, arrows between rooms, and
functions that lay out a part of a result (`layout.layout_functions`)."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence

from .layout import layout_functions
from .rooms import arrows, arrows_up, modules, room_of, sizes


def main(argv: Sequence[str]) -> int:
    """Print; 0."""
    parser = argparse.ArgumentParser(prog="python -m validation size", description=__doc__)
    parser.add_argument("--json", action="store_true", help="one line of JSON, without the rooms")
    arguments = parser.parse_args(argv)
    lines, up, n_modules = sizes(), arrows_up(), Counter(map(room_of, modules()))
    layout = list(layout_functions())
    if arguments.json:
        counts = {"lines": lines.total(), "modules": n_modules.total(), "rooms": len(lines)}
        print(json.dumps(counts | {"arrows": len(arrows()), "arrows_up": len(up), "layout": len(layout)}))
        return 0
    for room, count in lines.most_common():
        print(f"{count:7}  {n_modules[room]:4}  {room}")
    print(f"{lines.total():7} lines of code in {n_modules.total()} modules and {len(lines)} rooms")
    print(f"{len(arrows()):7} arrows between rooms, {len(up)} up{': ' if up else ''}{', '.join(map(' -> '.join, up))}")
    of_layout = sum(each.lines for each in layout)
    print(f"{len(layout):7} functions of {of_layout} lines lay out a part of a result")
    return 0
