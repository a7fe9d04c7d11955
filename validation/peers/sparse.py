"""Peer (c): sparse regression, sequentially thresholded least squares (pysindy), on what a calibration leaves."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvl_calib_ros.calibration.models.parameters import Parameters

from .answers import Document, Found, answer, is_seeing, named, parameters_from
from .needed import needed
from .residual import Residual, residual

# Tuned on seed 9000 (README.md): a column stays from so many standard deviations on
THRESHOLD = 6.0
RIDGE = 0.03


def diagnose(paths: Sequence[Path], parameters: Parameters) -> Document:
    """The answer to bags of one vehicle. Raises InputError."""
    left = residual(paths, parameters)
    kept = _kept(left)
    shifted = ["dvl_time_offset"] if left.shift_s else []
    effects = [name for name in left.effects if name in shifted or kept[left.places[name]].any()]
    generic = kept[left.n_effects :].any()
    if not effects:
        if generic:
            return answer("unknown")
        return answer("no_gap" if is_seeing(left.search, left.alone) else "insufficient_excitation")
    sizes = left.sizes(effects)
    strength = {name: float(np.abs(left.score[left.places[name]]).max()) for name in effects}
    found = [Found(name, parameters_from(sizes, name)) for name in sorted(effects, key=lambda name: -strength[name])]
    return named(found, bool(generic))


def _kept(left: Residual) -> NDArray[np.bool_]:
    """(P,) which columns the optimizer keeps."""
    optimizer = needed("pysindy").STLSQ(threshold=THRESHOLD, alpha=RIDGE, max_iter=30)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that nothing is kept is an answer
        optimizer.fit(left.unit_columns, left.unit_wanted)
    return np.asarray(np.abs(optimizer.coef_[0]) > 0.0)
