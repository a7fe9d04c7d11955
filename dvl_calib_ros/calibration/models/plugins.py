"""Calibration models of other packages.

A package declares an entry point of the group `dvl_calib_ros.models` that names a `Model`:

    [project.entry-points."dvl_calib_ros.models"]
    W1 = "my_vehicle.models:W1"

The linear filter runs the model, unless it names an `Estimator`. The estimator must be in another module than the
entry: entry points are loaded while this package is still being imported.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping

from ...errors import InputError
from .base import Model

ENTRY_POINTS = "dvl_calib_ros.models"


def plugged_models(builtin: Mapping[str, Model]) -> tuple[dict[str, Model], list[str]]:
    """Return the models of other packages by name, and an error message for each unusable one.

    builtin: models of this package.
    """
    models: dict[str, Model] = {}
    problems = []
    for name, value in _points():
        try:
            models.update(_loaded(name, value, {**builtin, **models}))
        except InputError as error:
            problems.append(str(error))
    return models, problems


def load(name: str) -> object:
    """Import and return the attribute of "module:attribute". Raise any error of the import."""
    from importlib import import_module

    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def _loaded(name: str, value: str, existing: Mapping[str, Model]) -> dict[str, Model]:
    """Return the model of an entry point by its name. Raises InputError for any fault of its package."""
    try:
        model = load(value)
        if not isinstance(model, Model):
            raise TypeError(f"{value} is no Model")
        if model.name in existing:
            raise ValueError(f"there is a model {model.name!r} already; give it another name")
    except Exception as error:  # another package may raise any error
        raise InputError(
            f"model {name!r} of an installed package: cannot be used ({type(error).__name__}: {error}); repair or "
            "uninstall that package"
        ) from error
    return {model.name: model}


def _points() -> Iterator[tuple[str, str]]:
    """Yield name and value of each entry point."""
    if any(_names_the_group(folder) for folder in sys.path):
        from importlib.metadata import entry_points  # slow import

        for point in entry_points(group=ENTRY_POINTS):
            yield point.name, point.value


def _names_the_group(folder: str) -> bool:
    """Return whether a package installed in a folder of sys.path declares a model."""
    try:
        with os.scandir(folder or ".") as entries:
            found = [entry.path for entry in entries if entry.name.endswith((".dist-info", ".egg-info"))]
    except OSError:
        return False
    for path in found:
        try:
            with open(os.path.join(path, "entry_points.txt"), "rb") as file:
                if ENTRY_POINTS.encode() in file.read():
                    return True
        except OSError:
            continue
    return False
