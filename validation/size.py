"""How large the package is, and whether it has grown since what landed last.

Counted are lines of code (neither blank, comment nor docstring), modules, arrows between rooms, and functions that lay
out a part of a result (`layout.layout_functions`).
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from .layout import layout_functions
from .rooms import arrows, arrows_up, modules, room_of, sizes

# What may not grow, with the figures that landed last. Whoever needs more raises them in a commit that says what a
# user gets for it.
LIMITS = Path(__file__).with_name("size_limits.json")
LIMITED = ("lines", "modules", "arrows")


def main(argv: Sequence[str]) -> int:
    """Print; 0, or 1 where --limit finds that something has grown."""
    parser = argparse.ArgumentParser(prog="python -m validation size", description=__doc__)
    parser.add_argument("--json", action="store_true", help="one line of JSON, without the rooms")
    parser.add_argument("--limit", action="store_true", help=f"fail where more than {LIMITS.name} allows")
    parser.add_argument("--store", action="store_true", help=f"write today's figures to {LIMITS.name}")
    arguments = parser.parse_args(argv)
    lines, up, n_modules = sizes(), arrows_up(), Counter(map(room_of, modules()))
    layout = list(layout_functions())
    counts = {"lines": lines.total(), "modules": n_modules.total(), "rooms": len(lines), "arrows": len(arrows())}
    if arguments.store:
        LIMITS.write_text(json.dumps({name: counts[name] for name in LIMITED}, indent=2) + "\n")
    if arguments.limit:
        return _held(counts, json.loads(LIMITS.read_text()))
    if arguments.json:
        print(json.dumps(counts | {"arrows_up": len(up), "layout": len(layout)}))
        return 0
    for room, count in lines.most_common():
        print(f"{count:7}  {n_modules[room]:4}  {room}")
    print(f"{counts['lines']:7} lines of code in {counts['modules']} modules and {counts['rooms']} rooms")
    named = f": {', '.join(map(' -> '.join, up))}" if up else ""
    print(f"{counts['arrows']:7} arrows between rooms, {len(up)} up{named}")
    of_layout = sum(each.lines for each in layout)
    print(f"{len(layout):7} functions of {of_layout} lines lay out a part of a result")
    return 0


def _held(counts: Mapping[str, int], limits: Mapping[str, int]) -> int:
    """Print each limit beside its count; 1 where one is exceeded."""
    exceeded = False
    for name in LIMITED:
        more = counts[name] - limits[name]
        exceeded |= more > 0
        print(f"{counts[name]:7} {name}, {limits[name]} allowed{f': {more} too many' if more > 0 else ''}")
    if exceeded:
        print(f"delete, or raise {LIMITS.name} in a commit that says what a user gets for it")
    return int(exceeded)
