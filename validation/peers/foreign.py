"""Recordings outside of the trial's generator: the physics of the shared folder's traps, with one effect or none.

That physics (cases/traps/phys.py; DVL_CALIB_SHARED, else ../shared) was made with neither this package nor the trial.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..combinations.recordings import load_physics, physics_path
from ..trial.truth import Category, Truth
from ..trial.vehicle import Faults

FOREIGN = "foreign"
MANOEUVRES = ("survey", "eight", "legs")
NOMINAL_DEG = ((0, 0, 0), (0, 0, 45), (0, 0, -90), (180, 0, 0))
Streams = dict[str, Any]
Random = np.random.Generator
Values = dict[str, float]


@dataclass(frozen=True)
class Foreign:
    """One case, not drawn yet. name: its effect, or what makes a null hard."""

    category: Category
    name: str
    number: int

    @property
    def key(self) -> str:
        """Says everything about the case."""
        return f"{FOREIGN}/{self.category.value}/{self.name}/{self.number}"

    @property
    def id(self) -> str:
        """Says nothing about it."""
        return hashlib.sha256(self.key.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class ForeignRecording:
    """Where the bag of a case is, and what is true of it; what its error would be, this physics does not tell."""

    bags: tuple[Path, ...]
    truth: Truth
    mounting_rpy: tuple[float, float, float]

    def left_mps(self, said: Faults) -> float:
        """Not known."""
        return math.nan


def has_physics() -> bool:
    """Whether the shared folder is there."""
    return physics_path().exists()


def foreign_cases(n: int) -> list[Foreign]:
    """The first n, nulls and single effects in turns."""
    return list(itertools.islice(_endless(), n))


def _endless() -> Iterator[Foreign]:
    nulls, singles = [*_HARD, "plain"], [*_EFFECTS]
    number = 0
    while True:
        name = nulls[number % len(nulls)]
        yield Foreign(Category.NULL if name == "plain" else Category.HARD_NULL, name, number)
        yield Foreign(Category.SINGLE, singles[number % len(singles)], number)
        number += 1


def record_foreign(case: Foreign, seed: int, folder: Path) -> ForeignRecording:
    """Draw a case and write its bag to a folder that does not exist yet."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *case.key.encode()]))
    physics = load_physics()
    seconds = float(rng.choice([300.0, 400.0, 600.0, 900.0]))
    motion = physics.Motion(
        str(rng.choice(MANOEUVRES)), seconds, seed=int(rng.integers(1 << 30)), heading0=float(rng.uniform(0, 360)),
        speed=float(rng.uniform(0.8, 2.5)), waves=float(rng.choice([0.0, 0.03, 0.05, 0.2])),
        tilt_deg=float(rng.choice([0.5, 1.5, 3.0])), trim_deg=float(rng.choice([0.0, 2.0])),
        slip=float(rng.uniform(0, 0.3)),
    )  # fmt: skip
    nominal = NOMINAL_DEG[int(rng.integers(len(NOMINAL_DEG)))]
    rates = rng.choice([2.0, 5.0, 8.0]), rng.choice([1.0, 5.0, 10.0]), rng.choice([10.0, 20.0, 50.0])
    arm = rng.uniform(0.4, 1.5, 3) * rng.choice([-1.0, 1.0], 3) * [1.0, 0.4, 0.4]
    streams = physics.build(
        motion, rpy=tuple(rng.normal(0, 1.2, 3)), scale=float(rng.normal(0, 0.006)), nominal=nominal,
        arm=tuple(arm) if case.name == "lever_arm" else (0.0, 0.0, 0.0), arm_told=(0.0, 0.0, 0.0),
        dvl_hz=float(rates[0]), gnss_hz=float(rates[1]), imu_hz=float(rates[2]),
        dvl_std=float(rng.choice([0.004, 0.01, 0.02])), gnss_std=float(rng.choice([0.01, 0.03, 0.06])),
        yaw_std=0.03, att_std=0.03, seed=int(rng.integers(1 << 30)),
    )  # fmt: skip
    faults: dict[str, Values] = {}
    if case.category is Category.SINGLE:
        faults = {case.name: _EFFECTS[case.name](streams, motion, rng)}
    elif case.name in _HARD:
        _HARD[case.name](streams, motion, rng)
    folder.mkdir(parents=True)
    physics.write(folder / "recording0", streams)
    truth = Truth(case.id, case.category, FOREIGN, case.key, FOREIGN, faults, noise_mps=math.nan)
    mounting = Rotation.from_euler("xyz", nominal, degrees=True).as_euler("xyz").tolist()
    return ForeignRecording((folder / "recording0",), truth, (mounting[0], mounting[1], mounting[2]))


# ------------------------------------------------------------------ effects


def _late(which: str, parameter: str = "seconds") -> Callable[[Streams, Any, Random], Values]:
    def put_in(streams: Streams, motion: Any, rng: Random) -> Values:
        size = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.15, 1.0))
        streams["stamps"] = lambda stream, time: time + (size if stream == which else 0.0)
        return {parameter: size}

    return put_in


def _lag(streams: Streams, motion: Any, rng: Random) -> Values:
    """A first-order filter at the physics' full rate, then noise as before."""
    seconds = float(rng.uniform(0.3, 1.5))
    time = streams["tg"]
    clean = motion.at("v_enu", time)
    keep = math.exp(-motion.dt / seconds)
    full, filtered = motion.v_enu, np.empty_like(motion.v_enu)
    state = full[0].copy()
    for k, now in enumerate(full):
        state = keep * state + (1.0 - keep) * now
        filtered[k] = state
    streams["gnss"] = streams["gnss"] - clean + np.stack([np.interp(time, motion.t, each) for each in filtered.T], 1)
    return {"time_constant_s": seconds}


def _arm(streams: Streams, motion: Any, rng: Random) -> Values:
    return dict(zip(("x_m", "y_m", "z_m"), streams["arm"].tolist(), strict=True))


def _bias(streams: Streams, motion: Any, rng: Random) -> Values:
    bias = rng.uniform(0.02, 0.06, 3) * rng.choice([-1.0, 1.0], 3)
    streams["dvl"] = streams["dvl"] + bias
    return dict(zip(("x_mps", "y_mps", "z_mps"), bias.tolist(), strict=True))


def _compass(streams: Streams, motion: Any, rng: Random) -> Values:
    sine, cosine = (float(rng.uniform(0.015, 0.05) * rng.choice([-1.0, 1.0])) for _ in range(2))
    yaw = streams["q"].as_euler("ZYX")[:, 0]
    turn = Rotation.from_rotvec(np.outer(sine * np.sin(yaw) + cosine * np.cos(yaw), [0.0, 0.0, 1.0]))
    streams["q"] = turn * streams["q"]
    return {"sin_rad": sine, "cos_rad": cosine}


def _scale_drift(streams: Streams, motion: Any, rng: Random) -> Values:
    rate = float(rng.uniform(0.05, 0.3) * rng.choice([-1.0, 1.0]))
    streams["dvl"] = streams["dvl"] * (1.0 + rate / 3600.0 * streams["td"])[:, None]
    return {"rate_per_hour": rate}


def _current(streams: Streams, motion: Any, rng: Random) -> Values:
    """The DVL sees the water, which moves over ground."""
    east, north = (float(rng.uniform(0.05, 0.3) * rng.choice([-1.0, 1.0])) for _ in range(2))
    in_body = motion.rot_at(streams["td"]).inv().apply([east, north, 0.0])
    added = (1.0 + streams["scale"]) * streams["true"].inv().apply(in_body)
    streams["dvl"] = streams["dvl"] + added
    return {"east_mps": east, "north_mps": north, "from_s": 0.0, "to_s": 1e6}


_EFFECTS: Mapping[str, Callable[[Streams, Any, Random], Values]] = {
    "dvl_time_offset": _late("dvl"), "reference_time_offset": _late("gnss"), "attitude_time_offset": _late("imu"),
    "reference_lag": _lag, "lever_arm": _arm, "velocity_bias": _bias, "heading_error": _compass,
    "scale_drift": _scale_drift, "water_lock": _current,
}  # fmt: skip


# ------------------------------------------------------------------ hard nulls


def _lasting(streams: Streams, motion: Any, rng: Random) -> None:
    """Noise that lasts for seconds, as a receiver's."""
    seconds, size = float(rng.choice([2.0, 5.0])), float(rng.choice([0.02, 0.05]))
    time, noise = streams["tg"], rng.normal(0, 1, streams["gnss"].shape)
    keep = math.exp(-float(time[1] - time[0]) / seconds)
    for k in range(1, len(noise)):
        noise[k] = keep * noise[k - 1] + math.sqrt(1.0 - keep**2) * noise[k]
    streams["gnss"] = streams["gnss"] + size * noise


def _outliers(streams: Streams, motion: Any, rng: Random) -> None:
    for name, time, rate, std in (("dvl", "td", 0.02, 1.0), ("gnss", "tg", 0.01, 2.0)):
        wild = rng.random(len(streams[time])) < rate
        streams[name][wild] += rng.normal(0, std, (int(wild.sum()), 3))


def _gaps(streams: Streams, motion: Any, rng: Random) -> None:
    keep = np.sin(streams["tg"] / 20 + 1) > -0.6
    for name in ("tg", "gnss", "gnss_cov"):
        streams[name] = streams[name][keep]


_HARD: Mapping[str, Callable[[Streams, Any, Random], None]] = {
    "lasting": _lasting, "outliers": _outliers, "gaps": _gaps
}  # fmt: skip
