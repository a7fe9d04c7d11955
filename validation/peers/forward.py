"""What a DVL and a reference show of each effect: the peers' own forward model, written from the equations alone.

The reference's velocity less the DVL's, in the reference's frame, is a sum of columns: small changes of the
calibration, and every effect that is linear in its parameters. What belongs to a clock or to the reference's filter
changes at which time the columns are taken, and is told by a `Clock`. No code of the package's effects, simulator or
diagnosis is used. Source: spec/models.md and spec/diagnosis.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.errors import InputError

from .streams import Floats, Streams

HOUR_S = 3600.0
# No row is nearer to an end or a gap than a clock may be off, s
MARGIN_S = 4.5
LARGEST_OFFSET_S = 4.0
# What is changed by a clock is cut into so many parts of a run: leaps and currents begin and end between them
N_PARTS = 20
# A lagging reference is filtered in such steps, s
FINE_S = 0.2
ROTATION, SCALE = "misalignment", "scale"
AXES = ("x", "y", "z")
# Parameters of the effects that are linear in them
LINEAR: Mapping[str, tuple[str, ...]] = {
    "lever_arm": ("x_m", "y_m", "z_m"),
    "velocity_bias": ("x_mps", "y_mps", "z_mps"),
    "quadratic_scale": ("coefficient_s_per_m",),
    "scale_drift": ("rate_per_hour",),
    "misalignment_drift": ("x_rad_per_hour", "y_rad_per_hour", "z_rad_per_hour"),
    "mount_flexure": ("x_rad_per_mps", "y_rad_per_mps", "z_rad_per_mps"),
    "axis_nonorthogonality": ("xy_rad", "xz_rad", "yz_rad"),
    "water_lock": ("east_mps", "north_mps"),
    "heading_error": ("sin_rad", "cos_rad"),
    "sideslip": ("coefficient_s",),
    "tilt_coupling": ("x_per_pitch", "z_per_pitch", "y_per_roll", "z_per_roll"),
}
# Parameters of those that move a clock or filter the reference
CLOCKS: Mapping[str, str] = {
    "dvl_time_offset": "seconds",
    "reference_time_offset": "seconds",
    "attitude_time_offset": "seconds",
    "reference_lag": "time_constant_s",
    "clock_drift": "seconds_per_hour",
    "time_offset_jump": "seconds",
}
EFFECTS = (*LINEAR, *CLOCKS)
NEED_AN_EARTH_FRAME = frozenset({"heading_error", "attitude_time_offset"})
CALIBRATION = (*(f"{ROTATION}.{axis}" for axis in AXES), *(f"{SCALE}.{axis}" for axis in AXES))
COLUMNS = (*CALIBRATION, *(f"{name}.{each}" for name, parameters in LINEAR.items() for each in parameters))
PLACES = {name: [COLUMNS.index(f"{name}.{each}") for each in parameters] for name, parameters in LINEAR.items()}
N_CALIBRATION = len(CALIBRATION)


@dataclass(frozen=True)
class Clock:
    """Sizes of the effects in `CLOCKS` (s, s per hour); of a leap, the share of the run at which it comes."""

    sizes: Mapping[str, float] = field(default_factory=dict)
    leap_at: float = 0.5

    def size(self, name: str) -> float:
        """0 where the effect is not there."""
        return self.sizes.get(name, 0.0)

    def moved(self, name: str, by: float) -> Clock:
        """The same with one size changed."""
        return replace(self, sizes={**self.sizes, name: self.size(name) + by})


class Forward:
    """The columns of recordings at any clock, about a calibration that is moved on by `calibrated`.

    Rows are the reference's samples, to whose times the DVL is interpolated.
    """

    def __init__(self, streams: Sequence[Streams], mounting_rpy: Sequence[float]) -> None:
        self.streams = list(streams)
        self.body_from_dvl = Rotation.from_euler("xyz", mounting_rpy).as_matrix()
        self.inverse_calibration = np.eye(3)
        # at which the DVL's noise is taken
        self.clock = Clock()
        self.n_axes = 3 if all(each.vertical for each in self.streams) else 2
        self.in_earth = all(each.in_earth for each in self.streams)
        self._rows = [_inside(each) for each in self.streams]
        if not sum(int(rows.sum()) for rows in self._rows) > 2 * len(COLUMNS):
            raise InputError("too few samples of DVL and reference at the same time; record some minutes")
        shares = [each.reference_s[rows] / each.seconds for each, rows in zip(self.streams, self._rows, strict=True)]
        self.part = np.minimum((np.concatenate(shares) * N_PARTS).astype(np.intp), N_PARTS - 1)

    @property
    def seconds(self) -> float:
        """Of the first recording."""
        return self.streams[0].seconds

    @property
    def effects(self) -> list[str]:
        """Those that the frame of the reference can show."""
        return [name for name in EFFECTS if self.in_earth or name not in NEED_AN_EARTH_FRAME]

    def calibrated(self, small: Floats) -> None:
        """Take a solution's misalignment and scale (6,) into the calibration that columns are about."""
        turn = Rotation.from_rotvec(-small[:3]).as_matrix()
        self.inverse_calibration = turn @ np.diag(1.0 / (1.0 + small[3:6])) @ self.inverse_calibration

    def at(self, clock: Clock, generic: bool = False) -> Floats:
        """(C, N, P + 1) all columns and, last, the difference, at a clock. generic: also those that no effect has."""
        blocks = []
        for streams, rows in zip(self.streams, self._rows, strict=True):
            seen = _Seen(streams, clock, self)
            columns = [*seen.columns(), *(seen.generic() if generic else ()), -seen.turned(seen.body)]
            blocks.append(seen.compared(np.stack(columns, axis=2), rows))
        return np.ascontiguousarray(np.concatenate(blocks)[:, : self.n_axes].transpose(1, 0, 2))

    def differences(self, clock: Clock) -> Floats:
        """(C, N) reference less DVL at a clock."""
        blocks = []
        for streams, rows in zip(self.streams, self._rows, strict=True):
            seen = _Seen(streams, clock, self)
            blocks.append(seen.compared(-seen.turned(seen.body)[..., None], rows)[..., 0])
        return np.concatenate(blocks)[:, : self.n_axes].T


def _inside(streams: Streams) -> NDArray[np.bool_]:
    """Samples of the reference at which DVL and attitude are there, also if a clock is off."""
    time = streams.reference_s
    inside = np.ones(len(time), dtype=bool)
    for other in (streams.dvl_s, streams.imu_s):
        inside &= (time > other[0] + MARGIN_S) & (time < other[-1] - MARGIN_S)
        steps = np.diff(other)
        for k in np.flatnonzero(steps > max(4.0 * float(np.median(steps)), 3.0)).tolist():
            inside &= (time < other[k] - 1.0) | (time > other[k + 1] + 1.0)
    return inside


def _weights(times: Floats, stamps: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Places and weights (n, 4) of a cubic through four neighbours (Catmull and Rom)."""
    left = np.clip(np.searchsorted(stamps, times) - 1, 1, len(stamps) - 3)
    p = np.clip((times - stamps[left]) / (stamps[left + 1] - stamps[left]), 0.0, 1.0)
    weights = 0.5 * np.stack(
        [-p + 2 * p**2 - p**3, 2 - 5 * p**2 + 3 * p**3, p + 4 * p**2 - 3 * p**3, p**3 - p**2], axis=1
    )
    return left[:, None] + np.arange(-1, 3), weights


def _at(times: Floats, stamps: Floats, values: Floats) -> Floats:
    """Values (M, ...) of stamps, at times (n,)."""
    places, weights = _weights(times, stamps)
    return np.asarray(np.einsum("nk,nk...->n...", weights, values[places]))


def _late(clock: Clock, times: Floats, seconds: float) -> Floats:
    """(n,) s by which the DVL's stamps are late."""
    late = clock.size("dvl_time_offset") + clock.size("clock_drift") / HOUR_S * times
    return np.asarray(late + clock.size("time_offset_jump") * (times >= clock.leap_at * seconds))


class _Seen:
    """One recording at a clock, at all samples of the reference; where that lags, at times between them, too."""

    def __init__(self, streams: Streams, clock: Clock, model: Forward) -> None:
        self.clock, self.seconds, self.in_earth = clock, streams.seconds, streams.in_earth
        self.reference, self.body_from_dvl = streams.reference, model.body_from_dvl
        self.true_s = streams.reference_s - clock.size("reference_time_offset")
        self._lag_s = max(clock.size("reference_lag"), 0.0)
        self.elapsed = np.arange(self.true_s[0], self.true_s[-1] + FINE_S, FINE_S) if self._lag_s else self.true_s
        self.attitude = self._attitude(streams, clock, self.elapsed)
        self.rates = _at(self.elapsed + clock.size("attitude_time_offset"), streams.imu_s, streams.rates)
        self.dvl = self._velocity(streams, streams.quiet, clock, self.elapsed) @ model.inverse_calibration.T
        self.body = self.dvl @ model.body_from_dvl.T
        noisy_s = streams.reference_s - model.clock.size("reference_time_offset")
        noise = self._velocity(streams, streams.dvl - streams.quiet, model.clock, noisy_s) @ model.inverse_calibration.T
        self._noise = noise @ model.body_from_dvl.T
        if self.in_earth:
            self._noise = np.einsum("nij,nj->ni", self._attitude(streams, model.clock, noisy_s), self._noise)
        self.speed = np.linalg.norm(self.dvl, axis=1)

    def _velocity(self, streams: Streams, values: Floats, clock: Clock, times: Floats) -> Floats:
        """(n, 3) of values of the DVL's samples, at true times."""
        return _at(times + _late(clock, times, self.seconds), streams.dvl_s, values)

    def _attitude(self, streams: Streams, clock: Clock, times: Floats) -> Floats:
        """(n, 3, 3) at true times."""
        at = times + clock.size("attitude_time_offset")
        return np.asarray(Rotation.from_quat(_at(at, streams.imu_s, streams.attitude)).as_matrix())

    def compared(self, values: Floats, rows: NDArray[np.bool_]) -> Floats:
        """Columns (N, 3, k) at some rows as the reference shows them, the last with the reference and the DVL's noise.

        Noise is not filtered with what is, and is that of one clock: a lag or a clock would be claimed for making it
        smaller, as interpolating does at some clocks more than at others.
        """
        taken = self._lagged(values, rows) if self._lag_s else values[rows]
        taken[..., -1] += self.reference[rows] - self._noise[rows]
        return np.asarray(taken)

    def _lagged(self, values: Floats, rows: NDArray[np.bool_]) -> Floats:
        """At some rows as a reference that lags would show them: first order, exact for what is straight in between."""
        keep = np.exp(-FINE_S / self._lag_s)
        mean = self._lag_s / FINE_S * (1.0 - keep)
        filtered, _ = lfilter([1.0 - mean, mean - keep], [1.0, -keep], values, axis=0, zi=mean * values[:1])
        return _at(self.true_s[rows], self.elapsed, np.asarray(filtered))

    def turned(self, of_body: Floats) -> Floats:
        """(N, 3) of the body in the frame of the reference."""
        return np.einsum("nij,nj->ni", self.attitude, of_body) if self.in_earth else of_body

    def from_dvl(self, of_dvl: Floats) -> Floats:
        """(N, 3) of the DVL's frame in that of the reference."""
        return self.turned(of_dvl @ self.body_from_dvl.T)

    def columns(self) -> Iterator[Floats]:
        """In the order of `COLUMNS`."""
        units, v, hours = np.eye(3), self.dvl, (self.elapsed / HOUR_S)[:, None]
        rotations = [-self.from_dvl(np.cross(unit, v)) for unit in units]
        yield from rotations
        yield from (-self.from_dvl(v * unit) for unit in units)
        yield from (-self.turned(np.cross(self.rates, unit)) for unit in units)
        yield from (-self.from_dvl(np.tile(unit, (len(v), 1))) for unit in units)
        along = self.from_dvl(v)
        yield -along * self.speed[:, None]
        yield -along * hours
        yield from (each * hours for each in rotations)
        yield from (each * self.speed[:, None] for each in rotations)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            sheared = np.zeros_like(v)
            sheared[:, a], sheared[:, b] = v[:, b], v[:, a]
            yield -self.from_dvl(sheared)
        for unit in units[:2]:
            yield np.tile(-unit, (len(v), 1)) if self.in_earth else -np.einsum("nji,j->ni", self.attitude, unit)
        yaw, pitch, roll = self.euler()
        over_ground = self.turned(self.body)
        across = np.column_stack([over_ground[:, 1], -over_ground[:, 0], 0.0 * yaw])
        yield across * np.sin(yaw)[:, None]
        yield across * np.cos(yaw)[:, None]
        level = np.hypot(self.body[:, 0], self.body[:, 1])
        yield -self.turned(np.outer(self.rates[:, 2] * level, units[1]))
        for angle, axis in ((pitch, 0), (pitch, 2), (roll, 1), (roll, 2)):
            yield -self.turned(np.outer(angle, units[axis]))

    def euler(self) -> tuple[Floats, Floats, Floats]:
        """Yaw, pitch, roll, rad."""
        r = self.attitude
        return (
            np.arctan2(r[:, 1, 0], r[:, 0, 0]),
            -np.arcsin(np.clip(r[:, 2, 0], -1.0, 1.0)),
            np.arctan2(r[:, 2, 1], r[:, 2, 2]),
        )

    def generic(self) -> Iterator[Floats]:
        """What may be left and is no effect: on each of the DVL's axes, plain functions of motion, heading and time."""
        for values in self.plain():
            for unit in np.eye(3):
                yield -self.from_dvl(np.outer(values - values.mean(), unit))

    def plain(self) -> Iterator[Floats]:
        """(N,) each."""
        yaw, _, _ = self.euler()
        share = self.elapsed / self.seconds
        surge = np.gradient(self.speed, self.elapsed)
        turn = self.rates[:, 2]
        yield from (self.speed, self.speed**2, self.speed**3, turn, np.abs(turn), np.abs(turn) * self.speed)
        yield from (surge, np.abs(surge), self.rates[:, 0], self.rates[:, 1])
        for k in (1, 2, 3):
            yield np.sin(k * yaw)
            yield np.cos(k * yaw)
        for k in range(1, 9):
            yield np.cos(np.pi * k * share)
