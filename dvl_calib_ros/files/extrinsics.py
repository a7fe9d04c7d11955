"""What a result file says of a DVL, in the terms that calibrations are compared in."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..calibration.extrinsics import N_AXES, Extrinsics, dvl_in_words, extrinsics_of
from ..errors import InputError
from .mounting import load_calibrated_mounting
from .result_file import load_result


def load_extrinsics(path: Path, name: str) -> Extrinsics:
    """The selected model's calibration of a result file.

    name: what it is called. Raises InputError for what is no result file, is damaged, or holds no sample.
    """
    calibrated = load_calibrated_mounting(path)
    content, states = load_result(path, of_recording=True)
    model = calibrated.model
    try:
        used = int(content["models"][model.name]["used"])
        span = content["time_span"]["first_ns"], content["time_span"]["last_ns"]
        first_ns, last_ns = (0, 0) if used == 0 else map(int, span)
        none = np.zeros((model.n_state, N_AXES))
        # of before it was kept: what a bias makes of two files is then as of two DVLs
        by_bias = np.array(content["models"][model.name].get("by_dvl_bias", none), dtype=float).reshape(none.shape)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: damaged, or of another version ({type(error).__name__}: {error})") from error
    if not used:
        raise InputError(f"{path}: {model.name} used no sample, so it says nothing of the mounting; leave it out")
    remarks = list(calibrated.objections)
    if initial := calibrated.parameters.initial_calibration:
        remarks.append(
            f"it began with {initial}: with that, and with what else began so, it shares data, and differences come "
            "out smaller than they are"
        )
    state = states[model.name]
    if np.linalg.eigvalsh(state.p - by_bias @ by_bias.T)[0] <= 0.0 or not np.isfinite(by_bias).all():
        raise InputError(f"{path}: damaged, its by_dvl_bias is more than its covariance_of_recording")
    return extrinsics_of(
        name,
        model,
        state,
        calibrated.parameters,
        (first_ns, last_ns),
        used,
        remarks,
        dvl=dvl_in_words(calibrated.dvl_frame, calibrated.turned),
        by_bias=by_bias,
    )
