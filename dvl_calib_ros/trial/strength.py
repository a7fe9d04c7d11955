"""How strong a fault is against the noise, and how far from other faults: what any diagnosis could know at best.

q is the norm of a fault's noise-free trace in the difference of DVL and reference, whitened by the noise, outside of
what misalignment and scale of each axis absorb. The noise that counts is that at low frequency, where the faults are:
the variance of a DVL sample is the DVL's and the reference's, and this shared among the DVL samples to a reference
sample where there are several. So q does not grow with repeats of one reference sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from .motion import Floats, Motion
from .vehicle import FAULTS, REFERENCE_FAULTS, Faults, Vehicle, dvl_velocity, recorded_attitude, reference_velocity

# Traces of unit faults are differences over this many typical sizes
STEP = 0.1


@dataclass(frozen=True)
class Scene:
    """What is recorded and how well: one motion per recording, rates in Hz, white noise in m/s, first stamps in s.

    in_body: the reference is recorded in the body's frame, else in east-north-up.
    """

    motions: tuple[Motion, ...]
    vehicle: Vehicle
    dvl_rate: float
    gnss_rate: float
    beam_std: float
    gnss_std: float
    in_body: bool
    gnss_phase_s: float

    def dvl_stamps(self, motion: Motion) -> Floats:
        """(N,) s."""
        return np.arange(0.0, motion.seconds, 1.0 / self.dvl_rate)

    def gnss_stamps(self, motion: Motion) -> Floats:
        """(M,) s."""
        return np.arange(self.gnss_phase_s, motion.seconds, 1.0 / self.gnss_rate)

    @property
    def dvl_std(self) -> Floats:
        """(3,) m/s of the noise on the DVL's axes."""
        return self.beam_std * np.linalg.norm(self.vehicle.axes_from_beams, axis=1)


class Yardstick:
    """Measures the faults of a scene. Vectors are traces, whitened and outside of what the calibration absorbs."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._pairs = [_paired_stamps(scene, motion) for motion in scene.motions]
        self._sound_reference = self._reference({})
        self._sound = self._difference({})
        sharing = max(scene.dvl_rate / scene.gnss_rate, self._interpolated_share())
        self._std = np.sqrt(scene.dvl_std**2 + sharing * scene.gnss_std**2)
        self._absorbed = _basis(self._whitened(_calibration_traces(self._sound_reference)))

    def vector(self, faults: Faults) -> Floats:
        """(3 N,) of faults together."""
        trace = self._whitened((self._difference(faults) - self._sound)[..., None])
        return np.asarray(_outside(self._absorbed, trace)[:, 0])

    def q(self, faults: Faults) -> float:
        """Norm of the vector."""
        return float(np.linalg.norm(self.vector(faults)))

    def span(self, name: str) -> Floats:
        """(3 N, n) vectors of a fault of the library: of each of its parameters alone."""
        return np.column_stack([self.vector({name: values}) for values in self._small(name)])

    def distances(self, name: str, vector: Floats, spans: Mapping[str, Floats]) -> dict[str, float]:
        """Name of every other fault of the library -> norm of what it leaves of a vector at best."""
        return {other: self._left(other, vector, span) for other, span in spans.items() if other != name}

    def _left(self, name: str, vector: Floats, span: Floats) -> float:
        """Norm of what a fault leaves of a vector at best, at the size that explains it best."""
        if not nonlinear(name) or not span.any():
            return distance(vector, span)
        (parameter, typical), *_ = FAULTS[name].typical.items()
        size = STEP * typical * float(span[:, 0] @ vector / (span[:, 0] @ span[:, 0]))
        if abs(size) < STEP * typical or abs(size) > FAULTS[name].largest * typical:
            return distance(vector, span)
        if FAULTS[name].positive and size < 0.0:
            return float(np.linalg.norm(vector))
        return distance(vector, self.vector({name: {parameter: size}})[:, None])

    def spans(self) -> dict[str, Floats]:
        """Name -> span of every fault that the library knows."""
        return {name: self.span(name) for name in FAULTS if not (self.scene.in_body and name == "heading_error")}

    def _small(self, name: str) -> Iterator[dict[str, float]]:
        typical = FAULTS[name].typical
        seconds = max(motion.seconds for motion in self.scene.motions)
        windows = [(0.0, 0.5), (0.25, 0.75), (0.5, 1.0)] if name == "water_lock" else [(0.0, 1.0)]
        for start, end in windows:
            for changed, size in typical.items():
                values = {each: STEP * size if each == changed else 0.0 for each in typical}
                yield values | ({"from_s": start * seconds, "to_s": end * seconds} if name == "water_lock" else {})

    def _reference(self, faults: Faults) -> Floats:
        """(N, 3) m/s: the reference at the DVL's stamps, in the DVL's nominal frame."""
        scene, parts = self.scene, []
        for motion, (dvl, gnss) in zip(scene.motions, self._pairs, strict=True):
            velocity = reference_velocity(motion, faults, gnss, scene.in_body)
            paired = np.column_stack([np.interp(dvl, gnss, column) for column in velocity.T])
            if not scene.in_body:
                paired = recorded_attitude(motion, faults, dvl).apply(paired, inverse=True)
            parts.append(scene.vehicle.dvl_from_body.apply(paired))
        return np.vstack(parts)

    def _difference(self, faults: Faults) -> Floats:
        scene = self.scene
        measured = [
            dvl_velocity(motion, scene.vehicle, faults, dvl)
            for motion, (dvl, _) in zip(scene.motions, self._pairs, strict=True)
        ]
        on_reference = not REFERENCE_FAULTS.isdisjoint(faults)
        return np.vstack(measured) - (self._reference(faults) if on_reference else self._sound_reference)

    def _interpolated_share(self) -> float:
        """What interpolation leaves of the reference's variance, on average."""
        shares = []
        for dvl, gnss in self._pairs:
            part = np.mod((dvl - gnss[0]) * self.scene.gnss_rate, 1.0)
            shares.append(np.mean(part**2 + (1.0 - part) ** 2))
        return float(np.mean(shares))

    def _whitened(self, traces: Floats) -> Floats:
        """(N, 3, n) m/s -> (3 N, n)."""
        return np.asarray((traces / self._std[:, None]).reshape(-1, traces.shape[-1]))


def _paired_stamps(scene: Scene, motion: Motion) -> tuple[Floats, Floats]:
    dvl, gnss = scene.dvl_stamps(motion), scene.gnss_stamps(motion)
    return dvl[(dvl >= gnss[0]) & (dvl <= gnss[-1])], gnss


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


def nonlinear(name: str) -> bool:
    """Whether a fault's trace bends with its size, so that small ones do not tell of large ones."""
    return name in ("dvl_time_offset", "reference_time_offset", "reference_lag")


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


def outside_share(vector: Floats, spans: Mapping[str, Floats]) -> float:
    """Share of a vector's square that nothing in the library explains, not even all of it together."""
    return (distance(vector, np.column_stack(list(spans.values()))) / float(np.linalg.norm(vector))) ** 2
