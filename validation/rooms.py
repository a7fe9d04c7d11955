"""The rooms of the package, what each is built of, and how large they are."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

PACKAGE = Path(__file__).resolve().parents[1] / "dvl_calib_ros"
# Packages whose folders are rooms of their own, beside the modules that stand in the package itself
DIVIDED = ("calibration", "diagnosis")
_BASE = ("errors", "version", "verdict")
_NUMERICS = ("verdict", "calibration.numerics", "calibration.models", "calibration.streams")
_JUDGED = (*_NUMERICS, "calibration.filters", "calibration.results", "calibration.checks")
_CALIBRATION = (
    "calibration.numerics", "calibration.models", "calibration.streams", "calibration.filters",
    "calibration.registration", "calibration.results", "calibration.comparison", "calibration.checks",
    "calibration.assessment", "calibration.estimators", "calibration",
)  # fmt: skip
_CORE = (*_BASE, *_CALIBRATION)
_READ = (*_CORE, "bags", "messages", "recordings")
_DIAGNOSED = ("errors", "verdict", *_CALIBRATION[:-1], "effects")
_DIAGNOSIS = ("diagnosis.model", "diagnosis.noise", "diagnosis.fit", "diagnosis.search", "diagnosis.answer")
# Rooms from the ground up: folders and modules of ours, and which of those before it each may import.
# docs/architecture.md has a paragraph on each.
ROOMS: Mapping[str, tuple[str, ...]] = {
    "errors": (),
    "version": (),
    "standard_streams": ("errors",),
    "parallel": ("errors",),
    "verdict": (),
    "calibration.numerics": (),
    "calibration.models": ("errors", "calibration.numerics"),
    "calibration.streams": ("calibration.numerics", "calibration.models"),
    "calibration.filters": _NUMERICS,
    "calibration.registration": _NUMERICS,
    "calibration.results": (*_NUMERICS, "calibration.filters"),
    "calibration.comparison": ("errors", "verdict", "calibration.numerics", "calibration.results"),
    "calibration.checks": _JUDGED[:-1],
    "calibration.assessment": _JUDGED,
    "calibration.estimators": (*_JUDGED, "calibration.registration", "calibration.assessment"),
    "calibration": ("verdict", *_CALIBRATION[:-1]),
    "effects": ("errors", "calibration.numerics", "calibration.registration"),
    "disk": ("errors",),
    "bags": ("errors", "disk"),
    "messages": (*_CORE, "bags"),
    "recordings": (*_CORE, "bags", "messages"),
    "files": (*_CORE, "disk", "messages"),
    "logs": (*_CORE, "bags", "messages"),
    "instruments": (*_CORE, "files"),
    "discovery": (*_READ, "files"),
    "bag_replay": (*_READ, "files"),
    "examination": (*_READ, "discovery", "bag_replay"),
    "fleet_catalogue": (*_READ, "parallel", "disk", "files", "discovery", "bag_replay"),
    "diagnosis.model": (*_DIAGNOSED, "messages", "recordings"),
    "diagnosis.noise": (*_DIAGNOSED, "diagnosis.model"),
    "diagnosis.fit": (*_DIAGNOSED, "diagnosis.model", "diagnosis.noise"),
    "diagnosis.search": (*_DIAGNOSED, "diagnosis.model", "diagnosis.noise", "diagnosis.fit"),
    "diagnosis.answer": (*_DIAGNOSED, "bags", "messages", *_DIAGNOSIS[:-1]),
    "diagnosis": (*_DIAGNOSED, "recordings", *_DIAGNOSIS),
    "simulator_export": (*_CORE, "disk", "files", "effects"),
    "simulation": (*_READ, "effects", "simulator_export"),
    "unpaired": (*_READ, "disk", "effects", *_DIAGNOSIS, "diagnosis", "simulator_export", "simulation"),
    "evaluation": (*_READ, "parallel", "logs", "discovery", "bag_replay", "simulation"),
    "present": (
        *_READ, "disk", "files", "effects", "examination", "bag_replay", "fleet_catalogue", "diagnosis.search",
        "diagnosis.answer", "unpaired", "evaluation",
    ),
    "node": (*_READ, "standard_streams", "disk", "files", "discovery", "simulation"),
    "demo": (*_READ, "files", "node"),
    "api": (
        *_READ, "parallel", "disk", "files", "logs", "instruments", "discovery", "examination", "bag_replay",
        "fleet_catalogue", *_DIAGNOSIS, "diagnosis", "unpaired", "simulator_export", "simulation", "evaluation",
        "present",
    ),
    "cli": (
        *_READ, "standard_streams", "parallel", "disk", "files", "logs", "instruments", "effects", "discovery",
        "examination", "bag_replay", "fleet_catalogue", *_DIAGNOSIS, "diagnosis", "unpaired", "simulator_export",
        "simulation", "evaluation", "present", "node", "demo",
    ),
    "__init__": ("version", "api"),
}  # fmt: skip


def room_of(path: Path) -> str:
    """Return the room of a file of the package."""
    return _room(path.relative_to(PACKAGE).with_suffix("").parts)


def _room(parts: tuple[str, ...]) -> str:
    """Return the room of a module, by its parts below the package."""
    divides = parts[0] in DIVIDED and len(parts) > 1
    return ".".join(parts[:2]) if divides and not _file(parts[:2]).is_file() else parts[0]


def _file(parts: tuple[str, ...]) -> Path:
    return PACKAGE.joinpath(*parts[:-1], f"{parts[-1]}.py")


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


def modules_imported_by(path: Path) -> set[tuple[str, ...]]:
    """Return the modules that a file imports, by their parts below the package, also in functions and for types."""
    inside = path.relative_to(PACKAGE).parent.parts
    found = set()
    for level, module, names in _look(path.read_text()).imports:
        base = (*inside[: len(inside) - (level - 1)], *filter(None, module.split(".")))
        for name in names:
            full = (*base, name)
            is_module = not base or _file(full).is_file() or PACKAGE.joinpath(*full).is_dir()
            found.add(full if is_module else base)
    return found


def imported_by(path: Path) -> set[str]:
    """Return the other rooms that a file imports."""
    return {_room(parts) for parts in modules_imported_by(path)} - {room_of(path)}


def module_circles() -> list[list[str]]:
    """Return the groups of modules that import each other, also in functions and for types."""
    graph: dict[str, set[str]] = {}
    for path in modules():
        name = _module_name(path.relative_to(PACKAGE).with_suffix("").parts)
        graph[name] = {_module_name(parts) for parts in modules_imported_by(path)} - {name}
    rows = {name: number for number, name in enumerate(graph)}
    pairs = [(rows[name], rows[other]) for name, others in graph.items() for other in others if other in rows]
    matrix = csr_array((np.ones(len(pairs)), np.transpose(pairs)), shape=(len(rows), len(rows)))
    _, groups = connected_components(matrix, directed=True, connection="strong")
    together: dict[int, list[str]] = {}
    for name, group in zip(graph, groups, strict=True):
        together.setdefault(int(group), []).append(name)
    return [sorted(names) for names in together.values() if len(names) > 1]


def _module_name(parts: tuple[str, ...]) -> str:
    """Return the dotted name of a module; that of a package is its `__init__`."""
    return ".".join((*parts, "__init__") if PACKAGE.joinpath(*parts).is_dir() else parts)


def arrows() -> dict[tuple[str, str], list[Path]]:
    """Return which room imports which other, and in which files."""
    found: dict[tuple[str, str], list[Path]] = {}
    for path in modules():
        for room in sorted(imported_by(path)):
            found.setdefault((room_of(path), room), []).append(path)
    return found


def arrows_up() -> list[tuple[str, str]]:
    """Return the arrows to a room that is not below, or is unknown."""
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
