"""How large faults are: of a strength wanted, or as large as at sea."""

from __future__ import annotations

import numpy as np

from .strength import Scene, Yardstick
from .vehicle import FAULTS, HOUR_S, ODDITIES, Faults, Values

MAX_STEPS = 8
ALWAYS_S = 1e6
TOLERANCE = 0.005  # of q
# Parameters that say when, which no strength scales
TIMES = frozenset({"from_s", "to_s", "at_s", "from_recording", "again_at_s"})


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def either(rng: np.random.Generator, low: float, high: float) -> float:
    """A random number of a size between two, of either sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def direction(name: str, scene: Scene, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of about typical size, in a random direction."""
    fault = FAULTS[name]
    unit = rng.normal(size=len(fault.typical))
    unit /= np.linalg.norm(unit)
    values = {each: float(size * part) for (each, size), part in zip(fault.typical.items(), unit, strict=True)}
    if fault.positive:
        values = {each: abs(value) for each, value in values.items()}
    return values | _times(name, scene, rng)


def _times(name: str, scene: Scene, rng: np.random.Generator) -> dict[str, float]:
    """When a fault is there, of those that come and go."""
    seconds = min(motion.seconds for motion in scene.motions)
    if name == "time_offset_jump":
        return {"at_s": float(rng.uniform(0.25, 0.75) * seconds)}
    if FAULTS[name].between:
        return {"from_recording": float(rng.integers(1, len(scene.motions)))}
    if name == "water_lock":
        start, length = rng.uniform(0.1, 0.4) * seconds, rng.uniform(0.3, 0.6) * seconds
        always = rng.uniform() < 0.5
        return {"from_s": 0.0 if always else float(start), "to_s": ALWAYS_S if always else float(start + length)}
    return {}


def oddity(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a fault outside the library, of typical size."""
    shape = {each: float(rng.uniform(low, high)) for each, (low, high) in ODDITIES[name].shape.items()}
    return {"size": float(rng.choice([-1.0, 1.0])) * ODDITIES[name].typical, **shape}


def as_at_sea(name: str, scene: Scene, rng: np.random.Generator) -> dict[str, float]:
    """Parameters as large as they were found at sea, or would be before anybody looked."""
    seconds = min(motion.seconds for motion in scene.motions)
    large = {
        "dvl_time_offset": {"seconds": either(rng, 0.2, 3.0)},
        "reference_time_offset": {"seconds": either(rng, 0.2, 3.0)},
        "attitude_time_offset": {"seconds": either(rng, 0.1, 1.5)},
        "time_offset_jump": {"seconds": either(rng, 0.2, 2.0)},
        "clock_drift": {"seconds_per_hour": either(rng, 0.3, 3.0) / seconds * HOUR_S},
        "reference_lag": {"time_constant_s": float(rng.uniform(0.3, 2.0))},
        "lever_arm": {"x_m": either(rng, 0.5, 3.0), "y_m": either(rng, 0.0, 1.0), "z_m": either(rng, 0.0, 1.0)},
    }
    if name in large:
        return large[name] | _times(name, scene, rng)
    times = float(rng.uniform(1.0, 4.0))
    values = direction(name, scene, rng)
    return {each: value if each in TIMES else times * value for each, value in values.items()}


def sized(yardstick: Yardstick, name: str, q: float, values: Values, beside: Faults | None = None) -> Values:
    """Parameters along a direction at which a fault, beside others, has strength q; none if no vehicle is so bad."""
    known = FAULTS.get(name)
    typical = known.typical if known else {"size": ODDITIES[name].typical}
    largest = known.largest if known else ODDITIES[name].largest
    size = 1.0
    for _ in range(MAX_STEPS):
        tried = {each: value * size if each in typical else value for each, value in values.items()}
        if any(abs(tried[each]) > largest * typical[each] for each in typical):
            return {}
        reached = yardstick.q_beside(name, {**(beside or {}), name: tried})
        if reached <= 0.0:
            return {}
        if abs(reached / q - 1.0) < TOLERANCE:
            return tried
        size *= q / reached
    return {}
