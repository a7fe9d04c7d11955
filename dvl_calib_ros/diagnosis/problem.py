"""What is to be explained: the residual of the calibration, and what every effect would add to it.

With the calibration D = (I + diag(δk)) Exp(φ) T and the reference velocity g, the residual is e = D⁻¹ v_dvl - g in the
body frame: beside noise it holds what the calibration still lacks (`base` times a small change of φ and δk) and the
traces of effects. Exp(φ) is the rotation that I + [φ×] stands for; at 5° about several axes the two differ by 0.2 per
cent of the speed, which a diagnosis would take for an effect.

Regressors are made from the calibrated DVL velocity, whose noise is small; those made from the reference would pull
estimates towards zero (errors in variables). But the DVL's noise is in the residual as well, and must not explain
itself. So the motion of a sample is told by its neighbours (`predicted`). That blurs what is quick, which a delay is
seen by best; but the noise of a series shifted in time is as large as before, so a delay, in the form in which it is
undone, gains nothing by the noise of an ideal low-pass of the series itself (`lowpassed`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from ..calibration.frames import Array, skew
from ..calibration.samples import VelocityFrame
from ..effects.base import ActsOn, Effect, EffectInput, Needs
from ..effects.timing import DvlTimeOffset, ReferenceTimeOffset, delayed
from .noise import segments_of
from .recordings import Recording

Values = Mapping[str, float]
DVL_TIME_OFFSET, REFERENCE_TIME_OFFSET = DvlTimeOffset(), ReferenceTimeOffset()
# The calibration is refitted in every hypothesis, held by a prior where the data says little, as of roll and of the
# scale of sway and heave: else these would take in much of a lever arm. Std of φ (rad) and δk
PRIOR_STD: Array = np.array([0.1] * 3 + [0.02] * 3)
# The velocity at a time is told by samples that are this far away: delays within it do not bring its own noise back
OWN_S, NEIGHBOURS_S = 0.6, 4.0
# Bands of the DVL's spectrum, how much louder than the quietest ones counts as motion, and the share of all
# frequencies beyond which none does: what interpolation does to them is not exact
SPECTRUM_BANDS, SIGNAL_TO_NOISE, MAX_BAND = 40, 4.0, 0.6
MIN_SPECTRUM = 40
_ITERATIONS = 6
SHAKES = 2


@dataclass(frozen=True)
class Calibration:
    """φ (3,) rad as a rotation vector and δk (3,), both in the DVL frame, about the nominal mounting T (3, 3)."""

    phi: Array
    scale: Array
    rotation_dvl_from_body: Array

    @cached_property
    def turned(self) -> Array:
        """Exp(φ) T (3, 3)."""
        rotation: Array = Rotation.from_rotvec(self.phi).as_matrix() @ self.rotation_dvl_from_body
        return rotation

    @property
    def body_from_measured(self) -> Array:
        """D⁻¹ (3, 3)."""
        matrix: Array = self.turned.T / (1.0 + self.scale)
        return matrix

    def changed(self, change: Array) -> Calibration:
        """With a change (6,) of φ and δk."""
        turned = Rotation.from_rotvec(change[:3]) * Rotation.from_rotvec(self.phi)
        return replace(self, phi=turned.as_rotvec(), scale=self.scale + change[3:])


@dataclass(frozen=True)
class Problem:
    """Recordings seen with a calibration. M is the number of averaged samples of all of them.

    added: name of an effect -> per recording (N, 3) m/s in the body frame, traces that are known to be in the DVL
    velocity: the motion is made without them. shake: per recording (N, 3) m/s, added to the DVL velocity.
    """

    recordings: tuple[Recording, ...]
    calibration: Calibration
    added: Mapping[str, tuple[Array, ...]] = field(default_factory=dict)
    shake: tuple[Array, ...] | None = None

    @cached_property
    def available(self) -> frozenset[Needs]:
        """What effects may need and every recording has."""
        return frozenset.intersection(*(recording.available for recording in self.recordings))

    @cached_property
    def motions(self) -> tuple[EffectInput, ...]:
        """The vehicle's motion, per recording, at `finer` times for each sample."""
        return tuple(map(self._motion, self.recordings, self._predicted))

    @cached_property
    def _kept_delayed(self) -> dict[str, tuple[tuple[EffectInput, ...], tuple[EffectInput, ...]]]:
        return {}

    def _for_delays(self, left_in: str) -> tuple[tuple[EffectInput, ...], tuple[EffectInput, ...]]:
        """The motion with its quick changes, for mere delays, and as told by neighbours, for the rest; per recording.

        left_in: the effect whose traces are left in it, '' for none.
        """
        if left_in not in self._kept_delayed:
            quick, slow = [], []
            parts = zip(self.recordings, self._velocities(left_in), self._predictors, strict=True)
            for recording, velocity, predict in parts:
                quick.append(self._motion(recording, lowpassed(recording.time, velocity, velocity)))
                slow.append(self._motion(recording, lowpassed(recording.time, predict(velocity), velocity)))
            self._kept_delayed[left_in] = tuple(quick), tuple(slow)
        return self._kept_delayed[left_in]

    def _velocities(self, left_in: str = "") -> list[Array]:
        """(N, 3) m/s per recording: the calibrated DVL velocity, less what is known to be in it but of one effect."""
        matrix = self.calibration.body_from_measured.T
        velocities = [recording.velocity_dvl @ matrix for recording in self.recordings]
        for name, traces in self.added.items():
            if name != left_in:
                velocities = [velocity - trace for velocity, trace in zip(velocities, traces, strict=True)]
        if self.shake is not None:
            velocities = [velocity + shake for velocity, shake in zip(velocities, self.shake, strict=True)]
        return velocities

    @cached_property
    def _predicted(self) -> tuple[Array, ...]:
        """(N, 3) m/s per recording: velocities from each sample's neighbours.

        A sample's own noise is in its residual, too, and what is made of it would seem to explain that: sway or heave
        of little more than the noise would be scaled to it.
        """
        return tuple(predict(velocity) for predict, velocity in zip(self._predictors, self._velocities(), strict=True))

    @cached_property
    def _predictors(self) -> list[_Predictor]:
        unshaken = replace(self, shake=None)._velocities()
        return [
            _Predictor.fitted(recording.time, velocity, recording.every)
            for recording, velocity in zip(self.recordings, unshaken, strict=True)
        ]

    @cached_property
    def shaken(self) -> tuple[tuple[Array, Problem], ...]:
        """Noise like the DVL's, made up, as it is in the residual (M, 3), and the problem with it in the motion.

        What noise that is in both can seem to explain of itself (`selection.own_doing`).
        """
        rng = np.random.default_rng(0)
        made_up = []
        for _ in range(SHAKES):
            noise = tuple(
                predict.std * rng.standard_normal((len(r.time), 3))
                for predict, r in zip(self._predictors, self.recordings, strict=True)
            )
            in_residual = self.joined([r.averaged(one) for r, one in zip(self.recordings, noise, strict=True)])
            made_up.append((in_residual, replace(self, shake=noise)))
        return tuple(made_up)

    def _motion(self, recording: Recording, velocity: Array) -> EffectInput:
        return EffectInput(
            time=recording.fine_time,
            velocity_body=make_interp_spline(recording.time, velocity, k=3)(recording.fine_time),
            rotation_dvl_from_body=self.calibration.rotation_dvl_from_body,
            rotation_enu_from_body=recording.fine_rotation_enu_from_body if Needs.ATTITUDE in self.available else None,
            angular_velocity=recording.fine_angular_velocity if Needs.ANGULAR_VELOCITY in self.available else None,
            reference_frame=recording.reference_frame,
        )

    @cached_property
    def residual(self) -> Array:
        """e (M, 3) m/s, body frame."""
        matrix = self.calibration.body_from_measured.T
        parts = []
        for recording in self.recordings:
            velocity = recording.velocity_dvl @ matrix
            cut_off = _cut_off(recording, velocity)
            parts.append(recording.averaged(velocity - recording.reference_body + cut_off))
        return self.joined(parts)

    @cached_property
    def base(self) -> Array:
        """(M, 3, 6): what a change of φ and δk that the calibration lacks adds to the residual."""
        turned = self.calibration.turned
        parts = []
        for recording, velocity in zip(self.recordings, self._predicted, strict=True):
            velocity = recording.averaged(velocity) @ turned.T
            # v = (I + δk) Exp(δφ) turned u, seen through the calibration without the change
            columns = np.concatenate([-skew(velocity), velocity[:, :, None] * np.eye(3)], axis=2)
            parts.append(np.einsum("ji,njk->nik", turned, columns))
        return self.joined(parts)

    @property
    def prior_change(self) -> Array:
        """(6,) change that would undo the calibration: where the prior of φ and δk has its centre."""
        return -np.concatenate([self.calibration.phi, self.calibration.scale])

    def trace(self, effect: Effect, values: Values) -> Array:
        """(M, 3) m/s that an effect adds to the residual."""
        return self.joined([r.averaged(t) for r, t in zip(self.recordings, self.traces(effect, values), strict=True)])

    def traces(self, effect: Effect, values: Values) -> Sequence[Array]:
        """`trace` per recording (N, 3), before averaging."""
        delay = effect.delay(values)
        if delay:
            is_late = effect.acts_on is ActsOn.MOTION
            quick, slow = self._for_delays(effect.name if is_late else "")
            if is_late:  # what the DVL says now the vehicle did before
                quick, slow = (tuple(advanced(each, delay) for each in those) for those in (quick, slow))
            traces: list[Array] = [
                effect.trace(one, values) + _shift(effect, other, delay) - _shift(effect, one, delay)
                for one, other in zip(slow, quick, strict=True)
            ]
        else:
            traces = [effect.trace(motion, values) for motion in self.motions]
        traces = [trace[:: recording.finer] for recording, trace in zip(self.recordings, traces, strict=True)]
        if effect.acts_on is not ActsOn.DVL:
            return traces
        matrix = self.calibration.body_from_measured @ self.calibration.rotation_dvl_from_body
        return [trace @ matrix.T for trace in traces]

    def sampled(self, of: Callable[[EffectInput], Array]) -> Array:
        """A function of the motion (N, ...) at the M samples."""
        return self.joined(
            [r.averaged(of(motion)[:: r.finer]) for r, motion in zip(self.recordings, self.motions, strict=True)]
        )

    @staticmethod
    def joined(parts: Sequence[Array]) -> Array:
        """One array of what there is for every recording."""
        return np.concatenate(parts)

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Stretches of the M samples without a gap."""
        return segments_of([recording.bin_time for recording in self.recordings])

    @cached_property
    def rotation_enu_from_body(self) -> Array | None:
        """(M, 3, 3), None without attitude."""
        if Needs.ATTITUDE not in self.available:
            return None
        parts = [r.rotation_enu_from_body[_middles(r)] for r in self.recordings]  # type: ignore[index]
        return self.joined(parts)

    @cached_property
    def interval(self) -> float:
        """Median time, s, between neighbours of the M samples."""
        return float(np.median(np.concatenate([np.diff(recording.bin_time) for recording in self.recordings])))

    @cached_property
    def recording_of(self) -> NDArray[np.intp]:
        """(M,) index of the recording that a sample belongs to."""
        return np.repeat(np.arange(len(self.recordings)), [len(r.bin_time) for r in self.recordings])

    @cached_property
    def time(self) -> Array:
        """(M,) s since the beginning of the sample's recording."""
        return self.joined([recording.bin_time for recording in self.recordings])


def advanced(motion: EffectInput, seconds: float) -> EffectInput:
    """The motion with its velocity so many seconds earlier."""
    return replace(motion, velocity_body=delayed(motion.time, motion.velocity_body, -seconds))


def _shift(effect: Effect, motion: EffectInput, delay: float) -> Array:
    """(N, 3) m/s: what is a mere delay in the trace of an effect."""
    return (DVL_TIME_OFFSET if effect.acts_on is ActsOn.MOTION else REFERENCE_TIME_OFFSET).trace(
        motion, {"seconds": delay}
    )


def calibrated(recordings: Sequence[Recording], rotation_dvl_from_body: Array) -> Problem:
    """The problem with the calibration that fits best if there is no effect, robustly."""
    problem = Problem(tuple(recordings), Calibration(np.zeros(3), np.zeros(3), rotation_dvl_from_body))
    for _ in range(_ITERATIONS):
        change = _robust_step(problem)
        problem = Problem(problem.recordings, problem.calibration.changed(change))
        if np.abs(change).max() < 1e-7:
            break
    return problem


def _robust_step(problem: Problem) -> Array:
    """Change (6,) by least squares of samples weighted to their axis and by Huber."""
    columns, residual = problem.base, problem.residual
    prior = problem.prior_change / PRIOR_STD
    x = np.zeros(6)
    scale = np.maximum(1.4826 * np.median(np.abs(residual - np.median(residual, axis=0)), axis=0), 1e-9)
    for _ in range(3):
        standard = (residual - columns @ x) / scale
        scale = scale * np.maximum(1.4826 * np.median(np.abs(standard), axis=0), 1e-6)
        weight = np.sqrt(np.minimum(1.0, 2.5 / np.maximum(np.abs(standard), 1e-12))) / scale
        a = np.concatenate([(columns * weight[:, :, None]).reshape(-1, 6), np.diag(1.0 / PRIOR_STD)])
        x = np.linalg.lstsq(a, np.concatenate([(residual * weight).ravel(), prior]), rcond=None)[0]
    return np.asarray(x)


def _middles(recording: Recording) -> NDArray[np.intp]:
    middles: NDArray[np.intp] = (recording.bins[:-1] + recording.bins[1:] - 1) // 2
    return middles


@dataclass(frozen=True)
class _Predictor:
    """Velocity of each sample as those around it tell best, `own` to `reach` samples away.

    The symmetric filter that predicts a sample from its neighbours with the least error, fitted to the samples
    themselves: their noise is no help in it, so it passes what the vehicle does, waves and turns, and little else.
    weights: (3, reach - own + 1), per axis. mean: (3,) m/s. std: (3,) m/s, of what it does not predict.
    """

    stretches: tuple[slice, ...]
    own: int
    reach: int
    weights: Array
    mean: Array
    std: Array

    @staticmethod
    def fitted(time: Array, velocity: Array, own: int) -> _Predictor:
        """Fit to a velocity (N, 3); own: number of samples whose noise must stay out, at least."""
        interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
        own = max(own, 2, int(np.ceil(OWN_S / interval)))
        reach = max(own + 3, round(NEIGHBOURS_S / interval))
        stretches = tuple(part for part in segments_of([time]) if part.stop - part.start > 2 * reach)
        weights, mean, std = np.zeros((3, reach - own + 1)), velocity.mean(axis=0), np.zeros(3)
        if stretches:
            for axis in range(3):
                series = [velocity[part, axis] - mean[axis] for part in stretches]
                around = np.concatenate([_pairs_around(one, own, reach) for one in series])
                middle = np.concatenate([one[reach:-reach] for one in series])
                weights[axis] = np.linalg.lstsq(around, middle, rcond=1e-6)[0]
                std[axis] = 1.4826 * np.median(np.abs(middle - around @ weights[axis]))
        return _Predictor(stretches, own, reach, weights, mean, std)

    def __call__(self, velocity: Array, mean: Array | None = None) -> Array:
        """Predicted (N, 3) of a velocity (N, 3), by default about the mean of the fit; as it is at the ends."""
        mean = self.mean if mean is None else mean
        out = velocity.copy()
        for part in self.stretches:
            for axis in range(3):
                pairs = _pairs_around(velocity[part, axis] - mean[axis], self.own, self.reach)
                out[part.start + self.reach : part.stop - self.reach, axis] = mean[axis] + pairs @ self.weights[axis]
        return out


def lowpassed(time: Array, velocity: Array, seen: Array) -> Array:
    """A velocity (N, 3) without those frequencies in which that seen (N, 3) is little more than noise.

    By stretch and axis, projected on cosines of low frequency: a low-pass that changes nothing if applied again.
    """
    out = velocity.copy()
    for part in segments_of([time]):
        if part.stop - part.start < MIN_SPECTRUM:
            continue
        spectrum, power = dct(velocity[part], axis=0, norm="ortho"), dct(seen[part], axis=0, norm="ortho") ** 2
        for axis in range(3):
            spectrum[_cut_off_index(power[:, axis]) :, axis] = 0.0
        out[part] = idct(spectrum, axis=0, norm="ortho")
    return out


def _cut_off_index(power: Array) -> int:
    """Number of cosines up to the last band that holds more than noise; the quietest bands are taken for noise."""
    n = len(power)
    edges = np.unique(np.linspace(0, n, SPECTRUM_BANDS + 1).astype(int))
    bands = np.add.reduceat(power, edges[:-1]) / np.diff(edges)
    floor = np.quantile(bands, 0.25)
    above = np.flatnonzero(bands > SIGNAL_TO_NOISE * floor)
    last = edges[above[-1] + 1] if len(above) else edges[1]
    return int(min(last, MAX_BAND * n))


def _pairs_around(series: Array, own: int, reach: int) -> Array:
    """(N - 2 reach, reach - own + 1): for each sample but the outermost, means of the two k before and after it."""
    n = len(series)
    pairs = [series[reach - k : n - reach - k] + series[reach + k : n - reach + k] for k in range(own, reach + 1)]
    return 0.5 * np.column_stack(pairs)


def _cut_off(recording: Recording, velocity_body: Array) -> Array:
    """(N, 3) m/s: what a straight line between two reference samples cuts off turns and waves.

    The DVL says how the velocity (N, 3) went between them, with its noise, which is worth it only if that is smaller
    than what is cut off: it would be in the residual several times over.
    """
    around = recording.reference_around
    if around is None or not around.any() or len(recording.time) < 4:
        return np.zeros_like(velocity_body)
    predict = _Predictor.fitted(recording.time, velocity_body, 1)
    smooth, noise = predict(velocity_body), predict.std
    size = np.sqrt(np.mean(_straight_line_error(recording, around, smooth) ** 2, axis=0))
    if np.linalg.norm(size) < np.linalg.norm(noise):
        return np.zeros_like(velocity_body)
    return _straight_line_error(recording, around, velocity_body)


def _straight_line_error(recording: Recording, around: Array, velocity_body: Array) -> Array:
    time = recording.time
    rotation = None if recording.reference_frame is VelocityFrame.BODY else recording.rotation_enu_from_body
    velocity = velocity_body if rotation is None else np.einsum("nij,nj->ni", rotation, velocity_body)
    curve = make_interp_spline(time, velocity, k=3)
    before = np.clip(time - around[:, 0], time[0], time[-1])
    after = np.clip(time + around[:, 1], time[0], time[-1])
    share = np.divide(time - before, after - before, out=np.zeros_like(time), where=after > before)[:, None]
    error: Array = (1.0 - share) * curve(before) + share * curve(after) - velocity
    return error if rotation is None else np.einsum("nji,nj->ni", rotation, error)
