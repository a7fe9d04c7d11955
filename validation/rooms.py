"""The rooms of the package, what each is built of, and how large they are."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parents[1] / "dvl_calib_ros"
_BASE = ("errors",)
_CORE = (*_BASE, "verdict", "calibration")
_READ = (*_CORE, "bags", "messages", "recordings")
# Rooms from the ground up: packages and modules of ours, and which of those before it each may import. docs/develop.md
ROOMS: Mapping[str, tuple[str, ...]] = {
    "errors": (),
    "streams": (),
    "parallel": _BASE,
    "disk": _BASE,
    "verdict": (),
    "calibration": (*_BASE, "verdict"),
    "effects": _CORE,
    "bags": (*_BASE, "disk"),
    "messages": (*_CORE, "bags"),
    "files": (*_CORE, "disk", "bags", "messages"),
    "recordings": (*_CORE, "bags", "messages"),
    "discovery": (*_READ, "files"),
    "examination": (*_READ, "discovery"),
    "replay": (*_READ, "files"),
    "fleet": (*_READ, "parallel", "disk", "files", "discovery", "replay"),
    "diagnosis": (*_READ, "effects"),
    "export": (*_CORE, "disk", "files", "effects"),
    "simulation": (*_READ, "effects", "export"),
    "unpaired": (*_READ, "disk", "effects", "diagnosis", "export", "simulation"),
    "evaluation": (*_READ, "parallel", "files", "replay", "simulation"),
    "present": (
        *_READ, "disk", "files", "effects", "discovery", "examination", "replay", "fleet", "diagnosis", "unpaired",
        "evaluation",
    ),
    "node": (*_READ, "streams", "disk", "files", "discovery", "simulation"),
    "demo": (*_READ, "files", "node"),
    "api": (
        *_READ, "parallel", "disk", "files", "discovery", "examination", "replay", "fleet", "diagnosis", "unpaired",
        "export", "simulation", "evaluation", "present",
    ),
    "cli": (
        *_READ, "streams", "parallel", "disk", "files", "effects", "discovery", "examination", "replay", "fleet",
        "diagnosis", "unpaired", "export", "simulation", "evaluation", "present", "node", "demo",
    ),
    "__init__": ("api",),
}  # fmt: skip


def room_of(path: Path) -> str:
    """The room that a file of the package is in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def modules() -> Iterator[Path]:
    """All files of the package."""
    yield from sorted(PACKAGE.rglob("*.py"))


class _Text(NamedTuple):
    """What the text of a module shows: its lines of code, and its relative imports (level, module, names)."""

    lines: int
    imports: tuple[tuple[int, str, tuple[str, ...]], ...]


@cache  # parsing all modules takes a second and a half, and each question is about all of them
def _look(text: str) -> _Text:
    code, imports = set(), []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.strip().startswith("#"):
            code.add(number)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            code -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        elif isinstance(node, ast.ImportFrom) and node.level:
            imports.append((node.level, node.module or "", tuple(alias.name for alias in node.names)))
    return _Text(len(code), tuple(imports))


def imported_by(path: Path) -> set[str]:
    """Other rooms that a file imports, also within functions and for types alone."""
    inside = path.relative_to(PACKAGE).parent.parts
    found = set()
    for level, module, names in _look(path.read_text()).imports:
        full = [*inside[: len(inside) - (level - 1)], *filter(None, module.split("."))]
        found |= {full[0]} if full else {name for name in names if name != "__version__"}
    return found - {room_of(path)}


def arrows() -> dict[tuple[str, str], list[Path]]:
    """Which room imports which other, and in which files."""
    found: dict[tuple[str, str], list[Path]] = {}
    for path in modules():
        for room in sorted(imported_by(path)):
            found.setdefault((room_of(path), room), []).append(path)
    return found


def arrows_up() -> list[tuple[str, str]]:
    """Those to a room that is not below, or is unknown."""
    floor = {room: number for number, room in enumerate(ROOMS)}
    return [(a, b) for a, b in arrows() if floor.get(b, len(floor)) >= floor.get(a, -1)]


def lines_of_code(text: str) -> int:
    """Lines that are neither blank, comment nor docstring."""
    return _look(text).lines


def sizes() -> Counter[str]:
    """Lines of code by room."""
    found: Counter[str] = Counter()
    for path in modules():
        found[room_of(path)] += lines_of_code(path.read_text())
    return found
