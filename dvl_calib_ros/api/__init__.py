"""Python interface: one function per command; each returns a dataclass.

    import dvl_calib_ros as dc
    run = dc.replay("my_bag")
    run.mounting
    run.plot()

Angles are in degrees and lengths in metres where a name says so, else SI. Wrong files, topics and values raise
`InputError`, wrong parameters `ParameterError`: one sentence each, with the remedy.
"""

from __future__ import annotations

from ..calibration.models.parameters import ParameterError, Parameters
from ..errors import InputError
from ..simulation.scenario import Scenario
from ..verdict.answering import Answering
from .analyse import compare, diagnose, doctor, evaluate, fleet, replay, simulate
from .calibrated import Calibration, Mounting, framed, printed
from .convert import apply, export, import_files, instrument_settings, report, salvage

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
Answering.laid_out = printed
Answering.framed = framed
