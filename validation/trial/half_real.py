"""What a case at sea draws: real motion, and a DVL, a reference and an attitude computed exactly from it.

Faults are as large as at sea, small ones beside large ones as well. What the data could not tell, the draw is not made
of: every fault has a strength of its own beside the others and is apart from every rival, also where the reference
lacks the vertical, so that the same case can be recorded with and without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .motion import BOAT
from .plan import Case, Family
from .recorded import BY_BOAT, WITH_INS, WITHOUT_INS, by_boat, recorded
from .simulated import Known, known_of_unknown, vehicle
from .sizes import as_at_sea, direction, either, log_uniform, oddity, sized
from .strength import OF_THE_DAY, Scene, Yardstick
from .truth import Category
from .vehicle import Faults, Values, of_one_recording

# Every fault is at least so strong beside the others, and so far from every rival: wrong by chance in 1 of 700
MIN_Q, MIN_DISTANCE = 12.0, 6.0
SMALL_Q = (12.0, 30.0)
OFFSETS = OF_THE_DAY[:3]
HORIZONTAL = ("huge", "large", "minus_one", "zero", "zero_without_covariance")
ONE_HZ_SHARE = 0.6
# Of groups of recordings, how many have a reference without a vertical
HORIZONTAL_SHARE = 0.3
# Seconds. What is sampled at 1 Hz cannot tell the turn rates between samples of a motion that is not smoothed at all;
# there are such, but they are the fewer
SMOOTHINGS = {True: (0.0, 0.7, 1.0), False: (0.7, 1.0, 1.5)}


def scene(case: Case, rng: np.random.Generator) -> Scene:
    """Draw motion, vehicle and instruments; with all axes but of a DVL that is far from the reference."""
    if case.family is Family.DISPLACED:
        return _displaced_scene(case, rng)
    n = int(rng.integers(2, 5)) if case.family is Family.SEVERAL else 1
    one_hz, same_instants = rng.uniform() < ONE_HZ_SHARE, rng.uniform() < 0.5
    rate = 1.0 if one_hz else 5.0
    phase = 0.0 if same_instants else float(rng.uniform(0.0, 1.0 / rate))
    sources = _sources(n, rng)
    return Scene(
        motions=tuple(recorded(*source) for source in sources),
        vehicle=vehicle(rng),
        dvl_rate=rate,
        gnss_rate=rate,
        beam_std=log_uniform(rng, 0.002, 0.01),
        gnss_std=log_uniform(rng, 0.005, 0.03),
        in_body=False,
        gnss_phase_s=phase,
        imu_rate=1.0 if one_hz else float(rng.choice([5.0, 20.0])),
        imu_phase_s=phase if one_hz else 0.0,
        rates_differenced=one_hz and bool(rng.uniform() < 0.5),
        vertical=str(rng.choice(HORIZONTAL)) if rng.uniform() < HORIZONTAL_SHARE and n > 1 else "",
        days=n > 1,
        sources=sources,
    )


def _displaced_scene(case: Case, rng: np.random.Generator) -> Scene:
    motion = by_boat(str(rng.choice(BY_BOAT))) if case.kind == BOAT else recorded(*_sources(1, rng)[0])
    dvl_rate, gnss_rate = (float(rng.choice([1.0, 2.0, 5.0, 10.0])) for _ in range(2))
    return Scene(
        motions=(motion,),
        vehicle=vehicle(rng),
        dvl_rate=dvl_rate,
        gnss_rate=gnss_rate,
        beam_std=log_uniform(rng, 0.002, 0.01),
        gnss_std=log_uniform(rng, 0.005, 0.03),
        in_body=False,
        gnss_phase_s=float(rng.uniform(0.0, 1.0 / gnss_rate)),
        imu_rate=float(rng.choice([5.0, 20.0])),
        vertical=str(rng.choice(HORIZONTAL)),
    )


def as_recorded(case: Case, drawn: Scene) -> Scene:
    """The scene with the reference that the case has."""
    if case.family is not Family.HORIZONTAL:
        return drawn
    return replace(drawn, vertical=HORIZONTAL[case.number % len(HORIZONTAL)])


def _sources(n: int, rng: np.random.Generator) -> tuple[tuple[str, float, bool], ...]:
    """Of n recordings: name, smoothing in s, whether the velocity is that of the inertial system."""
    names = rng.choice([*WITH_INS, *WITHOUT_INS], n, replace=False, p=_chances())
    return tuple((name, float(rng.choice(SMOOTHINGS[name in WITH_INS])), name in WITH_INS) for name in names.tolist())


def _chances() -> list[float]:
    """As often with the velocity of the inertial system as without."""
    return [0.5 / len(WITH_INS)] * len(WITH_INS) + [0.5 / len(WITHOUT_INS)] * len(WITHOUT_INS)


def faults(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    """Draw the faults of a case; None where the data could not tell them."""
    if case.category in (Category.NULL, Category.HARD_NULL):
        return {}, {}
    if case.category is Category.UNKNOWN:
        return _unknown(case, drawn, rng)
    several = case.family is Family.SEVERAL
    if case.family is Family.DISPLACED:
        return _apart(Yardstick(drawn), _displaced(case, drawn, rng))
    horizontal = Yardstick(drawn if drawn.vertical or several else replace(drawn, vertical=HORIZONTAL[0]))
    drawn_faults: dict[str, Values] = {}
    for name, is_small in _several_names(case, rng) if several else _names(case, rng):
        drawn_faults[name] = _values(name, drawn, rng)
        if is_small:
            q = float(rng.uniform(*SMALL_Q))
            small = direction(name, drawn, rng)
            drawn_faults[name] = sized(horizontal, name, q, small, {k: v for k, v in drawn_faults.items() if k != name})
        if not drawn_faults[name]:
            return None
    return _apart(horizontal, drawn_faults)


def _apart(yardstick: Yardstick, drawn_faults: Faults) -> Known | None:
    """The faults, and how far each is from all others; None where the data could not tell."""
    if any(yardstick.q_beside(name, drawn_faults) < MIN_Q for name in drawn_faults):
        return None
    apart = yardstick.apart(drawn_faults)
    nearest: dict[str, float] = {}
    for each in apart.values():
        for rival, left in each.distances.items():
            nearest[rival] = min(left, nearest.get(rival, np.inf))
    if min(nearest.values()) < MIN_DISTANCE:
        return None
    return drawn_faults, {"q": {name: each.q for name, each in apart.items()}, "distances": nearest}


def _names(case: Case, rng: np.random.Generator) -> list[tuple[str, bool]]:
    """Names of the faults, and whether each is small beside the others; one time offset at most."""
    if case.category is Category.SINGLE:
        return [(case.name, False)]
    names = ["lever_arm", str(rng.choice(OFFSETS, p=[0.6, 0.2, 0.2]))]
    if case.category is Category.PAIR and case.number % 2 == 0:
        return [(name, False) for name in names]
    others = [name for name in of_one_recording(in_body=False) if name not in (*OFFSETS, "lever_arm")]
    third = (str(rng.choice(others)), bool(rng.uniform() < 0.5))
    if case.category is Category.PAIR:
        return [(names[int(rng.integers(2))], False), third]
    return [*((name, False) for name in names), third]


def _displaced(case: Case, drawn: Scene, rng: np.random.Generator) -> Faults:
    """A long lever arm, and what the name of the case says is beside it."""
    beside, far = case.name.split("+"), rng.normal(size=3) * [1.0, 0.5, 0.3]
    far *= rng.uniform(0.5, 3.5) / np.linalg.norm(far)
    drawn_faults: dict[str, Values] = {"lever_arm": dict(zip(("x_m", "y_m", "z_m"), far.tolist(), strict=True))}
    if "lag" in beside:
        drawn_faults["reference_lag"] = {"time_constant_s": float(rng.uniform(0.3, 1.5))}
    if "late" in beside:
        drawn_faults[str(rng.choice(OFFSETS[:2]))] = {"seconds": either(rng, 0.2, 2.0)}
    if "leap" in beside or "leaps" in beside:
        seconds = drawn.motions[0].seconds
        leap = {"seconds": either(rng, 0.3, 2.0), "at_s": float(rng.uniform(0.25, 0.45)) * seconds}
        again = {"again_seconds": either(rng, 0.3, 2.0), "again_at_s": float(rng.uniform(0.55, 0.75)) * seconds}
        drawn_faults["time_offset_jump"] = {**leap, **(again if "leaps" in beside else {})}
    return drawn_faults


def _several_names(case: Case, rng: np.random.Generator) -> list[tuple[str, bool]]:
    if case.category is Category.SINGLE:
        return [(case.name, False)]
    if case.category is Category.PAIR:
        return [("lever_arm", False), (case.name, False)]
    return [("lever_arm", False), ("dvl_time_offset", False), ("mounting_moved", False)]


def _values(name: str, drawn: Scene, rng: np.random.Generator) -> Values:
    if name not in OF_THE_DAY or not drawn.days:
        return as_at_sea(name, drawn, rng)
    about = either(rng, 0.3, 2.0)
    return {f"seconds@{number}": about + float(rng.uniform(-0.7, 0.7)) for number in range(len(drawn.motions))}


def _unknown(case: Case, drawn: Scene, rng: np.random.Generator) -> Known | None:
    """A fault outside the library, alone or beside a lever arm and a delay."""
    yardstick = Yardstick(replace(drawn, vertical=HORIZONTAL[0]))
    names = ("lever_arm", "dvl_time_offset") if case.number % 2 else ()
    beside = {name: as_at_sea(name, drawn, rng) for name in names}
    values = sized(yardstick, case.name, case.q, oddity(case.name, rng), beside)
    if not values:
        return None
    return known_of_unknown(yardstick, case.name, {**beside, case.name: values})
