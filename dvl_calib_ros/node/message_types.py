"""Message classes by the name of their type; only what is asked for is imported."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import InputError
from ..messages.drivers import VELOCITY_TYPES, may_be_recognised, velocity_type
from ..messages.type_recognition import recognised


def velocity_class(parameter: str, name: str) -> Any:
    """The class of the type that parameter dvl_type or gnss_type names; one that nobody knows is known by its fields.

    Raises InputError if it is none, or its package is not installed.
    """
    if parameter == "dvl_type" and name not in VELOCITY_TYPES and may_be_recognised(name):
        package, _, rest = name.partition("/")
        full = f"{package}/msg/{rest.removeprefix('msg/')}"
        found = message_class(parameter, full)
        recognised(full, found.get_fields_and_field_types())
        name = full
    return message_class(parameter, velocity_type(parameter, name).name)


def message_class(what: str, name: str) -> Any:
    """The class of type ``package/msg/Name``. Raises InputError if its package is not installed.

    what: the parameter or topic that asks for it, for the error.
    """
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError) as error:
        known = VELOCITY_TYPES.get(name)
        how = known.install if known and known.install else f"install {package}"
        raise InputError(
            f"{what} {name}: the message package {package} is not installed ({error}); {how}, and source its setup.bash"
        ) from error
