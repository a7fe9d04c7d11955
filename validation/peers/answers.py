"""The form in which every peer answers, and what peers share on the way: the search, what is left, what is seen."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from dvl_calib_ros.calibration.models.parameters import Parameters

from .forward import AXES, CLOCKS, COLUMNS, LINEAR, N_PARTS, Clock, Forward
from .search import (
    ALWAYS,
    Fitted,
    Search,
    Whitening,
    residual_of_all,
    solved,
    step_of,
)
from .streams import Floats, read_streams

Document = dict[str, Any]

NORMAL_95 = 1.959964
# Standard deviation of each effect's parameters before anything was seen, in their units
EXPECTED: Mapping[str, float] = {
    "misalignment": 0.1, "scale": 0.05, "lever_arm": 1.0, "velocity_bias": 0.05, "quadratic_scale": 0.02,
    "scale_drift": 0.1, "misalignment_drift": 0.15, "mount_flexure": 0.015, "axis_nonorthogonality": 0.03,
    "water_lock": 0.2, "heading_error": 0.05, "sideslip": 0.3, "tilt_coupling": 1.5, "dvl_time_offset": 1.0,
    "reference_time_offset": 1.0, "attitude_time_offset": 0.7, "reference_lag": 1.0, "clock_drift": 8.0,
    "time_offset_jump": 1.0,
}  # fmt: skip
# A recording clears only if so many of the effects would have been seen at the size expected
MIN_SEEN = 0.5
SEEN_SHARE = 0.5


@dataclass(frozen=True)
class Found:
    """An effect in an answer. values: parameter -> value and standard deviation, or None where there is no interval."""

    name: str
    values: Mapping[str, tuple[float, float | None]]
    equivalent: Sequence[str] = ()

    def document(self) -> Document:
        """As in the diagnosis's JSON."""
        parameters = {}
        for name, (value, std) in self.values.items():
            interval = None if std is None else [value - NORMAL_95 * std, value + NORMAL_95 * std]
            parameters[name] = {"value": value, "ci95": interval}
        return {"name": self.name, "equivalent_to": sorted(self.equivalent), "parameters": parameters}


def answer(verdict: str, found: Sequence[Found] = ()) -> Document:
    """The answer of a peer, in the form of the diagnosis's JSON."""
    return {"verdict": verdict, "effects": [each.document() for each in found]}


def named(found: Sequence[Found], left: bool) -> Document:
    """Known, ambiguous, or unknown where something is left."""
    if left:
        return answer("unknown", found)
    return answer("ambiguous" if any(each.equivalent for each in found) else "known", found)


@dataclass(frozen=True)
class Searched:
    """What two peers choose from: the sets, the best first, with what they were looked for by; CPU s that took."""

    search: Search
    sets: tuple[Fitted, ...]
    cpu_s: float

    @property
    def alone(self) -> Fitted:
        """The calibration without an effect."""
        return next(each for each in self.sets if not each.members)


@lru_cache(maxsize=1)
def searched(paths: tuple[Path, ...], parameters: Parameters) -> Searched:
    """Search twice: as if the noise were white, then with it whitened about the best. Raises InputError."""
    began = time.process_time()
    model = Forward(read_streams(paths, parameters), parameters.mounting_rpy)
    best = Search(model).best(3)[0]
    model.calibrated(calibration_of(best))
    model.clock = best.clock
    search = Search(model, Whitening(residual_of_all(model, best.clock, best.members)))
    sets = tuple(search.best())
    return Searched(search, sets, time.process_time() - began)


def calibration_of(fitted: Fitted) -> Floats:
    """(6,) misalignment and scale, drawn to none as far as they are not shown.

    A scale across of which nothing is seen came out as 89 %, and then made the DVL's noise twice as large.
    """
    shown = slice(0, 2 * len(AXES))
    covariance = fitted.covariance[shown, shown] * fitted.chi2 / fitted.n
    prior = np.diag([EXPECTED["misalignment"] ** 2] * len(AXES) + [EXPECTED["scale"] ** 2] * len(AXES))
    return np.asarray(prior @ np.linalg.solve(prior + covariance, fitted.values[shown]))


def chance_of_left(search: Search, fitted: Fitted) -> float:
    """Chance of as much being left in any plain function of motion, heading or time, if only noise were."""
    own = search.whiten(search.rows_of(fitted.members, fitted.clock, fitted.values))
    generic = search.whiten(search.model.at(fitted.clock, generic=True)[..., len(COLUMNS) : -1])
    own, generic = own.reshape(-1, own.shape[2]), generic.reshape(-1, generic.shape[2])
    left = own[:, -1] - own[:, :-1] @ solved(own[:, :-1], own[:, -1])[0]
    basis, _ = np.linalg.qr(own[:, :-1])
    outside = generic - basis @ (basis.T @ generic)
    chances = []
    for k in range(0, outside.shape[1], 3):
        some = outside[:, k : k + 3]
        some = some[:, np.linalg.norm(some, axis=0) > 1e-3 * np.linalg.norm(generic[:, k : k + 3], axis=0)]
        if some.shape[1]:
            explained = float(left @ left - solved(some, left)[2])
            chances.append(float(stats.chi2.sf(explained, some.shape[1])))
    return min(1.0, len(chances) * min(chances, default=1.0))


def is_seeing(search: Search, alone: Fitted) -> bool:
    """Whether half of the effects would have shown at the size expected."""
    rows = search.whiten(search.rows_of((), alone.clock))
    calibration = rows[..., :-1].reshape(-1, rows.shape[2] - 1)
    basis, _ = np.linalg.qr(calibration)
    everything = search.whiten(search.model.at(alone.clock)[..., :-1])
    columns = everything.reshape(-1, everything.shape[2])
    seen = []
    for name in search.model.effects:
        if name in LINEAR:
            own = columns[:, [COLUMNS.index(f"{name}.{each}") for each in LINEAR[name]]]
        else:
            own = slope(search, Clock(), name).reshape(-1, 1)
        outside = own - basis @ (basis.T @ own)
        seen.append(float(np.linalg.norm(outside, axis=0).max()) * SEEN_SHARE * EXPECTED[name] > 3.0)
    return float(np.mean(seen)) >= MIN_SEEN


def slope(search: Search, clock: Clock, name: str) -> Floats:
    """(C, N) whitened: how the difference changes with a clock, as a column of what is to be explained."""
    if name == "reference_lag" and not clock.size(name):
        clock = clock.moved(name, 2.0 * step_of(name))
    step = step_of(name)
    ahead, behind = (search.model.differences(clock.moved(name, by)) for by in (step, -step))
    return search.whiten(((behind - ahead) / (2.0 * step))[..., None])[..., 0]


def times_of(fitted: Fitted, name: str, seconds: float) -> dict[str, tuple[float, float | None]]:
    """When an effect is there, of those that come and go."""
    for member in fitted.members:
        if member.name == name == "water_lock":
            start, end = (seconds * edge / N_PARTS for edge in member.spell)
            return {"from_s": (start, None), "to_s": (1e6 if member.spell[1] == N_PARTS else end, None)}
        if member.name == name == "time_offset_jump" and member.spell != ALWAYS:
            return {"at_s": (fitted.clock.leap_at * seconds, None)}
    return {}


def parameters_from(sizes: Mapping[str, tuple[float, float]], name: str) -> dict[str, tuple[float, float | None]]:
    """Of one effect, from columns "effect.parameter"."""
    own = LINEAR.get(name) or (CLOCKS[name],)
    return {each: sizes[f"{name}.{each}"] for each in own}
