"""Libraries of the peers, which nothing else of the project needs: imported when a peer is asked."""

from __future__ import annotations

import importlib
from types import ModuleType

from dvl_calib_ros.errors import InputError

INSTALL = "pip install -r validation/peers/requirements.txt"


def needed(name: str) -> ModuleType:
    """A module. Raises InputError, which says what to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"peers: {name} is not installed; {INSTALL}") from error
