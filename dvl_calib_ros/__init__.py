"""Calibrate a Doppler velocity log before a dive: live on ROS 2 Jazzy and over recorded bags.

The public interface, which is `api`: what the commands do, as functions, and what they take and give. It is imported
when it is asked for, since the command line must not wait for NumPy to print its help.
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
        apply,
        compare,
        diagnose,
        doctor,
        evaluate,
        export,
        fleet,
        import_files,
        instrument_settings,
        replay,
        report,
        salvage,
        simulate,
    )

__all__ = [
    "Calibration",
    "InputError",
    "Mounting",
    "ParameterError",
    "Parameters",
    "Scenario",
    "apply",
    "compare",
    "diagnose",
    "doctor",
    "evaluate",
    "export",
    "fleet",
    "import_files",
    "instrument_settings",
    "replay",
    "report",
    "salvage",
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


# Subpackages that have the name of a public function
_ALSO_FUNCTIONS = ("export", "fleet", "replay")


class _Callable(_ModuleType):
    """A subpackage that has a public function's name: called, it is that function of `api`."""

    def __call__(self, *given: object, **options: object) -> object:
        """See the function of that name in `dvl_calib_ros.api`."""
        from . import api

        return getattr(api, self.__name__.rpartition(".")[2])(*given, **options)


class _Package(_ModuleType):
    """This package: importing a module of such a subpackage sets the name to it, and it stays callable."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _ALSO_FUNCTIONS and isinstance(value, _ModuleType):
            value.__class__ = _Callable
        super().__setattr__(name, value)


_sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    if name in _ALSO_FUNCTIONS:
        return importlib.import_module(f".{name}", __name__)
    return getattr(importlib.import_module(".api", __name__), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
