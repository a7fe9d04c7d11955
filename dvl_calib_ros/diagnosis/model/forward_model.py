"""The composed model: residual of DVL and reference under any effects of any size.

It inverts the physics of `effects.base`. At a true time s, with the stamp of each clock,

    u = D⁻¹ (v_dvl - T traces on DVL(u))        v = u - traces on MOTION(v)        e = v - g - traces on REFERENCE(v)

with D = (I + diag(δk)) Exp(φ + turns on MOUNTING(u)) T and g the reference velocity in the body frame. Exp(φ) is the
finite rotation of which I + [φ×] is the first order. Streams are not paired: each is a curve of time, so a delay of
seconds is a change of argument. e is averaged over bins of two intervals of the rougher stream (`DiagnosisSettings`).

Regressors use the smoothed DVL velocity, whose noise is small. Regressors from the reference would bias estimates
towards zero (errors in variables).

Shapes: F samples, M bins of time, A compared axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...calibration.numerics.frames import Array, cross
from ...calibration.numerics.samples import VelocityFrame
from ...effects.base import (
    ActsOn,
    ClockEffect,
    Effect,
    EffectInput,
    EffectNeeds,
    EffectWithMemory,
    MountingEffect,
    late,
    slopes,
    turns,
)
from .hypothesis import OF_EVERY, Hypothesis, Values, amplitudes, no_effect, whose_parameters
from .recorded_streams import RecordedStreams
from .seen import (
    Seen,
    central_difference,
    columns_by_turn,
    lagged_columns,
    measured_velocity,
    rotate_vectors,
    trace_columns,
    undo_effects,
    velocity_change,
    without_remembered,
)
from .settings import SETTINGS
from .stream_curve import FAST_ENOUGH_S, TurningFrame, segments_of
from .time_grid import Grid, Offsets, make_grid


class _Moved(NamedTuple):
    """DVL measurement of the motion at F times. motion, at_dvl, angles, body_from_measured, dvl_stamps: as in `Seen`.
    raw, smooth: (F, 3) m/s, measured, DVL frame. added: (F, 3) or (3,) m/s that the known lever arm and effects before
    the reference add to the motion, body frame. attitude_stamps: (F,) s."""

    motion: EffectInput
    at_dvl: EffectInput
    raw: Array
    smooth: Array
    added: Array
    angles: Array
    body_from_measured: Array
    dvl_stamps: Array
    attitude_stamps: Array


@dataclass(frozen=True)
class Problem:
    """Recordings to explain. lever_arm: (3,) m, configured. grids: per recording. of_axes: axes to compare. bursts:
    number of samples excluded as instrument errors. observable_turns: (3, 3) projection of φ on the mounting rotations
    that are observable without a vertical reference; φ is zero along others. unobservable: unobservable parts of
    effects, nuisance parameters if the effect is in a hypothesis or on every vehicle."""

    recordings: tuple[RecordedStreams, ...]
    rotation_dvl_from_body: Array
    lever_arm: Array
    grids: tuple[Grid, ...]
    of_axes: tuple[bool, bool, bool] = (True, True, True)
    bursts: int = 0
    observable_turns: Array = field(default_factory=lambda: np.eye(3), repr=False, compare=False)
    unobservable: tuple[Effect, ...] = ()
    # Last fitted hypotheses by effects and times: starting points for further fits
    fitted: dict[Any, list[Hypothesis]] = field(default_factory=dict, repr=False, compare=False)

    # ------------------------------------------------------------------ the data

    @cached_property
    def available(self) -> frozenset[EffectNeeds]:
        """Return the inputs of effects that every recording has."""
        return frozenset.intersection(*(recording.available for recording in self.recordings))

    @cached_property
    def measured(self) -> tuple[bool, bool, bool]:
        """Return the axes to compare that the reference measures in all recordings."""
        x, y, z = (
            self.of_axes[axis] and all(recording.measured[axis] for recording in self.recordings) for axis in range(3)
        )
        return x, y, z

    @property
    def axes(self) -> int:
        """Return the number of axes that are compared."""
        return sum(self.measured)

    @cached_property
    def time(self) -> Array:
        """Return (M,) s of all bins since the beginning of their recording."""
        return np.concatenate([grid.bin_time for grid in self.grids])

    def without(self, excluded: NDArray[np.bool_]) -> Problem:
        """Return the problem without some bins (M,)."""
        of_sample, ends = excluded[self.bin_of], np.cumsum([len(grid.stamps) for grid in self.grids])[:-1]
        grids = tuple(
            replace(grid, stamps=grid.stamps[~out])
            for grid, out in zip(self.grids, np.split(of_sample, ends), strict=True)
        )
        return replace(self, grids=grids, bursts=int(of_sample.sum()), fitted={})

    @cached_property
    def recording_of(self) -> NDArray[np.intp]:
        """Return (M,) index of the recording of each bin."""
        return np.repeat(np.arange(len(self.grids)), [len(grid.bin_time) for grid in self.grids])

    @cached_property
    def rows_of(self) -> tuple[slice, ...]:
        """Return the range of bins of each recording."""
        ends = np.cumsum([0, *(len(grid.bin_time) for grid in self.grids)]).tolist()
        return tuple(slice(*each) for each in pairwise(ends))

    @cached_property
    def segments(self) -> tuple[slice, ...]:
        """Return the ranges of the M bins without a gap."""
        return segments_of([grid.bin_time for grid in self.grids])

    @cached_property
    def interval(self) -> float:
        """Return the median time, s, between neighbours of the M bins."""
        return float(np.median(np.concatenate([np.diff(grid.bin_time) for grid in self.grids])))

    @cached_property
    def earth_from_compared(self) -> Array | None:
        """Return rotations (M, A, A) from the residual's frame to the earth's, None without attitude."""
        if EffectNeeds.ATTITUDE not in self.available:
            return None
        parts = []
        for recording, grid in zip(self.recordings, self.grids, strict=True):
            rotation = recording.rotation_enu_from_body(grid.bin_time)
            parts.append(rotation @ np.swapaxes(self.projection(recording, rotation), 1, 2))
        return np.concatenate(parts)[:, [axis for axis in range(3) if self.measured[axis]]]

    def projection(self, recording: RecordedStreams, rotation_enu_from_body: Array | None) -> Array:
        """Return the matrices (F, A, 3) that select the compared axes from a body velocity.

        If the reference measures all three axes, these are the body's (identity, F = 1). Else they are the measured
        axes of the reference: of the body, of the earth, or horizontal ones ahead and to port for a measured east and
        north. rotation_enu_from_body: (F, 3, 3), None if unknown.
        """
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
        """Return (M, A, 3) or (1, A, 3) from the DVL's or the reference's frame to the compared axes."""
        oriented = EffectNeeds.ATTITUDE in self.available
        rotation = recording.rotation_enu_from_body(at) if oriented else None
        projection = self.projection(recording, rotation)
        if of_dvl:
            return np.asarray(projection @ self.rotation_dvl_from_body.T)
        if recording.frame is VelocityFrame.BODY or rotation is None:
            return projection
        return np.asarray(projection @ np.swapaxes(rotation, 1, 2))

    @cached_property
    def perturbed(self) -> tuple[Problem, ...]:
        """Return the problem with simulated noise in the DVL velocity and then in the reference velocity.

        The reference is omitted if the grid uses its own samples: its noise then is the same for all hypotheses.
        """
        rng = np.random.default_rng(0)
        of_dvl, of_reference = self.with_noise(rng, dvl=True), self.with_noise(rng, reference=True)
        by_dvl = any(grid.clock is ActsOn.DVL_CLOCK for grid in self.grids)
        return (of_dvl, of_reference) if by_dvl else (of_dvl,)

    def with_noise(self, rng: np.random.Generator, *, dvl: bool = False, reference: bool = False) -> Problem:
        """Return the problem with additional simulated noise in the named velocities."""
        recordings = (
            replace(
                one,
                dvl=one.dvl.perturbed(rng) if dvl else one.dvl,
                reference=one.reference.perturbed(rng) if reference else one.reference,
            )
            for one in self.recordings
        )
        return replace(self, recordings=tuple(recordings))

    # ------------------------------------------------------------------ the model

    def seen(self, hypothesis: Hypothesis, recording: int, at: Array | None = None) -> Seen:
        """Evaluate a hypothesis for a recording. at: true times (F,) s, by default of the grid."""
        stream, injections = self.recordings[recording], hypothesis.injections(recording)
        time = self.grids[recording].true_time(injections) if at is None else at
        reference = time + late(injections, ActsOn.REFERENCE_CLOCK, time)
        by_dvl = self.grids[recording].clock is ActsOn.DVL_CLOCK
        curve = stream.reference.denoised if by_dvl else stream.reference
        g = curve.kept.at("values", reference, lambda: curve(reference))
        moved = self._moved(hypothesis, recording, time)
        rotation = moved.motion.rotation_enu_from_body
        if stream.frame is not VelocityFrame.BODY and rotation is not None:
            g = np.einsum("nji,nj->ni", rotation, g)
        error = rotate_vectors(moved.body_from_measured, moved.raw) - moved.added - g
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
            change=partial(velocity_change, stream.dvl.smooth, moved.dvl_stamps),
            closely=partial(self._close, hypothesis, recording, time),
            unsmoothed=partial(self._close_unsmoothed, hypothesis, recording, time),
        )
        if any(each.effect.acts_on is ActsOn.REFERENCE for each in injections):
            error -= found.on_reference(injections)  # in place: `found` keeps its cached `close`
        for lag, values in hypothesis.lags(recording):
            error -= lag.of_before(found.motion, error, values)
        return found

    def _moved(self, hypothesis: Hypothesis, recording: int, time: Array, unsmoothed: bool = False) -> _Moved:
        """Return the motion by the DVL at true times (F,) s, under a hypothesis.

        The measured velocity is rotated to the body. The hypothesis's effects on the DVL are then removed, then the
        lever arm's velocity, then the effects on the motion. unsmoothed: without smoothing a slow DVL.
        """
        stream, injections = self.recordings[recording], hypothesis.injections(recording)
        dvl, attitude = (time + late(injections, clock, time) for clock in (ActsOn.DVL_CLOCK, ActsOn.ATTITUDE_CLOCK))
        rotation, rates = self._oriented(stream, attitude)
        raw, smooth = measured_velocity(stream.dvl, dvl, self.grids[recording].clock is ActsOn.DVL_CLOCK)
        velocity = raw if unsmoothed and stream.dvl.interval > FAST_ENOUGH_S else smooth
        lever = np.zeros(3) if rates is None or not self.lever_arm.any() else cross(rates, self.lever_arm)
        nominal = self.rotation_dvl_from_body
        turn: Array = np.zeros(3)
        matrix = hypothesis.body_from_measured(nominal)
        in_body, depth = rotate_vectors(matrix, velocity), stream.depth(time)
        measured = EffectInput(time, in_body, nominal, rotation, rates, stream.frame, 0.0, depth)
        if any(each.effect.acts_on is ActsOn.MOUNTING for each in injections):
            # a small rotation does not change the speed
            turn = turns(injections, undo_effects(injections, measured, ActsOn.DVL, matrix @ nominal)[0])
            matrix = hypothesis.body_from_measured(nominal, turn)
            measured = replace(measured, velocity_body=rotate_vectors(matrix, velocity))
        at_dvl, of_dvl = undo_effects(injections, measured, ActsOn.DVL, matrix @ nominal)
        motion = replace(at_dvl, velocity_body=at_dvl.velocity_body - lever)
        motion, of_motion = undo_effects(injections, motion, ActsOn.MOTION, None)
        added = of_dvl + of_motion + lever
        return _Moved(motion, at_dvl, raw, smooth, added, hypothesis.phi + turn, matrix, dvl, attitude)

    def _close(self, hypothesis: Hypothesis, recording: int, time: Array) -> tuple[Seen, NDArray[np.intp]] | None:
        """Evaluate `Seen.close`. Return None if the times are close already."""
        between = self.grids[recording].between(time)
        return between and (self.seen(hypothesis.without_memory, recording, between[0]), between[1])

    def _close_unsmoothed(
        self, hypothesis: Hypothesis, recording: int, time: Array
    ) -> tuple[EffectInput, NDArray[np.intp]] | None:
        """Evaluate `Seen.close_unsmoothed`. Return None if the times are close already."""
        between = self.grids[recording].between(time)
        return between and (self._moved(hypothesis.without_memory, recording, between[0], True).motion, between[1])

    def _kept_projection(self, stream: RecordedStreams, rotation: Array | None, at: Array) -> Array:
        """Return the `projection` at attitude times (F,) s, cached for the last few."""
        if stream.attitude is None or all(self.measured):
            return self.projection(stream, rotation)
        what = f"projection {self.measured}"
        return np.asarray(stream.attitude.kept.at(what, at, lambda: self.projection(stream, rotation)))

    def _oriented(self, stream: RecordedStreams, at: Array) -> tuple[Array | None, Array | None]:
        rotation = stream.rotation_enu_from_body(at) if EffectNeeds.ATTITUDE in self.available else None
        return rotation, stream.angular_velocity(at) if EffectNeeds.ANGULAR_VELOCITY in self.available else None

    def all_seen(self, hypothesis: Hypothesis) -> list[Seen]:
        """Evaluate a hypothesis for every recording."""
        return [self.seen(hypothesis, recording) for recording in range(len(self.recordings))]

    def residual(self, seen: Sequence[Seen]) -> Array:
        """Return e (M, A) m/s in the compared frame."""
        return self.binned([each.error for each in seen], seen)

    def binned(self, bodies: Sequence[Array], seen: Sequence[Seen]) -> Array:
        """Return means (M, A, ...) in the compared frame of each recording's (F, 3, ...) in the body frame."""
        return np.concatenate(list(map(self._in_bins, self.grids, bodies, seen)))

    def _in_bins(self, grid: Grid, body: Array, seen: Seen) -> Array:
        """Return means (m, A, ...) per bin of (F, 3, ...) of one recording."""
        return grid.averaged(body if all(self.measured) else seen.compared(body))

    @cached_property
    def bin_of(self) -> NDArray[np.intp]:
        """Return (F,) bin of every sample of all recordings."""
        per_bin = np.concatenate([np.full(len(grid.bin_time), grid.per_bin) for grid in self.grids])
        return np.repeat(np.arange(len(per_bin)), per_bin)

    @cached_property
    def sample_time(self) -> Array:
        """Return (F,) s of every sample since the beginning of its recording, corrected by the initial guess."""
        return np.concatenate([grid.stamps - grid.delay_s for grid in self.grids])

    def errors(self, seen: Sequence[Seen]) -> Array:
        """Return e (F, 3) m/s per sample, ahead, to port and up; zero on unmeasured axes."""
        parts = []
        for each in seen:
            error = each.error
            if not all(self.measured):
                error = np.zeros_like(error)
                error[:, list(self.measured)] = each.compared(each.error)
            parts.append(error)
        return np.concatenate(parts)

    def sampled(self, seen: Sequence[Seen], of: Callable[[EffectInput], Array]) -> Array:
        """Return the mean of a function of the motion (F, ...) in the M bins."""
        return np.concatenate([grid.averaged(of(each.motion)) for grid, each in zip(self.grids, seen, strict=True)])

    # ------------------------------------------------------------------ its derivatives

    def calibration_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> Array:
        """Return d e / d (φ, δk), (M, A, 6)."""
        parts = []
        for recording, (grid, each) in enumerate(zip(self.grids, seen, strict=True)):
            # of one mounting they are linear in the velocity: average it first
            lags = hypothesis.lags(recording)
            if each.body_from_measured.ndim == 2 and all(self.measured) and not lags:
                parts.append(self._mounting_columns(hypothesis, each, grid.averaged(each.measured)))
                continue
            close, own = each.close if lags else (each, slice(None))
            body = self._mounting_columns(hypothesis, close, close.measured)
            parts.append(self._in_bins(grid, lagged_columns(lags, each, close, own, body), each))
        return np.concatenate(parts)

    def _mounting_columns(self, hypothesis: Hypothesis, seen: Seen, velocity_dvl: Array) -> Array:
        """Return d e / d (φ, δk), (F, 3, 6), body frame, of DVL velocities (F, 3) m/s in its frame."""
        columns = np.empty((len(velocity_dvl), 3, 6))
        by_rotation = columns_by_turn(hypothesis, seen, velocity_dvl)
        columns[:, :, :3] = by_rotation if all(self.measured) else by_rotation @ self.observable_turns
        unscaled = velocity_dvl / (1.0 + hypothesis.scale)
        np.multiply(-unscaled[:, None, :], seen.body_from_measured, out=columns[:, :, 3:])
        return columns

    def all_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> Array:
        """Return d e / d (φ, δk) and all parameters of a hypothesis, in its order, (M, A, 6 + p)."""
        effects = hypothesis.effects
        if not hypothesis.lags(0):
            of_each = [self.columns(hypothesis, seen, each, hypothesis.values[each.name]) for each in effects]
            return np.concatenate([self.calibration_columns(hypothesis, seen), *of_each], axis=2)
        # filter all lagging effects jointly: many columns take little longer than one
        lagging = [effect for effect in effects if effect.acts_on is not ActsOn.REFERENCE]
        bodies = []
        for recording, each in enumerate(seen):
            close, own = each.close
            of_each = [
                self._derivatives(hypothesis, close, effect, hypothesis.values[effect.name][recording])
                for effect in lagging
            ]
            body = np.concatenate([self._mounting_columns(hypothesis, close, close.measured), *of_each], axis=2)
            bodies.append(lagged_columns(hypothesis.lags(recording), each, close, own, body))
        joined = self.binned(bodies, seen)
        parts, at = {}, 6
        for effect in lagging:
            p = len(amplitudes(effect))
            parts[effect.name] = self._columns_per_recording(effect, joined[:, :, at : at + p])
            at += p
        for effect in effects:
            if effect not in lagging:
                parts[effect.name] = self.columns(hypothesis, seen, effect, hypothesis.values[effect.name])
        return np.concatenate([joined[:, :, :6], *(parts[effect.name] for effect in effects)], axis=2)

    def columns(self, hypothesis: Hypothesis, seen: Sequence[Seen], effect: Effect, values: Sequence[Values]) -> Array:
        """Return d e / d parameters of an effect about values, (M, A, p); per recording if its parameters are."""
        columns_of = []
        for recording, each in enumerate(seen):
            lags = hypothesis.lags(recording)
            of_motion = lags if effect.acts_on is not ActsOn.REFERENCE else []
            close, own = each.close if of_motion else (each, slice(None))
            if isinstance(effect, EffectWithMemory):
                unsmoothed, own = each.close_unsmoothed
                body = trace_columns(effect, unsmoothed, values[recording])[own]
                columns_of.append(without_remembered(lags, each, body))
            else:
                body = self._derivatives(hypothesis, close, effect, values[recording])
                lagging = (
                    lagged_columns(lags, each, close, own, body) if of_motion else without_remembered(lags, each, body)
                )
                columns_of.append(lagging)
        return self._columns_per_recording(effect, self.binned(columns_of, seen))

    def _columns_per_recording(self, effect: Effect, columns: Array) -> Array:
        """Return columns (M, A, p), or (M, A, r p) for parameters per recording, zero in other recordings."""
        whose, p = whose_parameters(effect, len(self.grids)), columns.shape[2]
        if whose == [None]:
            return columns
        found = np.zeros((*columns.shape[:2], len(whose) * p))
        for number, recording in enumerate(whose):
            own = self.recording_of == recording
            found[own, :, number * p : (number + 1) * p] = columns[own]
        return found

    def has_unobservable(self, hypothesis: Hypothesis) -> bool:
        """Return whether `unobservable_columns` of a hypothesis is not empty."""
        named = {*hypothesis.values, *OF_EVERY}
        return any(e.name in named for e in self.unobservable) or not np.allclose(self.observable_turns, np.eye(3))

    def unobservable_columns(self, hypothesis: Hypothesis, seen: Sequence[Seen]) -> tuple[Array, Array]:
        """Return d e / d unobservable parameters, (M, A, u), and their usual sizes (u,).

        They are rotations of the mounting and parts of effects. Each is small, but so is an insignificant effect:
        variance that they explain is not evidence for it.
        """
        parts, sizes = [], []
        eigenvalues, turns = np.linalg.eigh(np.eye(3) - self.observable_turns)
        if (eigenvalues > 0.5).any():
            by_rotation = replace(self, observable_turns=np.eye(3)).calibration_columns(hypothesis, seen)[:, :, :3]
            parts.append(by_rotation @ turns[:, eigenvalues > 0.5])
            sizes.append(np.full(parts[-1].shape[2], SETTINGS.prior_angle))
        for effect in self.unobservable:
            named = hypothesis.values.get(effect.name)
            if named is None and effect.name not in OF_EVERY:
                continue
            if isinstance(effect, MountingEffect):
                parts += self._unobservable_turns(hypothesis, seen, effect)
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

    def _unobservable_turns(self, hypothesis: Hypothesis, seen: Sequence[Seen], effect: Effect) -> list[Array]:
        """Return d e / d unobservable mounting rotations, (M, A, t), and d e / d half their square by recording, (M, A,
        r). The cosine of a 4° rotation scales all velocities of a recording by -0.25 per cent."""
        turned = self.columns(hypothesis, seen, effect, (effect.defaults,) * len(seen))
        slower = self.binned([-each.motion.velocity_body for each in seen], seen)[:, :, None]
        return [turned, self._columns_per_recording(effect, slower)]

    def _derivatives(self, hypothesis: Hypothesis, seen: Seen, effect: Effect, values: Values) -> Array:
        """Return d e / d parameters of an effect, (F, 3, p), body frame."""
        specs = amplitudes(effect)
        if isinstance(effect, ClockEffect):
            by_late = self._delay_columns(seen, effect.acts_on)
            slopes = [central_difference(spec, values, lambda at: effect.late(seen.motion.time, at)) for spec in specs]
            return np.stack([by_late * slope[:, None] for slope in slopes], axis=2)
        if isinstance(effect, MountingEffect):
            slopes = [central_difference(spec, values, lambda at: effect.turn(seen.at_dvl, at)) for spec in specs]
            by_turn = columns_by_turn(hypothesis, seen, seen.measured)
            stacked = np.stack([np.broadcast_to(slope, seen.error.shape) for slope in slopes], axis=2)
            return np.asarray(by_turn @ stacked)
        if effect.acts_on is not ActsOn.DVL:
            return trace_columns(effect, seen.motion, values)
        of_dvl = trace_columns(effect, seen.at_dvl, values)
        return np.asarray(seen.body_from_measured @ self.rotation_dvl_from_body @ of_dvl)

    def _delay_columns(self, seen: Seen, clock: ActsOn) -> Array:
        """Return d e / d delay of a clock, (F, 3), m/s per s, body frame."""
        if clock is ActsOn.DVL_CLOCK:
            return rotate_vectors(seen.body_from_measured, seen.rate_of_change)
        motion = seen.motion
        turning = np.zeros_like(motion.velocity_body)
        if motion.angular_velocity is not None and motion.reference_frame is not VelocityFrame.BODY:
            turning = cross(motion.angular_velocity, motion.velocity_body)
        if clock is ActsOn.ATTITUDE_CLOCK:
            return turning
        return -slopes(motion.time, motion.velocity_body) - turning


def make_problem(
    recordings: Sequence[RecordedStreams], rotation_dvl_from_body: Array, lever_arm: Array, offsets: Sequence[Offsets]
) -> Problem:
    """Make the problem on bins where all streams are available, at the initial offsets and at none."""
    lever_arm = np.asarray(lever_arm, dtype=float)
    recordings = [
        _with_dvl_frame(recording, rotation_dvl_from_body, lever_arm, offset.dvl)
        for recording, offset in zip(recordings, offsets, strict=True)
    ]
    grids = tuple(make_grid(recording, offset) for recording, offset in zip(recordings, offsets, strict=True))
    problem = Problem(tuple(recordings), rotation_dvl_from_body, lever_arm, grids)
    return problem if problem.measured[2] else replace(problem, observable_turns=_observable_turns(problem))


# The earth's frame is chosen if the squared fourth differences are below this share in it: noise alone gives the same
# sum in both frames
BENDING_SHARE = 0.8


def _with_dvl_frame(
    recording: RecordedStreams, rotation_dvl_from_body: Array, lever_arm: Array, delay_s: float
) -> RecordedStreams:
    """Choose the frame in which a slow DVL is interpolated: the one where it bends less. delay_s: of the DVL's stamps.

    In waves a vehicle rolls between two samples at 1 Hz but hardly changes its velocity over ground; in a turn on calm
    water it is the velocity along its own axes that stays.
    """
    if recording.attitude is None or recording.dvl.interval <= FAST_ENOUGH_S:
        return recording

    def rotation(at: Array) -> Array:
        return rotation_dvl_from_body @ recording.rotation_enu_from_body(at - delay_s).swapaxes(1, 2)

    def swing(at: Array) -> Array:
        return cross(recording.angular_velocity(at - delay_s), lever_arm) @ rotation_dvl_from_body.T

    of_earth = replace(recording.dvl, frame=TurningFrame(rotation, swing))
    return replace(recording, dvl=of_earth) if of_earth.bending < BENDING_SHARE * recording.dvl.bending else recording


# Mounting rotations that act by less than this (m/s RMS) at their prior size are not fitted: they would absorb the
# residual of waves with tens of degrees
TURN_SHOWN_MPS = 0.002


def _observable_turns(problem: Problem) -> Array:
    """Return the projection (3, 3) of φ on rotations that are observable whatever the scale."""
    columns = problem.calibration_columns(no_effect(), problem.all_seen(no_effect())).reshape(-1, 6)
    if not len(columns):
        return np.eye(3)
    by_turn, by_scale = columns[:, :3], columns[:, 3:]
    by_turn = by_turn - by_scale @ np.linalg.lstsq(by_scale, by_turn, rcond=None)[0]
    squares, turns = np.linalg.eigh(by_turn.T @ by_turn * (problem.axes / len(columns)))
    observable = turns[:, SETTINGS.prior_angle * np.sqrt(np.maximum(squares, 0.0)) > TURN_SHOWN_MPS]
    return np.asarray(observable @ observable.T)
