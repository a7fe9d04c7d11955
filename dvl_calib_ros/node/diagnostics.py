"""What /diagnostics says: one status of the running calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from ..calibration.advice import consistency_advice, data_advice, gate_advice
from ..calibration.calibrator import Calibrator
from ..calibration.models import MODELS
from ..calibration.results import Estimate
from .status import STATUS_NAME

# A DVL that has sent nothing for so long is a fault, s.
SILENCE_S = 5.0


def diagnose(
    calibrator: Calibrator, problems: list[str], dvl_silent_s: float | None, running_s: float
) -> DiagnosticStatus:
    """Status of the running calibration. dvl_silent_s: wall time since the last DVL message, None before the first."""
    estimate, counts, selection = calibrator.estimate(), calibrator.counts, calibrator.selection
    faults = _faults(dvl_silent_s, running_s)
    warnings = problems + data_advice(counts) + gate_advice(estimate) + consistency_advice(estimate)
    level = DiagnosticStatus.ERROR if faults else DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
    status = DiagnosticStatus(level=level, name=STATUS_NAME, hardware_id="dvl")
    status.message = "; ".join(faults + warnings) or f"{estimate.model} {estimate.convergence.value}"
    values = {
        "model": estimate.model,
        "why": selection.reason(calibrator.parameters),
        "gnss": selection.gnss.reason,
        "gnss available": str(int(selection.gnss.available)),
        "convergence": estimate.convergence.value,
        **_estimate_values(estimate),
        **_count_values(estimate, counts),
    }
    for number, problem in enumerate(problems, start=1):
        values[f"problem {number}"] = problem
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return status


def _faults(dvl_silent_s: float | None, running_s: float) -> list[str]:
    if dvl_silent_s is None:
        return ["no DVL message yet: check the topic dvl/twist and its type"] if running_s > SILENCE_S else []
    return [f"no DVL message for {dvl_silent_s:.0f} s"] if dvl_silent_s > SILENCE_S else []


def _estimate_values(estimate: Estimate) -> dict[str, str]:
    values = {}
    model, std = MODELS[estimate.model], estimate.std
    for value, entry in zip(estimate.state, estimate.observability, strict=False):
        name = entry.name
        factor, unit = (math.degrees(1.0), "deg") if name.startswith("phi") else (100.0, "%")
        values[f"{name} [{unit}]"] = f"{factor * value:.4f}"
        values[f"std {name} [{unit}]"] = f"{factor * entry.std:.4f}"
        values[f"progress {name} [%]"] = f"{100.0 * entry.progress:.1f}"
        values[f"observed {name}"] = "yes" if entry.observed else f"no ({entry.axis}); needs {entry.missing}"
    for index, nuisance in enumerate(model.nuisance, start=model.n_errors):
        values[f"{nuisance.name} [{nuisance.unit}]"] = f"{estimate.state[index]:.4f}"
        values[f"std {nuisance.name} [{nuisance.unit}]"] = f"{std[index]:.4f}"
    low, high = estimate.nis_bounds
    rows = model.n_measurement
    values["mean NIS"] = f"{estimate.mean_nis:.3f} of {rows} (99 %: {low:.3f} .. {high:.3f})"
    # the same once more as bare numbers, 1 where noise is what it is taken for: plotters read no words
    values["NIS ratio"] = f"{estimate.mean_nis / rows:.4f}"
    values["NIS ratio low"], values["NIS ratio high"] = f"{low / rows:.4f}", f"{high / rows:.4f}"
    return values


def _count_values(estimate: Estimate, counts: Mapping[str, Mapping[str, int]]) -> dict[str, str]:
    values = {"samples used": str(estimate.used), "samples gated": str(estimate.gated)}
    for stream, tally in counts.items():
        for name, count in tally.items():
            values[f"{stream} {name}"] = str(count)
    return values
