"""Calibrate a Doppler velocity log before a dive: live on ROS 2 Jazzy and over recorded bags.

The public interface, which is `api`: replay, compare, doctor, diagnose, simulate, evaluate, and what they take and
give. It is imported when it is asked for, since the command line must not wait for NumPy to print its help.
"""

import sys as _sys
from pathlib import Path as _Path
from types import ModuleType as _ModuleType

TYPE_CHECKING = False  # as in typing, which takes longer than all else here
if TYPE_CHECKING:
    from .api import (
        Calibration,
        InputError,
        Mounting,
        ParameterError,
        Parameters,
        Scenario,
        compare,
        diagnose,
        doctor,
        evaluate,
        replay,
        simulate,
    )

__all__ = [
    "Calibration",
    "InputError",
    "Mounting",
    "ParameterError",
    "Parameters",
    "Scenario",
    "compare",
    "diagnose",
    "doctor",
    "evaluate",
    "replay",
    "simulate",
]


def _version() -> str:
    """The version that package.xml says: of the source tree, else as installed under share/."""
    for folder in (_Path(__file__).resolve().parents[1], _Path(_sys.prefix, "share", "dvl_calib_ros")):
        package = folder / "package.xml"
        if package.is_file():
            head, _, rest = package.read_text(encoding="utf-8").partition("<version>")
            if "<name>dvl_calib_ros</name>" in head:
                return rest.partition("</version>")[0]
    from importlib.metadata import version  # 20 ms, which the command line would feel

    return version("dvl_calib_ros")


__version__ = _version()


class _Callable(_ModuleType):
    """The subpackage `replay`, which has the public function's name: called, it is `api.replay`."""

    def __call__(self, *bags: object, **options: object) -> object:
        """See `dvl_calib_ros.api.replay`."""
        from .api import replay

        return replay(*bags, **options)  # type: ignore[arg-type]


class _Package(_ModuleType):
    """This package: importing any module of `replay` sets that name to the subpackage, which stays callable."""

    def __setattr__(self, name: str, value: object) -> None:
        if name == "replay" and isinstance(value, _ModuleType):
            value.__class__ = _Callable
        super().__setattr__(name, value)


_sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    if name == "replay":  # a subpackage, which is callable
        return importlib.import_module(".replay", __name__)
    return getattr(importlib.import_module(".api", __name__), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
