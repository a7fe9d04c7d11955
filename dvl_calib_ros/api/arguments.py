"""Arguments that several functions of the interface share."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..calibration.models.parameters import Parameters
from ..discovery.discover import discover
from ..discovery.discovery import Discovery, Given
from ..errors import InputError
from ..recordings.recording import Recording, open_recording

if TYPE_CHECKING:
    from ..bags.writer import Compression, Storage

StrPath = str | os.PathLike[str]
Bags = StrPath | Sequence[StrPath]


def as_path(given: StrPath | None) -> Path | None:
    """Return a path as such, or None."""
    return None if given is None else Path(given)


def storage_and_compression(storage: str, compression: str) -> tuple[Storage, Compression]:
    """Check storage and compression of a new bag. Raises InputError."""
    from ..bags.writer import Compression, Storage

    try:
        return Storage(storage), Compression(compression)
    except ValueError as error:
        known = (", ".join(each.value for each in kind) for kind in (Storage, Compression))
        raise InputError("{}; storage is one of {}; compression is one of {}".format(error, *known)) from None


def as_paths(bags: Bags) -> list[Path]:
    """Return one or several recordings as paths. Raises InputError for none, or for anything else."""
    try:
        found = [Path(bags)] if isinstance(bags, str | os.PathLike) else [Path(bag) for bag in bags]
    except TypeError:
        raise InputError(f"bags={bags!r}: expected the path of a bag, or a list of paths") from None
    if not found:
        raise InputError("no bag is named; name one at least")
    return found


def parameters_from(params: StrPath | None, given: Mapping[str, Any]) -> tuple[Parameters, frozenset[str]]:
    """Merge the parameters of a file and of a call; also return the names that either sets."""
    from ..files.parameter_files import given_parameters, load_parameters

    path = None if params is None else Path(params)
    return load_parameters(path).replace(**given), given_parameters(path) | frozenset(given)


def discovered_in(
    paths: list[Path],
    topics: tuple[str | None, str | None, str | None],
    params: StrPath | None,
    given: Mapping[str, Any],
) -> tuple[Recording, Discovery]:
    """Open recordings and discover their topics, mounting and frames, except those that the call names."""
    parameters, names = parameters_from(params, given)
    dvl, gnss, imu = topics
    recording = open_recording(paths, None, parameters)
    return recording, discover(recording, parameters, Given(dvl, gnss, imu, names))
