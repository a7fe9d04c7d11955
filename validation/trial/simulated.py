"""What a simulated case draws: motion, vehicle, noise, faults of the strength wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .motion import RECORDED, Motion, manoeuvre
from .plan import ONE_SPEED_BOX, STRAIGHT, Case
from .recorded import RECORDINGS, recorded
from .sizes import direction, log_uniform, oddity, sized
from .strength import Scene, Yardstick, largest_correlation, outside_share
from .truth import Category
from .vehicle import FAULTS, Faults, Vehicle, of_one_recording

MAX_PAIR_CORRELATION = 0.8
# What one fault of the library, or two, must leave of the square of an unknown one, or it would be taken for them
MIN_OUTSIDE_SHARES = (0.45, 0.35)
# A fault that is to be hidden must not be stronger than this
MAX_HIDDEN_Q = 1.0

Known = tuple[Faults, dict[str, Any]]
"""Faults, and what else is true of them: fields of `Truth`."""


def scene(case: Case, rng: np.random.Generator) -> Scene:
    """Draw motion, vehicle and instruments."""
    body = vehicle(rng)
    gnss_rate = float(rng.choice([1.0, 2.0, 4.0, 5.0, 10.0]))
    return Scene(
        motions=_motions(case.kind, rng),
        vehicle=body,
        dvl_rate=float(rng.choice([1.0, 2.0, 4.0, 5.0, 8.0, 10.0])),
        gnss_rate=gnss_rate,
        beam_std=log_uniform(rng, 0.002, 0.02),
        gnss_std=log_uniform(rng, 0.02, 0.2),
        in_body=bool(rng.uniform() < 0.2) and case.name not in ("heading_error", "attitude_time_offset"),
        gnss_phase_s=float(rng.uniform(0.0, 1.0 / gnss_rate)),
    )


def vehicle(rng: np.random.Generator) -> Vehicle:
    """Draw how a DVL is mounted, how far that is wrong, and what it is like."""
    mounting = (0.0, 0.0, 0.0)
    if rng.uniform() < 0.5:
        mounting = (0.0, 0.0, float(rng.choice([-np.pi / 4, np.pi / 4, np.pi / 2, np.pi])))
    return Vehicle(
        mounting_rpy=mounting,
        misalignment=_triple(rng.normal(0.0, np.deg2rad(1.5), 3)),
        sound_speed_error=float(rng.normal(0.0, 0.006)),
        beam_angle=float(np.deg2rad(rng.choice([20.0, 22.5, 25.0, 30.0]))),
        beam_angle_error=float(rng.normal(0.0, np.deg2rad(0.1))),
        azimuth=float(rng.choice([0.0, np.pi / 4])),
    )


def _motions(kind: str, rng: np.random.Generator) -> tuple[Motion, ...]:
    if kind != RECORDED:
        return (manoeuvre(kind, float(rng.uniform(300.0, 1200.0)), rng, calm=kind in (STRAIGHT, ONE_SPEED_BOX)),)
    return tuple(recorded(str(name)) for name in rng.choice(RECORDINGS, 2, replace=False))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def faults(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    """Draw the faults of a case; None where they are not what the case is for."""
    return _DRAW[case.category](case, drawn, rng)


def _null(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    return {}, {}


def _single(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    yardstick = Yardstick(drawn)
    values = sized(yardstick, case.name, case.q, direction(case.name, drawn, rng))
    return _known_of_one(yardstick, case.name, values) if values else None


def _known_of_one(yardstick: Yardstick, name: str, values: Mapping[str, float]) -> Known:
    apart = yardstick.apart({name: values})[name]
    return {name: values}, {"q": {name: apart.q}, "distances": apart.distances}


def _pair(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    names = [str(name) for name in rng.choice(of_one_recording(drawn.in_body), 2, replace=False)]
    yardstick = Yardstick(drawn)
    both = {name: sized(yardstick, name, case.q, direction(name, drawn, rng)) for name in names}
    if not all(both.values()):
        return None
    vectors = [yardstick.vector({name: values}) for name, values in both.items()]
    spans = [yardstick.span(name) for name in names]
    correlation = largest_correlation(vectors[0], spans[0], vectors[1], spans[1])
    if correlation >= MAX_PAIR_CORRELATION:
        return None
    q = {name: float(np.linalg.norm(vector)) for name, vector in zip(names, vectors, strict=True)}
    return both, {"q": q, "correlation": correlation}


def _unknown(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    yardstick = Yardstick(drawn)
    values = sized(yardstick, case.name, case.q, oddity(case.name, rng))
    if not values:
        return None
    return known_of_unknown(yardstick, case.name, {case.name: values})


def known_of_unknown(yardstick: Yardstick, name: str, together: Faults) -> Known | None:
    """Of a fault outside the library, with others beside it or alone; None if the library would explain it."""
    beside = {other: values for other, values in together.items() if other != name}
    vector = yardstick.vector(together) - yardstick.vector(beside)
    spans = yardstick.spans(beside)
    shares = [outside_share(vector, spans, n) for n in (1, 2)]
    if any(share < least for share, least in zip(shares, MIN_OUTSIDE_SHARES, strict=True)):
        return None
    return together, {"q": {name: yardstick.q_beside(name, together)}, "outside_share": shares[-1]}


def _unidentifiable(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    yardstick = Yardstick(drawn)
    values = direction(case.name, drawn, rng)
    if case.kind == STRAIGHT:  # the calibration takes it all, whatever its size
        values = {name: (3.0 if name in FAULTS[case.name].typical else 1.0) * v for name, v in values.items()}
        if yardstick.q({case.name: values}) > MAX_HIDDEN_Q:
            return None  # it came and went on the way, and so showed
    else:  # a lever arm ahead and sideslip are the same at one speed
        ahead = {name: value if name in ("x_m", "coefficient_s") else 0.0 for name, value in values.items()}
        values = dict(sized(yardstick, case.name, case.q, ahead))
    return _known_of_one(yardstick, case.name, values) if values else None


_DRAW: Mapping[Category, Callable[[Case, Scene, np.random.Generator], Known | None]] = {
    Category.NULL: _null,
    Category.HARD_NULL: _null,
    Category.SINGLE: _single,
    Category.PAIR: _pair,
    Category.UNKNOWN: _unknown,
    Category.UNIDENTIFIABLE: _unidentifiable,
}
