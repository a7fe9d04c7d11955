"""Calibrate a Doppler velocity log before a dive: live on ROS 2 Jazzy and over recorded bags.

The public interface is `api`: the commands as functions. It is imported on first use, so that the command line need not
wait for NumPy to print its help.
"""

from .version import __version__ as __version__

TYPE_CHECKING = False  # as in typing, whose import takes longer than the rest of this module
if TYPE_CHECKING:
    from .api import Calibration, InputError, Mounting, ParameterError, Parameters, Scenario
    from .api.analyse import compare, diagnose, doctor, evaluate, fleet, replay, simulate
    from .api.convert import apply, export, import_files, instrument_settings, report, salvage

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


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(".api", __name__), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
