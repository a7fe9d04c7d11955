"""The calibration over recorded bags. Callable: ``dvl_calib_ros.replay(bag)`` is `dvl_calib_ros.api.replay`."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """The public function has the subpackage's name, and importing any of it sets that name to the subpackage."""

    def __call__(self, *bags: Any, **options: Any) -> Any:
        """See `dvl_calib_ros.api.replay`."""
        from ..api import replay

        return replay(*bags, **options)


sys.modules[__name__].__class__ = _CallableModule
