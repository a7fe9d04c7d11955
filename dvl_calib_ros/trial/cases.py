"""Which cases a trial has, and what each draws: motion, vehicle, noise, faults of the strength wanted.

A case is drawn from its own random stream, keyed by the trial's seed and the case's key: any case in any order, on any
machine, is the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .motion import (
    HELD_OUT_KINDS,
    RECORDED,
    RECORDINGS,
    TUNING_KINDS,
    Motion,
    manoeuvre,
    recorded,
    recordings_folder,
)
from .strength import Scene, Yardstick, largest_correlation, outside_share
from .truth import Category, Truth
from .vehicle import FAULTS, ODDITIES, Faults, Vehicle

STRENGTHS = (5.0, 8.0, 12.0, 20.0, 40.0)
PAIR_STRENGTHS = (12.0, 20.0)
UNKNOWN_STRENGTHS = (12.0, 20.0, 40.0)
MAX_PAIR_CORRELATION = 0.8
# An unknown fault that the library together explains by more than this is none
MIN_OUTSIDE_SHARE = 0.5
HARDNESSES = ("ar1", "heavy_tails", "jitter", "gaps", "covariance")
STRAIGHT, ONE_SPEED_BOX = "straight", "one_speed_box"
# Faults that a straight run at one speed hides in the calibration, and such that turns at one speed cannot tell apart
HIDDEN = ("velocity_bias", "quadratic_scale", "mount_flexure", "water_lock", "heading_error", "lever_arm")
ALIKE = ("lever_arm", "sideslip")
# A fault that is to be hidden must not be stronger than this
MAX_HIDDEN_Q = 1.0
KINDS = (*TUNING_KINDS, *HELD_OUT_KINDS)
MAX_DRAWS = 60
MAX_STEPS = 8
ALWAYS_S = 1e6
TOLERANCE = 0.005  # of q
# Keyed apart from the seed of a trial: a longer trial with the same seed has the shorter one in it
_ORDER_SEED = 20261121


@dataclass(frozen=True)
class Case:
    """One case, not drawn yet. name: its fault. q: strength wanted. hardness: what makes a null hard."""

    category: Category
    kind: str
    name: str = ""
    q: float = 0.0
    hardness: str | None = None
    number: int = 0

    @property
    def key(self) -> str:
        """Says everything about the case, so it stays with the truth."""
        parts = (self.category.value, self.kind, self.name, f"{self.q:g}", self.hardness, self.number)
        return "/".join(map(str, parts))

    @property
    def id(self) -> str:
        """Says nothing about the case, so bags can be named by it."""
        return hashlib.sha256(self.key.encode()).hexdigest()[:12]

    def seeds(self, seed: int) -> tuple[np.random.Generator, np.random.Generator]:
        """Random streams of what is drawn and of the noise."""
        sequence = np.random.SeedSequence([seed, *self.key.encode()])
        drawn, noise = sequence.spawn(2)
        return np.random.default_rng(drawn), np.random.default_rng(noise)


def plan(kinds: Sequence[str] = KINDS) -> list[Case]:
    """Every case of the full trial of these kinds of trajectory, in an order of which any beginning is a fair part."""
    rng = np.random.default_rng(_ORDER_SEED)
    ranked = []
    for cases in (_nulls(), _hard_nulls(), _singles(), _pairs(), _unknowns(), _unidentifiables()):
        order = rng.permutation(len(cases))
        ranked += [((rank + 0.5) / len(cases), cases[index]) for rank, index in enumerate(order)]
    ranked.sort(key=lambda pair: (pair[0], pair[1].key))
    wanted = set(kinds) | {STRAIGHT, ONE_SPEED_BOX}
    return [case for _, case in ranked if case.kind in wanted]


def _nulls() -> list[Case]:
    return [Case(Category.NULL, KINDS[n % len(KINDS)], number=n) for n in range(420)]


def _hard_nulls() -> list[Case]:
    return [
        Case(Category.HARD_NULL, KINDS[n % len(KINDS)], hardness=hardness, number=n)
        for hardness in HARDNESSES
        for n in range(49)
    ]


def _singles() -> list[Case]:
    return [
        Case(Category.SINGLE, kind, name, q, number=n)
        for name in FAULTS
        for q in STRENGTHS
        for kind in KINDS
        for n in range(2)
    ]


def _pairs() -> list[Case]:
    return [Case(Category.PAIR, kind, q=q, number=n) for q in PAIR_STRENGTHS for kind in KINDS for n in range(10)]


def _unknowns() -> list[Case]:
    return [
        Case(Category.UNKNOWN, kind, name, q)
        for name, oddity in ODDITIES.items()
        for q in UNKNOWN_STRENGTHS
        for kind in oddity.kinds
    ]


def _unidentifiables() -> list[Case]:
    straight = [Case(Category.UNIDENTIFIABLE, STRAIGHT, name, number=n) for name in HIDDEN for n in range(8)]
    one_speed = [
        Case(Category.UNIDENTIFIABLE, ONE_SPEED_BOX, name, 20.0, number=n) for name in ALIKE for n in range(12)
    ]
    return straight + one_speed


# ------------------------------------------------------------------ drawing


@dataclass(frozen=True)
class Drawn:
    """A case as it is recorded: its scene, its faults, its truth, and the random stream of the noise."""

    scene: Scene
    faults: Faults
    truth: Truth
    noise: np.random.Generator


def draw(case: Case, seed: int) -> Drawn:
    """Draw until the case is what it is meant to be. Raises InputError if it never is."""
    rng, noise = case.seeds(seed)
    for _ in range(MAX_DRAWS):
        scene = _scene(case, rng)
        truth = _DRAW[case.category](case, scene, rng)
        if truth is not None:
            return Drawn(scene, truth.faults, truth, noise)
    raise InputError(f"case {case.id} ({case.key}): none of {MAX_DRAWS} draws is as it should be; use another --seed")


def _scene(case: Case, rng: np.random.Generator) -> Scene:
    mounting = (0.0, 0.0, 0.0)
    if rng.uniform() < 0.5:
        mounting = (0.0, 0.0, float(rng.choice([-np.pi / 4, np.pi / 4, np.pi / 2, np.pi])))
    vehicle = Vehicle(
        mounting_rpy=mounting,
        misalignment=_triple(rng.normal(0.0, np.deg2rad(1.5), 3)),
        sound_speed_error=float(rng.normal(0.0, 0.006)),
        beam_angle=float(np.deg2rad(rng.choice([20.0, 22.5, 25.0, 30.0]))),
        beam_angle_error=float(rng.normal(0.0, np.deg2rad(0.1))),
        azimuth=float(rng.choice([0.0, np.pi / 4])),
    )
    gnss_rate = float(rng.choice([1.0, 2.0, 4.0, 5.0, 10.0]))
    return Scene(
        motions=_motions(case.kind, rng),
        vehicle=vehicle,
        dvl_rate=float(rng.choice([1.0, 2.0, 4.0, 5.0, 8.0, 10.0])),
        gnss_rate=gnss_rate,
        beam_std=_log_uniform(rng, 0.002, 0.02),
        gnss_std=_log_uniform(rng, 0.02, 0.2),
        in_body=bool(rng.uniform() < 0.2) and case.name != "heading_error",
        gnss_phase_s=float(rng.uniform(0.0, 1.0 / gnss_rate)),
    )


def _motions(kind: str, rng: np.random.Generator) -> tuple[Motion, ...]:
    if kind != RECORDED:
        return (manoeuvre(kind, float(rng.uniform(300.0, 1200.0)), rng, calm=kind in (STRAIGHT, ONE_SPEED_BOX)),)
    folder = recordings_folder()
    if folder is None:
        raise InputError("no recorded trajectories: name the folder of Snapir's in DVL_CALIB_SNAPIR")
    return tuple(recorded(folder, str(name)) for name in rng.choice(RECORDINGS, 2, replace=False))


def _triple(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _null(case: Case, scene: Scene, rng: np.random.Generator) -> Truth | None:
    return _truth(case, scene, {})


def _single(case: Case, scene: Scene, rng: np.random.Generator) -> Truth | None:
    yardstick = Yardstick(scene)
    faults = {case.name: _sized(yardstick, case.name, case.q, _direction(case.name, scene, rng))}
    if not faults[case.name]:
        return None
    vector = yardstick.vector(faults)
    distances = yardstick.distances(case.name, vector, yardstick.spans())
    return _truth(case, scene, faults, q={case.name: float(np.linalg.norm(vector))}, distances=distances)


def _pair(case: Case, scene: Scene, rng: np.random.Generator) -> Truth | None:
    known = [name for name in FAULTS if not (scene.in_body and name == "heading_error")]
    names = [str(name) for name in rng.choice(known, 2, replace=False)]
    yardstick = Yardstick(scene)
    faults = {name: _sized(yardstick, name, case.q, _direction(name, scene, rng)) for name in names}
    if not all(faults.values()):
        return None
    vectors = [yardstick.vector({name: values}) for name, values in faults.items()]
    spans = [yardstick.span(name) for name in names]
    correlation = largest_correlation(vectors[0], spans[0], vectors[1], spans[1])
    if correlation >= MAX_PAIR_CORRELATION:
        return None
    q = {name: float(np.linalg.norm(vector)) for name, vector in zip(names, vectors, strict=True)}
    return _truth(case, scene, faults, q=q, correlation=correlation)


def _unknown(case: Case, scene: Scene, rng: np.random.Generator) -> Truth | None:
    shape = {name: float(rng.uniform(low, high)) for name, (low, high) in ODDITIES[case.name].shape.items()}
    yardstick = Yardstick(scene)
    direction = {"size": float(rng.choice([-1.0, 1.0])) * ODDITIES[case.name].typical, **shape}
    values = _sized(yardstick, case.name, case.q, direction)
    if not values:
        return None
    vector = yardstick.vector({case.name: values})
    share = outside_share(vector, yardstick.spans())
    if share < MIN_OUTSIDE_SHARE:
        return None
    return _truth(case, scene, {case.name: values}, q={case.name: float(np.linalg.norm(vector))}, outside_share=share)


def _unidentifiable(case: Case, scene: Scene, rng: np.random.Generator) -> Truth | None:
    yardstick = Yardstick(scene)
    direction = _direction(case.name, scene, rng)
    if case.kind == STRAIGHT:  # the calibration takes it all, whatever its size
        values = {name: (3.0 if name in FAULTS[case.name].typical else 1.0) * v for name, v in direction.items()}
    else:  # a lever arm ahead and sideslip are the same at one speed
        direction = {name: value if name in ("x_m", "coefficient_s") else 0.0 for name, value in direction.items()}
        values = _sized(yardstick, case.name, case.q, direction)
    if not values:
        return None
    vector = yardstick.vector({case.name: values})
    if case.kind == STRAIGHT and np.linalg.norm(vector) > MAX_HIDDEN_Q:
        return None  # it came and went on the way, and so showed
    distances = yardstick.distances(case.name, vector, yardstick.spans())
    return _truth(case, scene, {case.name: values}, q={case.name: float(np.linalg.norm(vector))}, distances=distances)


Draw = Callable[[Case, Scene, np.random.Generator], Truth | None]
_DRAW: Mapping[Category, Draw] = {
    Category.NULL: _null,
    Category.HARD_NULL: _null,
    Category.SINGLE: _single,
    Category.PAIR: _pair,
    Category.UNKNOWN: _unknown,
    Category.UNIDENTIFIABLE: _unidentifiable,
}


def _direction(name: str, scene: Scene, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of about typical size, in a random direction."""
    fault = FAULTS[name]
    unit = rng.normal(size=len(fault.typical))
    unit /= np.linalg.norm(unit)
    values = {each: float(size * part) for (each, size), part in zip(fault.typical.items(), unit, strict=True)}
    if fault.positive:
        values = {each: abs(value) for each, value in values.items()}
    if name == "water_lock":
        values |= _window(min(motion.seconds for motion in scene.motions), rng)
    return values


def _window(seconds: float, rng: np.random.Generator) -> dict[str, float]:
    """When the DVL tracks water: all the time, or for some of it."""
    start, length = rng.uniform(0.1, 0.4) * seconds, rng.uniform(0.3, 0.6) * seconds
    if rng.uniform() < 0.5:
        return {"from_s": 0.0, "to_s": ALWAYS_S}
    return {"from_s": float(start), "to_s": float(start + length)}


def _sized(yardstick: Yardstick, name: str, q: float, direction: dict[str, float]) -> dict[str, float]:
    """Parameters along a direction at which the fault has strength q; none if no vehicle would have such a size."""
    scaled = set(FAULTS[name].typical) if name in FAULTS else {"size"}
    typical = FAULTS[name].typical if name in FAULTS else {"size": ODDITIES[name].typical}
    largest = FAULTS[name].largest if name in FAULTS else ODDITIES[name].largest
    size = 1.0
    for _ in range(MAX_STEPS):
        values = {each: value * size if each in scaled else value for each, value in direction.items()}
        if any(abs(values[each]) > largest * typical[each] for each in scaled):
            return {}
        reached = yardstick.q({name: values})
        if reached <= 0.0:
            return {}
        if abs(reached / q - 1.0) < TOLERANCE:
            return values
        size *= q / reached
    return {}


def _truth(case: Case, scene: Scene, faults: Faults, **more: Any) -> Truth:
    return Truth(
        id=case.id,
        category=case.category,
        kind=case.kind,
        faults=faults,
        q_wanted=case.q,
        hardness=case.hardness,
        scene=_document(scene),
        **more,
    )


def _document(scene: Scene) -> dict[str, Any]:
    rest = {f.name: getattr(scene, f.name) for f in fields(scene) if f.name not in ("motions", "vehicle")}
    return {"seconds": [motion.seconds for motion in scene.motions], "vehicle": asdict(scene.vehicle), **rest}
