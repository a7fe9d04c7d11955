"""The composed model: what is left of the difference between DVL and reference, with any effects, at any size.

The physics of `effects.composition`, gone backwards. At a true time s, with the stamps that each clock gives it,

    u = D⁻¹ (v_dvl - T traces on DVL(u))        v = u - traces on MOTION(v)        e = v - g - traces on REFERENCE(v)

with D = (I + diag(δk)) Exp(φ + turns on MOUNTING(u)) T and g the reference velocity in the body frame. Exp(φ) is the
rotation that I + [φ×] stands for. Nothing is paired: every stream is a curve of its own, so a delay of seconds is a
change of argument, and e is averaged over bins of two intervals of the slower stream (`DiagnosisSettings`).

Regressors are made of the smoothed DVL velocity, whose noise is small; those made from the reference would pull
estimates towards zero (errors in variables). (Long, because the model and its derivatives stand side by side.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..calibration.numerics.frames import Array, cross, skew
from ..calibration.numerics.samples import VelocityFrame
from ..effects.base import (
    ActsOn,
    ClockEffect,
    Effect,
    EffectInput,
    EffectNeeds,
    EffectParameter,
    EffectWithMemory,
    MountingEffect,
)
from ..effects.composition import Injection, late, traces, turns
from ..effects.recursion import slopes
from .curve import FAST_ENOUGH_S, Curve
from .noise import segments_of
from .recordings import RecordedStreams
from .settings import SETTINGS

Values = Mapping[str, float]
# Passes in which an effect is undone that acts on the very motion it changes: it is small against that motion
_PASSES = 3
# Seconds between the times of a motion that a filter follows as it was, where it is looked at more seldom than
# `FAST_ENOUGH_S`: by its slopes at 1 Hz a wave of 5 s is a quarter too small
CLOSE_S = 0.1
# Effects of which every vehicle has a little: where its DVL sits, and the DVL's bias
OF_EVERY = "lever_arm", "velocity_bias"


def is_time_of_run(spec: EffectParameter) -> bool:
    """Whether a parameter is a time at which an effect begins or ends."""
    return spec.unit == "s" and not np.isfinite(spec.high)


def amplitudes(effect: Effect) -> list[EffectParameter]:
    """Parameters with a derivative: all but times of the run."""
    return [spec for spec in effect.parameters if not is_time_of_run(spec)]


def whose_parameters(effect: Effect, n_recordings: int) -> list[int | None]:
    """Recordings that have parameters of their own for an effect; [None] if all share them."""
    if not effect.of_the_day or n_recordings == 1:
        return [None]
    return list(range(1 if effect.relative_to_first else 0, n_recordings))


@dataclass(frozen=True)
class Parameter:
    """One number that is fitted. recording: whose, None for all (of the vehicle)."""

    effect: Effect
    spec: EffectParameter
    recording: int | None


@dataclass(frozen=True)
class Hypothesis:
    """A calibration and effects with their values, per recording. phi: (3,) rad, scale: (3,), DVL frame."""

    phi: Array
    scale: Array
    effects: tuple[Effect, ...] = ()
    values: Mapping[str, tuple[Values, ...]] = field(default_factory=dict)

    def injections(self, recording: int) -> list[Injection]:
        """The effects as one recording has them."""
        return [Injection(effect, self.values[effect.name][recording]) for effect in self.effects]

    def lags(self, recording: int) -> list[tuple[EffectWithMemory, Values]]:
        """The effects of one recording with a memory, and their values."""
        with_memory = [effect for effect in self.effects if isinstance(effect, EffectWithMemory)]
        return [(effect, self.values[effect.name][recording]) for effect in with_memory]

    @property
    def without_memory(self) -> Hypothesis:
        """The same without effects that have one."""
        return replace(self, effects=tuple(each for each in self.effects if not isinstance(each, EffectWithMemory)))

    def parameters(self) -> list[Parameter]:
        """What is fitted beside the calibration, in order."""
        return [each for effect in self.effects for each in self.parameters_of(effect)]

    def parameters_of(self, effect: Effect) -> list[Parameter]:
        """Those of one effect: of the vehicle once, of the day for every recording."""
        each = self.values[effect.name]
        whose = whose_parameters(effect, len(each))
        return [Parameter(effect, spec, recording) for recording in whose for spec in amplitudes(effect)]

    def value(self, parameter: Parameter) -> float:
        """The value of one."""
        return self.values[parameter.effect.name][parameter.recording or 0][parameter.spec.name]

    def vector(self) -> Array:
        """(6 + p,) φ, δk and all values."""
        return np.concatenate([self.phi, self.scale, [self.value(each) for each in self.parameters()]])

    def moved(self, step: Array) -> Hypothesis:
        """A step (6 + p,) on, within the bounds of each parameter."""
        values = {name: [dict(each) for each in per] for name, per in self.values.items()}
        for parameter, change in zip(self.parameters(), step[6:].tolist(), strict=True):
            spec = parameter.spec
            per = values[parameter.effect.name]
            for recording in range(len(per)) if parameter.recording is None else [parameter.recording]:
                per[recording][spec.name] = float(np.clip(per[recording][spec.name] + change, spec.low, spec.high))
        return replace(
            self,
            phi=self.phi + step[:3],
            scale=self.scale + step[3:6],
            values={name: tuple(per) for name, per in values.items()},
        )

    def with_effects(self, effects: Sequence[Effect], n: int, start: Mapping[str, tuple[Values, ...]]) -> Hypothesis:
        """Of other effects, with values of `start`, else their own, else the defaults; of n recordings.

        What a value has no word of, as a leap that came once has none of a second, is at its default.
        """
        given = {effect.name: start.get(effect.name) or self.values.get(effect.name) or ({},) * n for effect in effects}
        values = {effect.name: tuple({**effect.defaults, **each} for each in given[effect.name]) for effect in effects}
        return replace(self, effects=tuple(effects), values=values)

    def body_from_measured(self, rotation_dvl_from_body: Array, turn: Array | None = None) -> Array:
        """D⁻¹ (3, 3), or (N, 3, 3) if what the mounting is turned on top of φ is (N, 3)."""
        angles = self.phi if turn is None else self.phi + turn
        turned = Rotation.from_rotvec(angles).as_matrix() @ rotation_dvl_from_body
        return np.swapaxes(turned, -1, -2) / (1.0 + self.scale)


def no_effect(phi: Array | None = None, scale: Array | None = None) -> Hypothesis:
    """A calibration alone, by default none."""
    return Hypothesis(np.zeros(3) if phi is None else phi, np.zeros(3) if scale is None else scale)


@dataclass(frozen=True)
class Seen:
    """A recording through a hypothesis, at F times. motion: of the reference point. at_dvl: of the DVL. measured:
    (F, 3) m/s smoothed DVL velocity, its frame. error: (F, 3) e, body frame.
    angles: φ and all turns of the mounting, rad, (3,) or (F, 3). body_from_measured: D⁻¹ with these, (3, 3) or more.
    dvl_stamps, reference_stamps: (F,) s that these give the same times. projection: (F, A, 3) or (1, A, 3) from the
    body frame to the axes that are compared. change, closely, as_it_is: make `rate_of_change`, `close` and
    `close_as_it_is`.
    """

    motion: EffectInput
    at_dvl: EffectInput
    measured: Array
    error: Array
    angles: Array
    body_from_measured: Array
    dvl_stamps: Array
    reference_stamps: Array
    projection: Array
    change: Callable[[], Array] = field(repr=False)
    closely: Callable[[], tuple[Seen, NDArray[np.intp]] | None] = field(repr=False)
    as_it_is: Callable[[], tuple[EffectInput, NDArray[np.intp]] | None] = field(repr=False)

    @cached_property
    def rate_of_change(self) -> Array:
        """(F, 3) m/s² of the smoothed DVL velocity, which few ask for."""
        return self.change()

    @cached_property
    def close(self) -> tuple[Seen, NDArray[np.intp] | slice]:
        """The same without effects that have a memory, at times so close that these miss nothing, and which are its."""
        return self.closely() or (self, slice(None))

    @cached_property
    def close_as_it_is(self) -> tuple[EffectInput, NDArray[np.intp] | slice]:
        """The motion of `close` not smoothed: smoothed, it would lack what a filter takes off."""
        return self.as_it_is() or (self.motion, slice(None))

    def on_reference(self, injections: Sequence[Injection]) -> Array:
        """(F, 3) m/s, traces on REFERENCE, body frame."""
        lagging = [each for each in injections if isinstance(each.effect, EffectWithMemory)]
        if not lagging or self.close_as_it_is[0] is self.motion:
            return traces(injections, self.motion, ActsOn.REFERENCE)
        close, own = self.close_as_it_is
        found = traces([each for each in injections if each not in lagging], self.motion, ActsOn.REFERENCE)
        return np.asarray(found + traces(lagging, close, ActsOn.REFERENCE)[own])

    def compared(self, body: Array) -> Array:
        """(F, 3) or (F, 3, p) of the body frame along the axes that are compared, (F, A) or (F, A, p)."""
        return self.projection @ body if body.ndim > 2 else _turned(self.projection, body)


class _Moved(NamedTuple):
    """What a DVL says of the motion at F times. motion, at_dvl, angles, body_from_measured, dvl_stamps: as of `Seen`.
    raw, smooth: (F, 3) m/s, what it measured, its frame. added: (F, 3) or (3,) m/s that a lever arm that is known, and
    effects before the reference, add to the motion, body frame. attitude_stamps: (F,) s.
    """

    motion: EffectInput
    at_dvl: EffectInput
    raw: Array
    smooth: Array
    added: Array
    angles: Array
    body_from_measured: Array
    dvl_stamps: Array
    attitude_stamps: Array


class SeenAgain(Sequence[Seen]):
    """What is seen of a hypothesis for who asks for it: of hours it is large, and of most fits nobody asks."""

    def __init__(self, problem: Problem, hypothesis: Hypothesis) -> None:
        self._problem, self._hypothesis = problem, hypothesis

    @cached_property
    def _each(self) -> list[Seen]:
        return self._problem.all_seen(self._hypothesis)

    def __len__(self) -> int:
        return len(self._problem.recordings)

    @overload
    def __getitem__(self, at: int) -> Seen: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[Seen]: ...
    def __getitem__(self, at: int | slice) -> Seen | Sequence[Seen]:
        return self._each[at]


@dataclass(frozen=True)
class Grid:
    """Where a recording is looked at: at its rougher stream's own samples, which so need no interpolation.

    What is interpolated is as noisy at one phase as at another only if it has next to no noise, and is as it was
    between its samples only if these are close. clock: that of the rougher stream, DVL_CLOCK or REFERENCE_CLOCK.
    stamps: (M * per_bin,) s, by that clock. late: s, by a first guess.
    """

    clock: ActsOn
    stamps: Array
    per_bin: int
    late: float = 0.0

    @property
    def bin_time(self) -> Array:
        """(M,) s, middles, as true as the first guess."""
        return self.stamps.reshape(-1, self.per_bin).mean(axis=1) - self.late

    def averaged(self, values: Array) -> Array:
        """(F, ...) -> (M, ...)."""
        total = values[:: self.per_bin].astype(float)
        for of_bin in range(1, self.per_bin):  # few: faster than a mean along so short an axis
            total += values[of_bin :: self.per_bin]
        return total / self.per_bin

    def between(self, time: Array) -> tuple[Array, NDArray[np.intp]] | None:
        """Times (C,) s among which are those of the samples (F,), with those between, but over gaps; and which are.

        None where these are close enough by themselves, or too many.
        """
        if len(time) < 2:
            return None
        steps = np.diff(time)
        usual = float(np.median(steps))
        parts = min(int(np.ceil(usual / CLOSE_S)), SETTINGS.max_points // len(time))
        if usual <= FAST_ENOUGH_S or parts < 2:
            return None
        of_each = np.where(steps < SETTINGS.max_gap_intervals * usual, parts, 1)
        own = np.concatenate([[0], np.cumsum(of_each)])
        return np.interp(np.arange(own[-1] + 1), own, time), own

    def true_time(self, injections: Sequence[Injection]) -> Array:
        """(F,) s, increasing, at which what is stamped so was measured.

        A leap that is tried where there is none would have samples measured before those that came first; these then
        follow one another at half the usual time between stamps, until they are as late as the leap has them. A leap
        that is there leaves its gap in the stamps, not in time.
        """
        time = self.stamps
        for _ in range(_PASSES):
            time = self.stamps - late(injections, self.clock, time)
        least = self._least
        return time if (np.diff(time - least) > 0.0).all() else np.maximum.accumulate(time - least) + least

    @cached_property
    def _least(self) -> Array:
        """(F,) s, least time since the first sample: asked for by every hypothesis, and the same for all."""
        steps = np.diff(self.stamps, prepend=self.stamps[:1])
        return np.asarray(0.5 * np.cumsum(np.minimum(steps, np.median(steps))))


@dataclass(frozen=True)
class Problem:
    """Recordings to be explained. lever_arm: (3,) m, known already. grids: per recording. of_axes: those to compare.
    bursts: of how many samples an instrument was far off, which are left out. shown_turns: (3, 3) projection of φ on
    the turns of the mounting that a reference without a vertical shows; by the others it is not turned. unshown: what
    it does not show of effects; where one of these is in a hypothesis, or on every vehicle, there may be some of that.
    """

    recordings: tuple[RecordedStreams, ...]
    rotation_dvl_from_body: Array
    lever_arm: Array
    grids: tuple[Grid, ...]
    of_axes: tuple[bool, bool, bool] = (True, True, True)
    bursts: int = 0
    shown_turns: Array = field(default_factory=lambda: np.eye(3), repr=False, compare=False)
    unshown: tuple[Effect, ...] = ()
    # Hypotheses as they were fitted last, by what they are made of: where to start from again
    fitted: dict[Any, list[Hypothesis]] = field(default_factory=dict, repr=False, compare=False)

    # ------------------------------------------------------------------ the data

    @cached_property
    def available(self) -> frozenset[EffectNeeds]:
        """What effects may need and every recording has."""
        return frozenset.intersection(*(recording.available for recording in self.recordings))

    @cached_property
    def measured(self) -> tuple[bool, bool, bool]:
        """Axes that are compared, of those that the reference measures in all recordings."""
        x, y, z = (
            self.of_axes[axis] and all(recording.measured[axis] for recording in self.recordings) for axis in range(3)
        )
        return x, y, z

    @property
    def axes(self) -> int:
        """Number of axes that are compared."""
        return sum(self.measured)

    @cached_property
    def time(self) -> Array:
        """(M,) s of all bins, since the beginning of the bin's recording."""
        return np.concatenate([grid.bin_time for grid in self.grids])

    def without(self, far: NDArray[np.bool_]) -> Problem:
        """The problem without some bins (M,), as if nothing had been measured then."""
        of_sample, ends = far[self.bin_of], np.cumsum([len(grid.stamps) for grid in self.grids])[:-1]
        grids = tuple(
            replace(grid, stamps=grid.stamps[~off])
            for grid, off in zip(self.grids, np.split(of_sample, ends), strict=True)
        )
        return replace(self, grids=grids, bursts=int(of_sample.sum()), fitted={})

    @cached_property
    def recording_of(self) -> NDArray[np.intp]:
        """(M,) index of the recording that a bin belongs to."""
        return np.repeat(np.arange(len(self.grids)), [len(grid.bin_time) for grid in self.grids])

    @cached_property
    def rows_of(self) -> tuple[slice, ...]:
        """Which of the M bins belong to each recording."""
        ends = np.cumsum([0, *(len(grid.bin_time) for grid in self.grids)]).tolist()
        return tuple(slice(*each) for each in pairwise(ends))

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Stretches of the M bins without a gap."""
        return segments_of([grid.bin_time for grid in self.grids])

    @cached_property
    def interval(self) -> float:
        """Median time, s, between neighbours of the M bins."""
        return float(np.median(np.concatenate([np.diff(grid.bin_time) for grid in self.grids])))

    @cached_property
    def earth_from_compared(self) -> Array | None:
        """(M, A, A) from the frame of the residual to the earth's, None without attitude."""
        if EffectNeeds.ATTITUDE not in self.available:
            return None
        parts = []
        for recording, grid in zip(self.recordings, self.grids, strict=True):
            rotation = recording.rotation_enu_from_body(grid.bin_time)
            parts.append(rotation @ np.swapaxes(self.projection(recording, rotation), 1, 2))
        return np.concatenate(parts)[:, [axis for axis in range(3) if self.measured[axis]]]

    def projection(self, recording: RecordedStreams, rotation_enu_from_body: Array | None) -> Array:
        """(F, A, 3) from the body frame to the axes that are compared: those of the body, or of it held level."""
        if all(self.measured):
            return np.eye(3)[None]
        rows = [axis for axis in range(3) if self.measured[axis]]
        if recording.frame is VelocityFrame.BODY or rotation_enu_from_body is None:
            return np.eye(3)[None, rows]
        if self.measured != (True, True, False):
            return rotation_enu_from_body[:, rows]
        ahead = rotation_enu_from_body[:, :2, 0]
        c, s = (ahead / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]).T
        level = np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=1)
        projected: Array = level @ rotation_enu_from_body[:, :2]
        return projected

    def to_compared(self, recording: RecordedStreams, at: Array, of_dvl: bool) -> Array:
        """(M, A, 3) or (1, A, 3) from the frame of the DVL or of the reference to the axes that are compared."""
        oriented = EffectNeeds.ATTITUDE in self.available
        rotation = recording.rotation_enu_from_body(at) if oriented else None
        projection = self.projection(recording, rotation)
        if of_dvl:
            return np.asarray(projection @ self.rotation_dvl_from_body.T)
        if recording.frame is VelocityFrame.BODY or rotation is None:
            return projection
        return np.asarray(projection @ np.swapaxes(rotation, 1, 2))

    @cached_property
    def shaken(self) -> tuple[Problem, ...]:
        """The problem with made-up noise, like its own, in one velocity and then in the other.

        Not in that of the reference where it is looked at its own samples: there its noise is the same for all.
        """
        rng = np.random.default_rng(0)
        dvl = [replace(one, dvl=one.dvl.shaken(rng)) for one in self.recordings]
        reference = [replace(one, reference=one.reference.shaken(rng)) for one in self.recordings]
        by_dvl = any(grid.clock is ActsOn.DVL_CLOCK for grid in self.grids)
        each = [dvl, reference] if by_dvl else [dvl]
        return tuple(replace(self, recordings=tuple(recordings)) for recordings in each)

    @cached_property
    def tails(self) -> tuple[float, ...]:
        """By what factor the noise that is made up for each of `shaken` has a smaller variance than its own."""
        dvl = max(one.dvl.tails for one in self.recordings)
        return (dvl, max(one.reference.tails for one in self.recordings))[: len(self.shaken)]

    @property
    def rougher_than_claimed(self) -> float:
        """By what factor the DVL may be noisier than what is made up for it: no more than it is rough."""
        each = [(one.dvl.roughness, one.dvl.noise) for one in self.recordings]
        return max(float((rough / np.maximum(noise, 1e-12)).max()) for rough, noise in each)

    # ------------------------------------------------------------------ the model

    def seen(self, hypothesis: Hypothesis, recording: int, at: Array | None = None) -> Seen:
        """A recording through a hypothesis; at: true times (F,) s, by default those of the grid."""
        stream, injections = self.recordings[recording], hypothesis.injections(recording)
        time = self.grids[recording].true_time(injections) if at is None else at
        reference = time + late(injections, ActsOn.REFERENCE_CLOCK, time)
        by_dvl = self.grids[recording].clock is ActsOn.DVL_CLOCK
        curve = stream.reference.quiet if by_dvl else stream.reference
        g = curve.kept.at("values", reference, lambda: curve(reference))
        moved = self._moved(hypothesis, recording, time)
        rotation = moved.motion.rotation_enu_from_body
        if stream.frame is not VelocityFrame.BODY and rotation is not None:
            g = np.einsum("nji,nj->ni", rotation, g)
        error = _turned(moved.body_from_measured, moved.raw) - moved.added - g
        found = Seen(
            motion=moved.motion,
            at_dvl=moved.at_dvl,
            measured=moved.smooth,
            error=error,
            angles=moved.angles,
            body_from_measured=moved.body_from_measured,
            dvl_stamps=moved.dvl_stamps,
            reference_stamps=reference,
            projection=self._kept_projection(stream, rotation, moved.attitude_stamps),
            change=partial(_change, stream.dvl.smooth, moved.dvl_stamps),
            closely=partial(self._close, hypothesis, recording, time),
            as_it_is=partial(self._close_as_it_is, hypothesis, recording, time),
        )
        if any(each.effect.acts_on is ActsOn.REFERENCE for each in injections):
            error -= found.on_reference(injections)  # in place: what it is seen as close by is kept
        for lag, values in hypothesis.lags(recording):
            error -= lag.of_before(found.motion, error, values)
        return found

    def _moved(self, hypothesis: Hypothesis, recording: int, time: Array, as_it_is: bool = False) -> _Moved:
        """What a DVL says of the motion at true times (F,) s; as_it_is: not smoothed, of a slow one."""
        stream, injections = self.recordings[recording], hypothesis.injections(recording)
        dvl, attitude = (time + late(injections, clock, time) for clock in (ActsOn.DVL_CLOCK, ActsOn.ATTITUDE_CLOCK))
        rotation, rates = self._oriented(stream, attitude)
        raw, smooth = _measured(stream.dvl, dvl, self.grids[recording].clock is ActsOn.DVL_CLOCK)
        followed = raw if as_it_is and stream.dvl.interval > FAST_ENOUGH_S else smooth
        lever = np.zeros(3) if rates is None or not self.lever_arm.any() else cross(rates, self.lever_arm)
        nominal = self.rotation_dvl_from_body
        turn: Array = np.zeros(3)
        matrix = hypothesis.body_from_measured(nominal)
        measured = EffectInput(time, _turned(matrix, followed), nominal, rotation, rates, stream.frame, 0.0)
        if any(each.effect.acts_on is ActsOn.MOUNTING for each in injections):
            # turned a little otherwise, it is as fast
            turn = turns(injections, _undone(injections, measured, ActsOn.DVL, matrix @ nominal)[0])
            matrix = hypothesis.body_from_measured(nominal, turn)
            measured = replace(measured, velocity_body=_turned(matrix, followed))
        at_dvl, of_dvl = _undone(injections, measured, ActsOn.DVL, matrix @ nominal)
        motion = replace(at_dvl, velocity_body=at_dvl.velocity_body - lever)
        motion, of_motion = _undone(injections, motion, ActsOn.MOTION, None)
        added = of_dvl + of_motion + lever
        return _Moved(motion, at_dvl, raw, smooth, added, hypothesis.phi + turn, matrix, dvl, attitude)

    def _close(self, hypothesis: Hypothesis, recording: int, time: Array) -> tuple[Seen, NDArray[np.intp]] | None:
        """For `Seen.close`; None where the times are close."""
        between = self.grids[recording].between(time)
        return between and (self.seen(hypothesis.without_memory, recording, between[0]), between[1])

    def _close_as_it_is(
        self, hypothesis: Hypothesis, recording: int, time: Array
    ) -> tuple[EffectInput, NDArray[np.intp]] | None:
        """For `Seen.close_as_it_is`; None where the times are close."""
        between = self.grids[recording].between(time)
        return between and (self._moved(hypothesis.without_memory, recording, between[0], True).motion, between[1])

    def _kept_projection(self, stream: RecordedStreams, rotation: Array | None, at: Array) -> Array:
        """`projection` at times (F,) s of the attitude, of which the last few are kept."""
        if stream.attitude is None or all(self.measured):
            return self.projection(stream, rotation)
        what = f"projection {self.measured}"
        return np.asarray(stream.attitude.kept.at(what, at, lambda: self.projection(stream, rotation)))

    def _oriented(self, stream: RecordedStreams, at: Array) -> tuple[Array | None, Array | None]:
        rotation = stream.rotation_enu_from_body(at) if EffectNeeds.ATTITUDE in self.available else None
        return rotation, stream.angular_velocity(at) if EffectNeeds.ANGULAR_VELOCITY in self.available else None

    def all_seen(self, hypothesis: Hypothesis) -> list[Seen]:
        """Every recording through a hypothesis."""
        return [self.seen(hypothesis, recording) for recording in range(len(self.recordings))]

    def residual(self, seen: Sequence[Seen]) -> Array:
        """e (M, A) m/s in the frame that is compared."""
        return self.binned([each.error for each in seen], seen)

    def binned(self, bodies: Sequence[Array], seen: Sequence[Seen]) -> Array:
        """(F, 3, ...) of each recording, body frame, -> (M, A, ...) means, in the frame that is compared."""
        return np.concatenate(list(map(self._in_bins, self.grids, bodies, seen)))

    def _in_bins(self, grid: Grid, body: Array, seen: Seen) -> Array:
        """(F, 3, ...) of one recording -> its bins, (m, A, ...)."""
        return grid.averaged(body if all(self.measured) else seen.compared(body))

    @cached_property
    def bin_of(self) -> NDArray[np.intp]:
        """(F,) bin of every sample of all recordings."""
        per_bin = np.concatenate([np.full(len(grid.bin_time), grid.per_bin) for grid in self.grids])
        return np.repeat(np.arange(len(per_bin)), per_bin)

    @cached_property
    def sample_time(self) -> Array:
        """(F,) s of every sample, since the beginning of its recording, as true as the first guess."""
        return np.concatenate([grid.stamps - grid.late for grid in self.grids])

    def errors(self, seen: Sequence[Seen]) -> Array:
        """(F, 3) m/s, e of every sample, not averaged, ahead, to port and up; zero on an axis that is not measured."""
        parts = []
        for each in seen:
            error = each.error
            if not all(self.measured):
                error = np.zeros_like(error)
                error[:, list(self.measured)] = each.compared(each.error)
            parts.append(error)
        return np.concatenate(parts)

    def sampled(self, seen: Sequence[Seen], of: Callable[[EffectInput], Array]) -> Array:
        """A function of the motion (F, ...) at the M bins."""
        return np.concatenate([grid.averaged(of(each.motion)) for grid, each in zip(self.grids, seen, strict=True)])

    # ------------------------------------------------------------------ its derivatives

    def calibration_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> Array:
        """(M, A, 6) d e / d (φ, δk)."""
        parts = []
        for recording, (grid, each) in enumerate(zip(self.grids, seen, strict=True)):
            # of one mounting they are linear in the velocity, and so in its mean over each bin
            lags = hypothesis.lags(recording)
            if each.body_from_measured.ndim == 2 and all(self.measured) and not lags:
                parts.append(self._by_calibration(hypothesis, each, grid.averaged(each.measured)))
                continue
            close, own = each.close if lags else (each, slice(None))
            body = self._by_calibration(hypothesis, close, close.measured)
            parts.append(self._in_bins(grid, _lagging(lags, each, close, own, body), each))
        return np.concatenate(parts)

    def _by_calibration(self, hypothesis: Hypothesis, seen: Seen, measured: Array) -> Array:
        """(F, 3, 6) d e / d (φ, δk), body frame, of velocities (F, 3) m/s in the DVL's."""
        columns = np.empty((len(measured), 3, 6))
        by_turn = _by_turn(hypothesis, seen, measured)
        columns[:, :, :3] = by_turn if all(self.measured) else by_turn @ self.shown_turns
        unscaled = measured / (1.0 + hypothesis.scale)
        np.multiply(-unscaled[:, None, :], seen.body_from_measured, out=columns[:, :, 3:])
        return columns

    def all_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> Array:
        """(M, A, 6 + p) d e / d (φ, δk) and all parameters of a hypothesis, in its order."""
        effects = hypothesis.effects
        if not hypothesis.lags(0):
            of_each = [self.columns(hypothesis, seen, each, hypothesis.values[each.name]) for each in effects]
            return np.concatenate([self.calibration_columns(hypothesis, seen), *of_each], axis=2)
        # what a lag filters, of all effects at once: to filter many columns takes little longer than to filter one
        lagging = [effect for effect in effects if effect.acts_on is not ActsOn.REFERENCE]
        bodies = []
        for recording, each in enumerate(seen):
            close, own = each.close
            of_each = [
                self._derivatives(hypothesis, close, effect, hypothesis.values[effect.name][recording])
                for effect in lagging
            ]
            body = np.concatenate([self._by_calibration(hypothesis, close, close.measured), *of_each], axis=2)
            bodies.append(_lagging(hypothesis.lags(recording), each, close, own, body))
        joined = self.binned(bodies, seen)
        parts, at = {}, 6
        for effect in lagging:
            p = len(amplitudes(effect))
            parts[effect.name] = self._of_the_day(effect, joined[:, :, at : at + p])
            at += p
        for effect in effects:
            if effect not in lagging:
                parts[effect.name] = self.columns(hypothesis, seen, effect, hypothesis.values[effect.name])
        return np.concatenate([joined[:, :, :6], *(parts[effect.name] for effect in effects)], axis=2)

    def columns(self, hypothesis: Hypothesis, seen: Sequence[Seen], effect: Effect, values: Sequence[Values]) -> Array:
        """(M, A, p) d e / d parameters of an effect about values, per recording; of the day: by recording."""
        per_recording = []
        for recording, each in enumerate(seen):
            lags = hypothesis.lags(recording)
            of_motion = lags if effect.acts_on is not ActsOn.REFERENCE else []
            close, own = each.close if of_motion else (each, slice(None))
            if isinstance(effect, EffectWithMemory):
                as_it_is, own = each.close_as_it_is
                body = _of_trace(effect, as_it_is, values[recording])[own]
                per_recording.append(_begun(lags, each, body))
            else:
                body = self._derivatives(hypothesis, close, effect, values[recording])
                lagging = _lagging(lags, each, close, own, body) if of_motion else _begun(lags, each, body)
                per_recording.append(lagging)
        return self._of_the_day(effect, self.binned(per_recording, seen))

    def _of_the_day(self, effect: Effect, columns: Array) -> Array:
        """(M, A, p) of an effect -> (M, A, p), or (M, A, r p) where it is another in each recording: each one's own and
        zero in the others."""
        whose, p = whose_parameters(effect, len(self.grids)), columns.shape[2]
        if whose == [None]:
            return columns
        found = np.zeros((*columns.shape[:2], len(whose) * p))
        for number, recording in enumerate(whose):
            own = self.recording_of == recording
            found[own, :, number * p : (number + 1) * p] = columns[own]
        return found

    def lacks_columns(self, hypothesis: Hypothesis) -> bool:
        """Whether there is anything that `unshown_columns` gives of a hypothesis."""
        named = {*hypothesis.values, *OF_EVERY}
        return any(effect.name in named for effect in self.unshown) or not np.allclose(self.shown_turns, np.eye(3))

    def unshown_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> tuple[Array, Array]:
        """(M, A, u) d e / d what is not shown and not fitted: turns of the mounting, parts of effects; and their usual
        sizes (u,).

        Each is next to nothing, but so is an effect of which there is little: what these explain is not its.
        """
        parts, sizes = [], []
        held, turns = np.linalg.eigh(np.eye(3) - self.shown_turns)
        if (held > 0.5).any():
            turned = replace(self, shown_turns=np.eye(3)).calibration_columns(hypothesis, seen)[:, :, :3]
            parts.append(turned @ turns[:, held > 0.5])
            sizes.append(np.full(parts[-1].shape[2], SETTINGS.prior_angle))
        for effect in self.unshown:
            named = hypothesis.values.get(effect.name)
            if named is None and effect.name not in OF_EVERY:
                continue
            if isinstance(effect, MountingEffect):
                parts += self._of_unshown_turns(hypothesis, seen, effect)
                sizes += [np.full(parts[-2].shape[2], SETTINGS.prior_angle)]
                sizes += [np.full(parts[-1].shape[2], 0.5 * SETTINGS.prior_angle**2)]
                continue
            values = [{**effect.defaults, **own} for own in named or ({},) * len(seen)]
            parts.append(self.columns(hypothesis, seen, effect, values))
            own = [spec.typical for spec in amplitudes(effect)]
            sizes.append(np.tile(own, parts[-1].shape[2] // len(own)))
        if not parts:
            return np.zeros((len(self.time), self.axes, 0)), np.zeros(0)
        return np.concatenate(parts, axis=2), np.concatenate(sizes)

    def _of_unshown_turns(self, hypothesis: Hypothesis, seen: Sequence[Seen], effect: Effect) -> list[Array]:
        """(M, A, t) d e / d turns of the mounting that are not shown, and (M, A, r) d e / d half their square, by
        recording: by its cosine a turn of 4° makes all velocities of a day slower by a quarter of a per cent."""
        turned = self.columns(hypothesis, seen, effect, (effect.defaults,) * len(seen))
        slower = self.binned([-each.motion.velocity_body for each in seen], seen)[:, :, None]
        return [turned, self._of_the_day(effect, slower)]

    def trace(self, hypothesis: Hypothesis, seen: Sequence[Seen], effect: Effect, values: Sequence[Values]) -> Array:
        """(M, A) m/s that an effect adds to the residual of a hypothesis that has not got it."""
        without = [other for other in hypothesis.effects if other is not effect]
        n = len(self.recordings)
        plain = hypothesis.with_effects(without, n, {})
        with_it = plain.with_effects([*without, effect], n, {effect.name: tuple(values)})
        return self.residual(self.all_seen(plain)) - self.residual(self.all_seen(with_it))

    def _derivatives(self, hypothesis: Hypothesis, seen: Seen, effect: Effect, values: Values) -> Array:
        """(F, 3, p), body frame."""
        specs = amplitudes(effect)
        if isinstance(effect, ClockEffect):
            by_late = self._by_late(seen, effect.acts_on)
            slopes = [_difference(spec, values, lambda at: effect.late(seen.motion.time, at)) for spec in specs]
            return np.stack([by_late * slope[:, None] for slope in slopes], axis=2)
        if isinstance(effect, MountingEffect):
            slopes = [_difference(spec, values, lambda at: effect.turn(seen.at_dvl, at)) for spec in specs]
            by_turn = _by_turn(hypothesis, seen, seen.measured)
            stacked = np.stack([np.broadcast_to(slope, seen.error.shape) for slope in slopes], axis=2)
            return np.asarray(by_turn @ stacked)
        if effect.acts_on is not ActsOn.DVL:
            return _of_trace(effect, seen.motion, values)
        of_dvl = _of_trace(effect, seen.at_dvl, values)
        return np.asarray(seen.body_from_measured @ self.rotation_dvl_from_body @ of_dvl)

    def _by_late(self, seen: Seen, clock: ActsOn) -> Array:
        """(F, 3) d e / d lateness of a clock, m/s per s, body frame."""
        if clock is ActsOn.DVL_CLOCK:
            return _turned(seen.body_from_measured, seen.rate_of_change)
        motion = seen.motion
        turning = np.zeros_like(motion.velocity_body)
        if motion.angular_velocity is not None and motion.reference_frame is not VelocityFrame.BODY:
            turning = cross(motion.angular_velocity, motion.velocity_body)
        if clock is ActsOn.ATTITUDE_CLOCK:
            return turning
        return -slopes(motion.time, motion.velocity_body) - turning


def _measured(curve: Curve, at: Array, at_samples: bool) -> tuple[Array, Array]:
    """(F, 3) velocity and smoothed velocity."""

    def made() -> tuple[Array, Array]:
        smooth = curve.smooth
        raw = curve if at_samples else curve.quiet
        smoothed = smooth(at)
        return smoothed if raw is smooth else raw(at), smoothed

    measured: tuple[Array, Array] = curve.kept.at(f"measured, {at_samples}", at, made)
    return measured


def _change(curve: Curve, at: Array) -> Array:
    """(F, 3) m/s² of a velocity."""
    clipped = np.clip(at, curve.time[0], curve.time[-1])
    return np.asarray(curve.kept.at("change", at, lambda: curve.derivative(clipped)))


def _undone(
    injections: Sequence[Injection], motion: EffectInput, acts_on: ActsOn, turned: Array | None
) -> tuple[EffectInput, Array]:
    """The motion before the effects of one stage have acted on it, and what they have added (F, 3), or (3,) nothing.

    Where an effect is not small against the motion, as of a spike of 7 m/s, a pass may lead further off than the one
    before; it is not taken there.
    """
    here = [each for each in injections if each.effect.acts_on is acts_on]
    if not here:
        return motion, np.zeros(3)
    after, added = motion.velocity_body, np.zeros_like(motion.velocity_body)
    moved_before = np.full(len(after), np.inf)
    for _ in range(_PASSES):
        before, added = added, traces(here, motion, acts_on)
        added = added if turned is None else _turned(turned, added)
        if not any(isinstance(each.effect, Effect) and each.effect.of_velocity for each in here):  # that is all
            return replace(motion, velocity_body=after - added), added
        if np.array_equal(added, before):
            break
        moved = np.linalg.norm(added - before, axis=1)
        added = np.where((moved <= moved_before)[:, None], added, before)
        moved_before = np.minimum(moved, moved_before)
        motion = replace(motion, velocity_body=after - added)
    return motion, added


def _lagging(
    lags: Sequence[tuple[EffectWithMemory, Values]],
    seen: Seen,
    close: Seen,
    own: NDArray[np.intp] | slice,
    columns: Array,
) -> Array:
    """Derivatives (C, 3, p) of the reference point's velocity, m/s, at close times, of which some are a recording's
    own -> (F, 3, p) of references that follow with a lag, as `_begun`."""
    if close is seen and len(lags) == 1:
        ((lag, values),) = lags
        return lag.follows(seen.motion, columns, values)
    for lag, values in lags:
        columns = columns - lag.filtered(close.motion, columns, values)
    return _begun(lags, seen, columns[own])


def _begun(lags: Sequence[tuple[EffectWithMemory, Values]], seen: Seen, columns: Array) -> Array:
    """Derivatives (F, 3, p) m/s without what a lag explains of them by what it remembers of before."""
    for lag, values in lags:
        columns = columns - lag.of_before(seen.motion, columns, values)
    return columns


def _turned(matrix: Array, values: Array) -> Array:
    """(N, 3) values, multiplied by one matrix (3, 3), (1, 3, 3) or by one each (N, 3, 3)."""
    if matrix.ndim == 2 or len(matrix) == 1:
        return values @ (matrix if matrix.ndim == 2 else matrix[0]).T
    return np.asarray(np.einsum("nij,nj->ni", matrix, values))


def _by_turn(hypothesis: Hypothesis, seen: Seen, measured: Array) -> Array:
    """(F, 3, 3) d e / d (φ + turns), body frame, of velocities (F, 3) m/s in the DVL's.

    D⁻¹ y with y the unscaled velocity is Exp(θ)ᵀ y, and Exp(θ + δ) = Exp(J δ) Exp(θ) with J the left Jacobian.
    """
    matrix = seen.body_from_measured * (1.0 + hypothesis.scale)
    unscaled, jacobian = measured / (1.0 + hypothesis.scale), _left_jacobian(seen.angles)
    if matrix.ndim == 2:  # linear in the velocity: one product of matrices in place of many small ones
        of_axes = (matrix @ skew(np.eye(3)) @ jacobian).reshape(3, 9)
        return np.asarray((unscaled @ of_axes).reshape(-1, 3, 3))
    return np.asarray(matrix @ skew(unscaled) @ jacobian)


def _left_jacobian(angles: Array) -> Array:
    """(..., 3, 3) of rotation vectors (..., 3) rad: I + (1 - cos θ) / θ² [θ×] + (θ - sin θ) / θ³ [θ×]²."""
    square = np.maximum((angles**2).sum(axis=-1), 1e-12)[..., None, None]
    size = np.sqrt(square)
    cross = skew(angles)
    once, twice = (1.0 - np.cos(size)) / square, (size - np.sin(size)) / (square * size)
    return np.asarray(np.eye(3) + once * cross + twice * (cross @ cross))


def _of_trace(effect: Effect, motion: EffectInput, values: Values) -> Array:
    """(F, 3, p) d e / d parameters of an effect of its trace on a motion, in the frame of that."""
    specs = amplitudes(effect)
    if all(spec.linear for spec in specs):
        none = {**values, **{spec.name: 0.0 for spec in specs}}
        slopes = [effect.trace(motion, {**none, spec.name: 1.0}) for spec in specs]
        own = {spec.name for spec in effect.parameters}
        if any(value for name, value in none.items() if name not in own):  # a height that is known and not fitted
            still = effect.trace(motion, none)
            slopes = [slope - still for slope in slopes]
    else:
        slopes = [_difference(spec, values, lambda at: effect.trace(motion, at)) for spec in specs]
    return -np.stack(slopes, axis=2)


def _difference(spec: EffectParameter, values: Values, of: Callable[[Values], Array]) -> Array:
    """d of / d parameter, by central differences, within its bounds."""
    step = 0.05 * spec.typical
    low, high = max(values[spec.name] - step, spec.low), min(values[spec.name] + step, spec.high)
    slope: Array = (of({**values, spec.name: high}) - of({**values, spec.name: low})) / (high - low)
    return slope


def make_problem(
    recordings: Sequence[RecordedStreams], rotation_dvl_from_body: Array, lever_arm: Array, offsets: Sequence[Offsets]
) -> Problem:
    """The problem on bins where all streams are known, with offsets (about which hypotheses lie) and without."""
    grids = tuple(_grid(recording, offset) for recording, offset in zip(recordings, offsets, strict=True))
    problem = Problem(tuple(recordings), rotation_dvl_from_body, np.asarray(lever_arm, dtype=float), grids)
    return problem if problem.measured[2] else replace(problem, shown_turns=_shown_turns(problem))


# A turn of the mounting that, as large as its prior, does less than this (m/s rms), is not fitted: it would take in
# what is left of the waves, by tens of degrees
TURN_SHOWN_MPS = 0.002


def _shown_turns(problem: Problem) -> Array:
    """(3, 3) projection of φ on the turns that are shown, whatever the scale."""
    columns = problem.calibration_columns(no_effect(), problem.all_seen(no_effect())).reshape(-1, 6)
    if not len(columns):
        return np.eye(3)
    by_turn, by_scale = columns[:, :3], columns[:, 3:]
    by_turn = by_turn - by_scale @ np.linalg.lstsq(by_scale, by_turn, rcond=None)[0]
    squares, turns = np.linalg.eigh(by_turn.T @ by_turn * (problem.axes / len(columns)))
    shown = turns[:, SETTINGS.prior_angle * np.sqrt(np.maximum(squares, 0.0)) > TURN_SHOWN_MPS]
    return np.asarray(shown @ shown.T)


@dataclass(frozen=True)
class Offsets:
    """Lateness, s, of the DVL's and the reference's stamps against the attitude's: a first guess."""

    dvl: float = 0.0
    reference: float = 0.0


# Offsets of hypotheses may lie so far from the first guess without leaving what is known, s
MARGIN_S = 0.5


def _grid(recording: RecordedStreams, offsets: Offsets) -> Grid:
    settings = SETTINGS
    by_dvl = float(np.linalg.norm(recording.dvl.roughness)) > float(np.linalg.norm(recording.reference.roughness))
    base, clock = (recording.dvl, ActsOn.DVL_CLOCK) if by_dvl else (recording.reference, ActsOn.REFERENCE_CLOCK)
    base_late = offsets.dvl if by_dvl else offsets.reference
    seconds = max(base.time[-1] - base.time[0], base.interval)
    width = max(settings.bins_per_interval * base.interval, settings.shortest_bin, seconds / settings.max_bins)
    per_bin = max(2, round(width / base.interval))
    streams = (recording.dvl, offsets.dvl), (recording.reference, offsets.reference)
    others = [(curve, own_late) for curve, own_late in streams if curve is not base]
    told = np.ones(len(base.time), dtype=bool)
    for curve, own_late in (*others, *((each, 0.0) for each in (recording.attitude, recording.rates) if each)):
        told &= curve.tells(base.time - base_late + own_late)
    stamps = base.time[told]
    true = stamps - base_late
    known = np.ones(len(true), dtype=bool)
    for curve, own_late in others:
        for at in (base_late - own_late, -MARGIN_S, MARGIN_S):
            known &= curve.covers(true + own_late + at)
    if not by_dvl:  # the DVL has nothing of the time that its clock went back over, whatever it is late by
        for event in recording.set_back:
            of_dvl, around = true + offsets.dvl, event.by + MARGIN_S
            known &= (of_dvl < event.before - around) | (of_dvl > event.after + around)
    for oriented in (recording.attitude, recording.rates):
        for at in (base_late, -MARGIN_S, MARGIN_S):
            known &= True if oriented is None else oriented.covers(true + at)
    breaks = np.flatnonzero(np.diff(stamps) > settings.max_gap_intervals * base.interval) + 1
    kept = []
    for part in np.split(np.arange(len(true)), np.unique(np.concatenate([breaks, np.flatnonzero(np.diff(known)) + 1]))):
        if len(part) and known[part[0]]:
            kept.append(part[: len(part) // per_bin * per_bin])
    return Grid(clock, stamps[np.concatenate(kept)] if kept else np.zeros(0), per_bin, base_late)
