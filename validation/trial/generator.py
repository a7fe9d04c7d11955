"""A drawn case, recorded: noise added, ordinary bags written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.messages.encode import SampleWriter

from .cases import Drawn, draw
from .motion import Floats, Motion
from .plan import Case
from .scored import RECORDING
from .strength import Scene, Yardstick
from .truth import Truth
from .vehicle import (
    Faults,
    attitude_state,
    dvl_stamps,
    dvl_velocity,
    in_recording,
    recorded_attitude,
    reference_velocity,
)

START_NS = 1_770_000_000_000_000_000
BETWEEN_RECORDINGS_NS = 86_400_000_000_000
IMU_ATTITUDE_STD = 2e-4
IMU_RATE_STD = 5e-4


# How a driver without a vertical velocity shows that: its variance in (m/s)², None for that of the other axes
VERTICALS = {"huge": 1e6, "large": 2.5e3, "minus_one": -1.0, "zero": None, "zero_without_covariance": None}


@dataclass(frozen=True)
class Recorded:
    """Where the bags of a case are, one per recording; and the case."""

    bags: tuple[Path, ...]
    drawn: Drawn

    @property
    def truth(self) -> Truth:
        """To be sealed."""
        return self.drawn.truth

    @property
    def mounting_rpy(self) -> tuple[float, float, float]:
        """How the DVL is said to be mounted, rad."""
        return self.drawn.scene.vehicle.mounting_rpy

    def left_mps(self, said: Faults) -> float:
        """Error (rms) beyond calibration and noise that is left if some faults are said."""
        return Yardstick(self.drawn.scene).error_mps(self.drawn.faults, said)


def record(case: Case, seed: int, folder: Path) -> Recorded:
    """Draw a case and write its bags to a folder that does not exist yet. Raises InputError."""
    drawn = draw(case, seed)
    folder.mkdir(parents=True)
    bags = []
    for number in range(len(drawn.scene.motions)):
        bags.append(folder / f"{RECORDING}{number}")
        start_ns = START_NS + number * BETWEEN_RECORDINGS_NS
        _write(bags[-1], _samples(drawn, number, Noise.of(case.hardness, drawn.scene, drawn.noise), start_ns))
    return Recorded(tuple(bags), drawn)


# ------------------------------------------------------------------ noise


@dataclass(frozen=True)
class Noise:
    """The noise of a recording, ordinary as it stands. Fields make it hard.

    correlation_s: of the reference's noise. degrees_of_freedom: of Student's t instead of a normal distribution.
    outlier_share: of DVL samples that are far off. jitter: of the sampling, in periods. stamp_std: s. gaps: of
    DVL and reference, how many. reported: what the messages claim, as a share of the standard deviation; 0: nothing.
    """

    rng: np.random.Generator
    correlation_s: float = 0.0
    degrees_of_freedom: float = 0.0
    outlier_share: float = 0.0
    jitter: float = 0.0
    stamp_std: float = 0.0
    n_gaps: int = 0
    lost_share: float = 0.0
    reported_dvl: float = 1.0
    reported_gnss: float = 1.0

    @classmethod
    def of(cls, hardness: str | None, scene: Scene, rng: np.random.Generator) -> Noise:
        """The noise of a kind of hard null, or ordinary noise."""
        return _HARD[hardness](rng) if hardness else cls(rng)

    def white(self, shape: tuple[int, ...]) -> Floats:
        """Unit variance."""
        if not self.degrees_of_freedom:
            return self.rng.normal(size=shape)
        df = self.degrees_of_freedom
        return np.asarray(self.rng.standard_t(df, size=shape) / np.sqrt(df / (df - 2.0)))

    def of_reference(self, n: int, rate: float) -> Floats:
        """(n, 3), unit variance, correlated in time or not."""
        white = self.white((n, 3))
        if not self.correlation_s:
            return white
        keep = np.exp(-1.0 / (rate * self.correlation_s))
        start = (keep * self.rng.normal(size=(1, 3))) if n else np.zeros((1, 3))
        return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0, zi=start)[0])

    def sampled(self, stamps: Floats, rate: float) -> Floats:
        """When it is really sampled: jittered, some lost, with gaps."""
        times = stamps + self.jitter / rate * self.rng.uniform(-0.5, 0.5, len(stamps))
        keep = self.rng.uniform(size=len(stamps)) >= self.lost_share
        for _ in range(self.n_gaps):
            start = self.rng.uniform(stamps[0], stamps[-1])
            keep &= (stamps < start) | (stamps > start + self.rng.uniform(5.0, 40.0))
        return np.asarray(np.sort(times[keep]))


_HARD: Mapping[str, Callable[[np.random.Generator], Noise]] = {
    "ar1": lambda rng: Noise(rng, correlation_s=float(rng.uniform(1.0, 8.0))),
    "heavy_tails": lambda rng: Noise(rng, degrees_of_freedom=3.0, outlier_share=0.01),
    "jitter": lambda rng: Noise(rng, jitter=0.8, stamp_std=0.003),
    "gaps": lambda rng: Noise(rng, n_gaps=4, lost_share=0.05),
    "covariance": lambda rng: Noise(
        rng,
        reported_dvl=float(rng.choice([0.0, 0.2, 0.5, 2.0, 5.0])),
        reported_gnss=float(rng.choice([0.0, 0.2, 0.5, 2.0, 5.0])),
    ),
}


# ------------------------------------------------------------------ samples

Sample = DvlSample | ReferenceSample | ImuSample


def _samples(drawn: Drawn, number: int, noise: Noise, start_ns: int) -> list[list[Sample]]:
    """The samples of each sensor in a recording, in order of stamps."""
    scene, motion, faults = drawn.scene, drawn.scene.motions[number], in_recording(drawn.faults, number)
    return [
        _dvl(scene, motion, faults, noise, start_ns),
        _gnss(scene, motion, faults, noise, start_ns),
        _imu(scene, motion, faults, noise, start_ns),
    ]


def _stamps_ns(times: Floats, noise: Noise, start_ns: int) -> list[int]:
    stamps = times + noise.stamp_std * noise.rng.normal(size=len(times))
    return [start_ns + round(stamp * 1e9) for stamp in np.maximum.accumulate(stamps).tolist()]


def _dvl(scene: Scene, motion: Motion, faults: Faults, noise: Noise, start_ns: int) -> list[Sample]:
    times = noise.sampled(scene.dvl_times(motion), scene.dvl_rate)
    axes_from_beams = scene.vehicle.axes_from_beams
    velocity = dvl_velocity(motion, scene.vehicle, faults, times)
    velocity += scene.beam_std * noise.white((len(times), 4)) @ axes_from_beams.T
    wild = noise.rng.uniform(size=len(times)) < noise.outlier_share
    velocity[wild] += noise.rng.uniform(-2.0, 2.0, (int(wild.sum()), 3))
    reported = noise.reported_dvl * scene.beam_std
    covariance = reported**2 * axes_from_beams @ axes_from_beams.T if reported else None
    stamps = dvl_stamps(times, faults)
    newest = np.maximum.accumulate(np.concatenate([[-np.inf], stamps[:-1]]))
    kept = stamps > newest  # a driver drops what its clock, stepping back, stamps before what it has sent
    return [
        DvlSample(stamp, (x, y, z), covariance)
        for stamp, (x, y, z) in zip(_stamps_ns(stamps[kept], noise, start_ns), velocity[kept].tolist(), strict=True)
    ]


def _gnss(scene: Scene, motion: Motion, faults: Faults, noise: Noise, start_ns: int) -> list[Sample]:
    times = noise.sampled(scene.gnss_stamps(motion), scene.gnss_rate)
    velocity = reference_velocity(motion, faults, times, scene.in_body)
    velocity += scene.gnss_std * noise.of_reference(len(times), scene.gnss_rate)
    reported = noise.reported_gnss * scene.gnss_std
    covariance = reported**2 * np.eye(3) if reported else None
    if scene.vertical:
        velocity[:, 2] = 0.0
        covariance = _without_vertical(scene.vertical, covariance)
    frame = VelocityFrame.BODY if scene.in_body else VelocityFrame.ENU
    return [
        ReferenceSample(stamp, (x, y, z), covariance, frame)
        for stamp, (x, y, z) in zip(_stamps_ns(times, noise, start_ns), velocity.tolist(), strict=True)
    ]


def _without_vertical(shown: str, covariance: Floats | None) -> Floats | None:
    variance = VERTICALS[shown]
    if covariance is None or shown == "zero_without_covariance":
        return None
    return covariance if variance is None else np.diag([*np.diag(covariance)[:2], variance])


def _imu(scene: Scene, motion: Motion, faults: Faults, noise: Noise, start_ns: int) -> list[Sample]:
    times = scene.imu_stamps(motion)
    state = attitude_state(motion, faults, times)
    tilt = Rotation.from_rotvec(IMU_ATTITUDE_STD * noise.rng.normal(size=(len(times), 3)))
    attitude = recorded_attitude(state, faults) * tilt
    rates = state.rates + IMU_RATE_STD * noise.rng.normal(size=(len(times), 3))
    if scene.rates_differenced:
        turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * scene.imu_rate
        rates = np.vstack([turns, turns[-1:]])
    return [
        ImuSample(start_ns + round(time * 1e9), (x, y, z, w), (p, q, r))
        for time, (x, y, z, w), (p, q, r) in zip(
            times.tolist(), attitude.as_quat().tolist(), rates.tolist(), strict=True
        )
    ]


def _write(path: Path, sensors: list[list[Sample]]) -> None:
    with BagWriter(path) as bag:
        SampleWriter(bag).recording(*sensors)
