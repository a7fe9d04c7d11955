"""Peer (d): the correlation of what a calibration leaves with each effect; the strongest is named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scipy import stats

from dvl_calib_ros.calibration.models.parameters import Parameters

from .answers import Document, Found, answer, is_seeing, parameters_from
from .residual import residual

# Level of the family; a share of the strongest at which another is one, too;
# how much more something that is no effect has to explain
LEVEL = 1e-3
NEAR = 0.9
UNKNOWN = 1.15


def diagnose(paths: Sequence[Path], parameters: Parameters) -> Document:
    """The answer to bags of one vehicle. Raises InputError."""
    left = residual(paths, parameters)
    explained = {name: left.explained(left.places[name]) for name in left.effects}
    chances = {name: stats.chi2.sf(explained[name], len(left.places[name])) * len(explained) for name in explained}
    likely = [name for name in explained if chances[name] < LEVEL]
    plain = max(left.explained([*places]) for places in left.generic_places)
    strongest = "dvl_time_offset" if left.shift_s else max(explained, key=lambda name: explained[name])
    if not left.shift_s and (not likely or plain > UNKNOWN * explained[strongest]):
        if stats.chi2.sf(plain, 3) * len(left.generic_places) < LEVEL:
            return answer("unknown")
        return answer("no_gap" if is_seeing(left.search, left.alone) else "insufficient_excitation")
    near = [name for name in likely if name != strongest and explained[name] > NEAR * explained[strongest]]
    equals = ["reference_time_offset"] if left.shift_s else near
    found = Found(strongest, parameters_from(left.sizes([strongest]), strongest), equals)
    return answer("ambiguous" if equals else "known", [found])
