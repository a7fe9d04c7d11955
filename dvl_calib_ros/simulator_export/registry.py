"""Simulators by name. A new one needs a module like the existing ones and an entry here."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..disk.atomic import own_stream, save_all
from ..disk.text_files import as_json
from ..errors import InputError
from ..version import __version__
from . import dvl_simulator, gazebo, holoocean, stonefish
from .dvl_description import load_description
from .writer import Export, Simulator, export, export_document

SIMULATORS: Mapping[str, Simulator] = {
    "gazebo": gazebo.SIMULATOR,
    "stonefish": stonefish.SIMULATOR,
    "holoocean": holoocean.SIMULATOR,
    "dvl-simulator": dvl_simulator.SIMULATOR,
}


def missing_beside(output: Path) -> Path | None:
    """Return the path of the list of missing effects, next to the output; None for a stream."""
    return None if own_stream(output) is not None else output.with_name(f"{output.name}.missing.json")


def write_settings(simulator: str, source: Path, output: Path, sample: int | None = None) -> Export:
    """Write a source's DVL as the settings of a simulator, and next to it the list of missing effects.

    source: a diagnosis (JSON), a result or a parameter file (YAML). sample: number of a draw of
    `diagnose --samples`. Either both files are written or none. Raises InputError.
    """
    if simulator not in SIMULATORS:
        raise InputError(f"{simulator!r} is none of {', '.join(SIMULATORS)}")
    description = load_description(source, sample)
    exported = export(simulator, SIMULATORS[simulator], description)
    files = {output: exported.settings.text.encode()}
    missing = missing_beside(output)
    if missing is not None:
        files[missing] = as_json(export_document(exported, description, __version__)).encode()
    save_all(files)
    return exported
