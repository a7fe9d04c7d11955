"""What a calibration alone leaves, whitened, and a library of columns: for the peers that only look at it.

The clock of the DVL is set to the shift at which least is left first, where that is less by a fifth; so columns of
clocks are slopes about a shift that fits, not about none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvl_calib_ros.calibration.models.parameters import Parameters

from .answers import calibration_of, slope
from .forward import CLOCKS, COLUMNS, LINEAR, N_CALIBRATION, Clock, Forward
from .search import OFFSETS, Fitted, Search, Whitening, residual_of_all, solved
from .streams import Floats, read_streams

WORTH_A_SHIFT = 0.8
SLOPED = tuple(name for name in CLOCKS if name != "time_offset_jump")


@dataclass(frozen=True)
class Residual:
    """What is left, (n,), and columns (n, P), effects' first, all outside of the calibration.

    places: of each effect's columns. names: of the first n_effects columns. sets: no column of a leap, which has none.
    """

    search: Search
    alone: Fitted
    shift_s: float
    wanted: Floats
    columns: Floats
    names: tuple[str, ...]
    places: Mapping[str, list[int]]

    @property
    def effects(self) -> list[str]:
        """Names of those with columns."""
        return list(self.places)

    @property
    def n_effects(self) -> int:
        """How many columns are effects'."""
        return len(self.names)

    @property
    def generic_places(self) -> list[range]:
        """Of each plain function, on three axes."""
        return [range(k, k + 3) for k in range(self.n_effects, self.columns.shape[1], 3)]

    @property
    def unit_columns(self) -> Floats:
        """(n, P) of length one: coefficients are in standard deviations of the noise."""
        return self.columns / np.maximum(np.linalg.norm(self.columns, axis=0), 1e-9)

    @property
    def unit_wanted(self) -> Floats:
        """(n, 1)."""
        return self.wanted[:, None]

    @property
    def score(self) -> Floats:
        """(P,) of each column alone, standard deviations."""
        return np.asarray(self.unit_columns.T @ self.wanted)

    def explained(self, places: Sequence[int]) -> float:
        """Sum of squares that columns explain, in units of the noise's."""
        return float(self.wanted @ self.wanted - solved(self.columns[:, list(places)], self.wanted)[2])

    def sizes(self, effects: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Parameters of effects fitted together."""
        places = [place for name in effects for place in self.places[name]]
        values, covariance, chi2 = solved(self.columns[:, places], self.wanted)
        noise = chi2 / len(self.wanted)
        std = np.sqrt(np.maximum(np.diag(covariance) * noise, 0.0))
        found = {self.names[k]: (v, s) for k, v, s in zip(places, values.tolist(), std.tolist(), strict=True)}
        if "dvl_time_offset" in effects:
            value, each = found["dvl_time_offset.seconds"]
            found["dvl_time_offset.seconds"] = (value + self.shift_s, each)
        return found


def residual(paths: Sequence[Path], parameters: Parameters) -> Residual:
    """Of bags of one vehicle. Raises InputError."""
    model = Forward(read_streams(paths, parameters), parameters.mounting_rpy)
    search = Search(model)
    shift_s = _shift(search)
    clock = Clock({"dvl_time_offset": shift_s})
    model.clock = clock
    model.calibrated(calibration_of(search.refined(Fitted((), clock, np.inf, search.n))))
    search = Search(model, Whitening(residual_of_all(model, clock)))
    alone = search.refined(Fitted((), clock, np.inf, search.n))
    whole = search.whiten(model.at(clock, generic=True))
    flat = whole.reshape(-1, whole.shape[2])
    linear = [name for name in model.effects if name in LINEAR]
    names = [f"{name}.{each}" for name in linear for each in LINEAR[name]]
    clocks = [name for name in SLOPED if name in model.effects]
    slopes = [slope(search, clock, name).ravel() for name in clocks]
    own = flat[:, [COLUMNS.index(name) for name in names]]
    columns = np.column_stack([own, *slopes, flat[:, len(COLUMNS) : -1]])
    names += [f"{name}.{CLOCKS[name]}" for name in clocks]
    basis, _ = np.linalg.qr(flat[:, :N_CALIBRATION])
    both = np.column_stack([columns, flat[:, -1]])
    both -= basis @ (basis.T @ both)
    places = {name: [k for k, each in enumerate(names) if each.startswith(f"{name}.")] for name in [*linear, *clocks]}
    return Residual(search, alone, shift_s, both[:, -1], both[:, :-1], tuple(names), places)


def _shift(search: Search) -> float:
    left = {}
    for offset in OFFSETS.tolist():
        clock = Clock({"dvl_time_offset": offset})
        left[offset] = search.refined(Fitted((), clock, np.inf, search.n)).chi2
    best = min(left, key=lambda offset: left[offset])
    return best if left[best] < WORTH_A_SHIFT * left[0.0] else 0.0
