"""How strong a fault is against the noise, and how far from other faults: what any diagnosis could know at best.

q is the norm of a fault's noise-free trace in the difference of DVL and reference, whitened by the noise, outside of
what misalignment and scale of each axis absorb and, of several faults, outside of what the others would if their sizes
changed. The noise that counts is that at low frequency, where the faults are: the variance of a DVL sample is the DVL's
and the reference's, and this shared among the DVL samples to a reference sample where there are several. So q does not
grow with repeats of one reference sample.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.optimize import minimize_scalar

from .motion import Floats, Motion
from .vehicle import (
    FAULTS,
    Faults,
    Vehicle,
    attitude_state,
    dvl_stamps,
    dvl_velocity_of,
    in_recording,
    of_one_recording,
    recorded_attitude,
    reference_velocity,
)

# Traces of unit faults are differences over this many typical sizes
STEP = 0.1
# Faults of a clock, which change what a DVL sample is compared with, and others of what it is compared with
OF_THE_DAY = ("dvl_time_offset", "reference_time_offset", "attitude_time_offset", "time_offset_jump", "clock_drift")
ON_REFERENCE = frozenset({*OF_THE_DAY, "reference_lag", "heading_error"})
# Faults whose trace bends with their one size, so that small ones do not tell of large ones, and their largest size
BENT: Mapping[str, tuple[str, float]] = {
    **dict.fromkeys(OF_THE_DAY[:3], ("seconds", 4.0)),
    "clock_drift": ("seconds_per_hour", 36.0),
    "reference_lag": ("time_constant_s", 4.0),
}


@dataclass(frozen=True)
class Scene:
    """What is recorded and how well: one motion per recording, rates in Hz, white noise in m/s, first stamps in s.

    in_body: the reference is recorded in the body's frame, else in east-north-up. rates_differenced: angular velocities
    are the turn from each attitude to the next, as those of imported files are, else measured. vertical: how a
    reference without a vertical shows that; '': it has one. days: every recording has its own time offsets. sources:
    of recorded motions, as `recorded` takes them.
    """

    motions: tuple[Motion, ...]
    vehicle: Vehicle
    dvl_rate: float
    gnss_rate: float
    beam_std: float
    gnss_std: float
    in_body: bool
    gnss_phase_s: float
    imu_rate: float = 20.0
    imu_phase_s: float = 0.0
    rates_differenced: bool = False
    vertical: str = ""
    days: bool = False
    sources: tuple[tuple[str, float, bool], ...] = ()

    def dvl_times(self, motion: Motion) -> Floats:
        """(N,) s, when the DVL measures, by a true clock."""
        return np.arange(0.0, motion.seconds, 1.0 / self.dvl_rate)

    def gnss_stamps(self, motion: Motion) -> Floats:
        """(M,) s."""
        return np.arange(self.gnss_phase_s, motion.seconds, 1.0 / self.gnss_rate)

    def imu_stamps(self, motion: Motion) -> Floats:
        """(M,) s."""
        return np.arange(self.imu_phase_s, motion.seconds, 1.0 / self.imu_rate)

    @property
    def dvl_std(self) -> Floats:
        """(3,) m/s of the noise on the DVL's axes."""
        return self.beam_std * np.linalg.norm(self.vehicle.axes_from_beams, axis=1)


@dataclass(frozen=True)
class Apart:
    """How well a fault among others can be known: its q, and what every rival in its place leaves of it at best."""

    q: float
    distances: Mapping[str, float]


class Yardstick:
    """Measures the faults of a scene. Vectors are traces, whitened and outside of what the calibration absorbs."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._times = [scene.dvl_times(motion) for motion in scene.motions]
        # by far the most of what is measured is another fault of the same motion
        self._states = [motion.at(times) for motion, times in zip(scene.motions, self._times, strict=True)]
        self._inside = [
            (times >= scene.gnss_phase_s) & (times <= scene.gnss_stamps(motion)[-1])
            for motion, times in zip(scene.motions, self._times, strict=True)
        ]
        self._enu_from_dvl: Floats | None = None
        sharing = max(scene.dvl_rate / scene.gnss_rate, self._interpolated_share())
        std = np.sqrt(scene.dvl_std**2 + sharing * scene.gnss_std**2)
        if scene.vertical:
            self._enu_from_dvl = self._turns()
            std = std[:2]
        self._std = std
        self._sound_reference = [self._reference(number, {}) for number in range(len(scene.motions))]
        self._sound = self._difference({})
        inside = [velocity[inside] for velocity, inside in zip(self._sound_reference, self._inside, strict=True)]
        self._calibration = self._measured(_calibration_traces(np.vstack(inside)))
        self._absorbed = _basis(self._whitened(self._calibration))

    @property
    def noise_mps(self) -> float:
        """Error (rms of its length) that the noise alone makes of a DVL sample against the reference."""
        variance = self.scene.dvl_std**2 + self._interpolated_share() * self.scene.gnss_std**2
        return float(np.sqrt(variance[: len(self._std)].sum()))

    def error_mps(self, faults: Faults, said: Faults) -> float:
        """Error (rms of its length) that is left without any noise if some faults are there and others are said."""
        off = (self._difference(faults) - self._difference(said)).ravel()
        left = _outside(_basis(self._calibration.reshape(len(off), -1)), off)
        return float(np.sqrt(np.mean((left.reshape(-1, len(self._std)) ** 2).sum(axis=1))))

    def vector(self, faults: Faults) -> Floats:
        """(3 N,) of faults together."""
        trace = self._whitened((self._difference(faults) - self._sound)[..., None])
        return np.asarray(_outside(self._absorbed, trace)[:, 0])

    def q(self, faults: Faults) -> float:
        """Norm of the vector."""
        return float(np.linalg.norm(self.vector(faults)))

    def span(self, name: str, beside: Faults | None = None) -> Floats:
        """(3 N, n) vectors of a fault of the library, of each of its parameters alone, with others beside it."""
        faults = beside or {}
        before = self.vector(faults) if faults else 0.0
        return np.column_stack([self.vector(changed) - before for changed in self._small(name, faults)])

    def spans(self, beside: Faults | None = None) -> dict[str, Floats]:
        """Name -> span of every fault that the library knows."""
        return {name: self.span(name, beside) for name in self._library()}

    def apart(self, faults: Faults) -> dict[str, Apart]:
        """Name -> how well each of several faults can be known."""
        return {name: self._apart(name, faults) for name in faults}

    def q_beside(self, name: str, faults: Faults) -> float:
        """q of one of several faults."""
        return float(np.linalg.norm(self._beside(name, faults)[0]))

    def _beside(self, name: str, faults: Faults) -> tuple[Floats, Floats, Floats]:
        """Trace of one of several faults, outside of the basis of the others; that basis; trace of the others."""
        rest = {other: values for other, values in faults.items() if other != name}
        before = self.vector(rest)
        spans = [self.span(other, faults) for other in rest if other in FAULTS]
        others = _basis(np.hstack(spans)) if spans else np.zeros((len(before), 0))
        return _outside(others, self.vector(faults) - before), others, before

    def _apart(self, name: str, faults: Faults) -> Apart:
        vector, others, before = self._beside(name, faults)
        rest = {other: values for other, values in faults.items() if other != name}
        distances = {}
        for rival in (rival for rival in self._library() if rival not in faults):
            distances[rival] = distance(vector, _outside(others, self.span(rival, rest)))
            if rival in BENT and name in ON_REFERENCE and not self.scene.days:

                def left(size: float, rival: str = rival) -> float:
                    trace = self.vector({**rest, rival: {BENT[rival][0]: size}}) - before
                    return float(np.linalg.norm(vector - _outside(others, trace)))

                distances[rival] = min(distances[rival], *_minima(left, rival))
        return Apart(float(np.linalg.norm(vector)), distances)

    def _library(self) -> list[str]:
        several = len(self.scene.motions) > 1 and self.scene.days
        between = [name for name, fault in FAULTS.items() if fault.between]
        return [*of_one_recording(self.scene.in_body), *(between if several else [])]

    def _small(self, name: str, beside: Faults) -> Iterator[Faults]:
        """The faults beside, with each parameter of one more (or of one of them) changed by a little."""
        seconds = max(motion.seconds for motion in self.scene.motions)
        recordings = range(len(self.scene.motions))
        times: list[dict[str, float]] = [{}]
        if name in beside:
            times = [dict(beside[name])]
        elif name == "water_lock":
            times = [{"from_s": a * seconds, "to_s": (a + 0.5) * seconds} for a in (0.0, 0.25, 0.5)]
        elif name == "time_offset_jump":
            times = [{"at_s": a * seconds} for a in (0.2, 0.35, 0.5, 0.65, 0.8)]
        elif FAULTS[name].between:
            times = [{"from_recording": number} for number in recordings[1:]]
        for parameter, size in FAULTS[name].typical.items():
            named = [f"{parameter}@{k}" for k in recordings] if self.scene.days and name in OF_THE_DAY else [parameter]
            for each in named:
                for at in times:
                    values = {other: 0.0 for other in FAULTS[name].typical} | at
                    yield {**beside, name: values | {each: values.get(each, values.get(parameter, 0.0)) + STEP * size}}

    def _reference(self, number: int, faults: Faults) -> Floats:
        """(N, 3) m/s: what a DVL sample of a recording is compared with, in the DVL's nominal frame."""
        scene, motion = self.scene, self.scene.motions[number]
        stamps = dvl_stamps(self._times[number], faults)
        velocity = reference_velocity(motion, faults, stamps, scene.in_body)
        if not scene.in_body:
            state = attitude_state(motion, faults, stamps)
            velocity = recorded_attitude(state, faults).apply(velocity, inverse=True)
        return np.asarray(scene.vehicle.dvl_from_body.apply(velocity))

    def _difference(self, faults: Faults) -> Floats:
        """(N, 3) m/s DVL less reference in the DVL's frame; (N, 2) east and north of a reference without a vertical."""
        parts = []
        for number in range(len(self.scene.motions)):
            here = in_recording(faults, number)
            reference = (
                self._sound_reference[number] if ON_REFERENCE.isdisjoint(here) else self._reference(number, here)
            )
            measured = dvl_velocity_of(self._states[number], self.scene.vehicle, here)
            parts.append((measured - reference)[self._inside[number]])
        return self._measured(np.vstack(parts)[..., None])[..., 0]

    def _turns(self) -> Floats:
        """(N, 3, 3) from the DVL's nominal frame into east-north-up."""
        parts = [
            motion.at(times[inside]).attitude.as_matrix()
            for motion, times, inside in zip(self.scene.motions, self._times, self._inside, strict=True)
        ]
        return np.asarray(np.vstack(parts) @ self.scene.vehicle.dvl_from_body.inv().as_matrix())

    def _measured(self, traces: Floats) -> Floats:
        """(N, 3, n) m/s in the DVL's nominal frame -> what the reference measures of it: all, or (N, 2, n)."""
        return traces if self._enu_from_dvl is None else np.asarray(self._enu_from_dvl[:, :2] @ traces)

    def _interpolated_share(self) -> float:
        """What interpolation leaves of the reference's variance, on average."""
        shares = []
        for times, inside in zip(self._times, self._inside, strict=True):
            part = np.mod((times[inside] - self.scene.gnss_phase_s) * self.scene.gnss_rate, 1.0)
            shares.append(np.mean(part**2 + (1.0 - part) ** 2))
        return float(np.mean(shares))

    def _whitened(self, traces: Floats) -> Floats:
        """(N, axes, n) m/s -> (axes N, n)."""
        return np.asarray((traces / self._std[:, None]).reshape(-1, traces.shape[-1]))


def _minima(left: Callable[[float], float], rival: str) -> Iterator[float]:
    """The least that a rival leaves, early and late."""
    largest = BENT[rival][1]
    for ends in ((0.0, largest), (-largest, 0.0)):
        if not (FAULTS[rival].positive and ends[0] < 0.0):
            yield float(minimize_scalar(left, bounds=ends, method="bounded", options={"maxiter": 15}).fun)


def _calibration_traces(velocity: Floats) -> Floats:
    """(N, 3) m/s -> (N, 3, 6): what small misalignments about, and scale factors of, the three axes add."""
    traces = np.zeros((len(velocity), 3, 6))
    for axis in range(3):
        traces[:, :, axis] = np.cross(np.eye(3)[axis], velocity)
        traces[:, axis, 3 + axis] = velocity[:, axis]
    return traces


def _basis(columns: Floats) -> Floats:
    """Orthonormal basis of the columns (n, m), without those that the others make up."""
    basis, triangle, _ = qr(columns, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(triangle))
    return np.asarray(basis[:, sizes > 1e-9 * max(sizes[0], 1e-300)])


def _outside(basis: Floats, columns: Floats) -> Floats:
    return columns - basis @ (basis.T @ columns)


def distance(vector: Floats, span: Floats) -> float:
    """Norm of what a span does not explain of a vector: how well the two can be told apart."""
    return float(np.linalg.norm(_outside(_basis(span), vector[:, None])))


def largest_correlation(vector_a: Floats, span_a: Floats, vector_b: Floats, span_b: Floats) -> float:
    """Of two faults, each with all that the other one could be made to look like."""
    explained = [
        1.0 - (distance(vector, span) / np.linalg.norm(vector)) ** 2
        for vector, span in ((vector_a, span_b), (vector_b, span_a))
    ]
    return float(np.sqrt(max(0.0, *explained)))


def outside_share(vector: Floats, spans: Mapping[str, Floats], n: int) -> float:
    """Share of a vector's square that is left by n faults of the library, each the best beside those before it."""
    columns = np.zeros((len(vector), 0))
    left, rivals = np.inf, dict(spans)
    for _ in range(n):
        lefts = {name: distance(vector, np.hstack([columns, span])) for name, span in rivals.items()}
        best = min(lefts, key=lambda name: lefts[name])
        columns, left = np.hstack([columns, rivals.pop(best)]), lefts[best]
    return float(left / np.linalg.norm(vector)) ** 2
