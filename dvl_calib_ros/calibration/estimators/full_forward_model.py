"""Forward model of `full`: predicted reference velocities and their derivatives by the states.

The model is in docs/models.md, "full: all unknowns in one fit". A reference in body axes is compared with the velocity
in the body, without attitude. The DVL's velocity is interpolated by a cubic spline: a straight line loses 2 % of waves
sampled at 4 Hz.

Shapes: J references, N samples of the DVL, M of the IMU.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from types import EllipsisType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.own import (
    BIAS,
    DELAY,
    HEADING,
    LEVER_ARM,
    N_STATE,
    PHI,
    REFERENCE_DELAY,
    REFERENCE_ERROR,
    SCALE,
    heading_cycles,
)
from ..models.parameters import Parameters
from ..numerics.frames import Array, cross, rotation_from_quaternion, skew, squared, turned_skew
from ..numerics.kalman import GaussianState
from ..numerics.robust import MEDIAN_SQUARE
from ..numerics.samples import Index, Mask
from ..streams.interpolation import DvlColumns, ImuColumns, ReferenceColumns

# Slow errors: reference velocity east, north, up (m/s); attitude about east, north, up (rad); constant error of the
# heading (rad), such as a declination that is not set. The yaw is relative to that heading. What is left of the error
# is the velocity of the lever arm, which the gyroscopes measure about the vehicle's own axes, and what tilts.
SLOW, CONSTANT = 7, 6
_UP = np.array([0.0, 0.0, 1.0])
# Half-width of the difference for angular acceleration, s.
TURNING_S = 0.1
# At sample intervals below this, s, slopes come from parabolas instead of a spline.
DENSE_S = 0.15
# Half-width of the difference for the DVL's acceleration, and bins of dense references: s, and intervals of the DVL.
SPAN_S, SPAN_INTERVALS = 0.5, 2.0
# Prior σ of a bias, m/s, below which it is known, and smallest information that the data add to it, as a share of it.
EXACT_MPS, LEAST_LEARNED = 1e-6, 1e-4
# Blocks that are predicted at once: more do not fit the processor's caches.
AT_ONCE = 16
# Longest gap of the DVL that is interpolated: the larger of this number of its usual intervals and this time, s.
GAP_INTERVALS, GAP_S = 3.0, 1.2


@dataclass(frozen=True)
class FitBlock:
    """All streams of a block of time; DVL and IMU extend beyond it for delays up to LONGEST_DELAY_S.

    from_s, end_s: the block's limits.
    slope: (N, 3) m/s², of the DVL's spline at its samples.
    imu_slope: (M, 7) per s, of the IMU's quaternion (of continuous sign) and angular velocity.
    measured: (J, 3) whether a reference measures each axis of its own frame.
    fold: (J,) hold-out fold of each reference.
    """

    from_s: float
    end_s: float
    dvl: DvlColumns
    slope: Array
    imu: ImuColumns
    imu_slope: Array
    reference: ReferenceColumns
    measured: Mask
    fold: NDArray[np.int64]

    def __deepcopy__(self, _: object) -> FitBlock:
        """Return the block itself, which nobody changes."""
        return self

    @cached_property
    def is_comparable(self) -> bool:
        """Whether it has references, and enough samples to interpolate at."""
        return len(self.dvl.times) >= 4 and len(self.imu.times) >= 2 and len(self.reference.times) > 0

    @cached_property
    def slope_reach_s(self) -> float:
        """Half-width (s) of the difference for the DVL's acceleration; over less, its noise dominates."""
        return max(SPAN_S, SPAN_INTERVALS * self.interval_s)

    @cached_property
    def slope_variance(self) -> float:
        """Variance ((m/s²)², per axis) of the acceleration due to DVL noise alone.

        The acceleration is the velocity difference over ±`slope_reach_s`.
        """
        if len(self.dvl.times) < 6:
            return 0.0
        # a fourth difference of white noise has 70 times its variance
        fourth = np.diff(self.dvl.velocity, 4, axis=0) ** 2 / 70.0
        noise = float(np.sort(fourth, axis=0)[len(fourth) // 2].mean()) / MEDIAN_SQUARE
        return noise / (2.0 * self.slope_reach_s**2)

    @cached_property
    def interval_s(self) -> float:
        """Usual DVL sample interval, s."""
        return float(np.sort(np.diff(self.dvl.times))[len(self.dvl.times) // 2 - 1])


class PredictedRows(NamedTuple):
    """Residuals of J references, and derivatives of their prediction, at a state (20,).

    times: (J,) s.
    residual: (J, 3) m/s.
    columns: (J, 3, 20) derivatives of the prediction by the states.
    slow: (J, 3, 7) derivatives of the prediction by the slow errors.
    weight: (J, 3) 1 where a reference measures the axis, else 0.
    fold: (J,) hold-out fold.
    up: (J, 21) derivatives of the DVL's velocity upwards by the states, and that velocity (m/s); 0 without attitude.
    oriented: (J,) whether there is an attitude.
    dvl: (J, 3) m/s, mean of the DVL's velocities before and after, whose noise is not in the residual.
    """

    times: Array
    residual: Array
    columns: Array
    slow: Array
    weight: Array
    fold: NDArray[np.int64]
    up: Array
    oriented: Mask
    dvl: Array

    def parts(self, bounds: Sequence[int]) -> list[PredictedRows | None]:
        """Return the rows between each two bounds; None for no rows."""
        parts: list[PredictedRows | None] = []
        for first, last in pairwise(bounds):
            parts.append(PredictedRows._make(column[first:last] for column in self) if last > first else None)
        return parts


def spline_slopes(times: Array, values: Array) -> Array:
    """Return the slopes (N, k) per s of a cubic spline through samples (N,) s, (N, k), with parabolas at both ends.

    For samples denser than DENSE_S, return slopes of parabolas through three samples.
    """
    n = len(times)
    step = np.diff(times)
    rise = np.diff(values, axis=0) / step[:, None]
    if n < 3:
        return np.broadcast_to(rise.mean(axis=0) if n > 1 else 0.0, values.shape).copy()
    inner = (step[1:, None] * rise[:-1] + step[:-1, None] * rise[1:]) / (step[1:] + step[:-1])[:, None]
    first, last = 2.0 * rise[0] - inner[0], 2.0 * rise[-1] - inner[-1]
    if n > (times[-1] - times[0]) / DENSE_S:
        return np.concatenate([[first], inner, [last]])
    matrix = np.zeros((n, n))
    at = np.arange(1, n - 1)
    matrix[at, at - 1], matrix[at, at + 1] = step[1:], step[:-1]
    matrix[at, at] = 2.0 * (step[1:] + step[:-1])
    matrix[0, 0] = matrix[-1, -1] = 1.0
    right = np.empty_like(values)
    right[1:-1] = 3.0 * (step[1:, None] * rise[:-1] + step[:-1, None] * rise[1:])
    right[0], right[-1] = first, last
    return np.linalg.solve(matrix, right)


class AttitudeAt(NamedTuple):
    """Attitude ``rotation_enu_from_body`` (J, 3, 3), identity without one, and turn rates at J times.

    oriented: (J,) where the attitude is known.
    rates: (J, 3) rad/s, and their derivative `turning` (J, 3) rad/s², body axes.
    rates_known: (J,).
    """

    rotation: Array
    oriented: Mask
    rates: Array
    turning: Array
    rates_known: Mask

    def part(self, at: Index) -> AttitudeAt:
        """Return the rows of some indices."""
        return AttitudeAt._make(column[at] for column in self)


class JoinedBlocks:
    """Streams of B blocks, interpolated at times of their J references.

    One call for many blocks is several times faster than one for each. rows: references of each block. reference,
    measured: (J,) columns of all blocks, see `FitBlock`.
    """

    def __init__(self, blocks: Sequence[FitBlock]) -> None:
        self.blocks = blocks
        self._counts = [len(block.reference.times) for block in blocks]
        self.rows = [slice(end - n, end) for n, end in zip(self._counts, accumulate(self._counts), strict=True)]
        self.reference = ReferenceColumns(
            *map(np.concatenate, zip(*(block.reference for block in blocks), strict=True))
        )
        self.measured = np.concatenate([block.measured for block in blocks])

    def by_row(self, block_values: Sequence[Any]) -> NDArray[Any]:
        """Return for each of the J references the value of its block."""
        return np.repeat(block_values, self._counts)

    def dvl_at(self, times: Array) -> tuple[Array, Mask]:
        """Interpolate the DVL's velocity (..., J, 3) m/s at times (..., J) s; return whether it is known (..., J)."""
        gap_s = self.by_row([max(GAP_INTERVALS * block.interval_s, GAP_S) for block in self.blocks])
        spline = _Spline(self, [block.dvl.times for block in self.blocks], times, gap_s)
        return spline.interpolate([(block.dvl.velocity, block.slope) for block in self.blocks]), spline.known

    def attitude_at(self, times: Array, gap_s: float) -> AttitudeAt:
        """Interpolate attitude and turn rates at times (J,) s, across gaps of up to gap_s.

        A straight line between attitudes at 1 Hz is wrong by a degree at the start of a turn.
        """
        around = times + np.array([[0.0], [-TURNING_S], [TURNING_S]])
        spline = _Spline(self, [block.imu.times for block in self.blocks], around, gap_s)
        rates, before, after = spline.interpolate(
            [(block.imu.angular_velocity, block.imu_slope[:, 4:]) for block in self.blocks]
        )
        q = spline.interpolate([(block.imu.orientation, block.imu_slope[:, :4]) for block in self.blocks], 0)
        rotation = rotation_from_quaternion(q / np.sqrt(squared(q))[:, None])
        # references in body axes need no attitude
        has_attitude = self.by_row([not np.isnan(block.imu.orientation).any() for block in self.blocks])
        rotation[~has_attitude] = np.eye(3)
        known = spline.known[0]
        return AttitudeAt(rotation, known & has_attitude, rates, (after - before) / (2.0 * TURNING_S), known)


class _Spline:
    """Cubic spline through the samples of joined blocks, evaluated at times of their J references.

    known: (..., J) false outside the samples of a block, and across gaps longer than gap_s.
    """

    def __init__(self, joined: JoinedBlocks, stamps: Sequence[Array], times: Array, gap_s: Array | float) -> None:
        """Find the two samples that enclose each time.

        stamps: (N,) s, of the samples of each block.
        times: (..., J) s, to evaluate at; column j lies in the block of reference j.
        gap_s: (J,) or one for all, longest gap (s) that is interpolated.
        """
        lengths = [len(block_stamps) for block_stamps in stamps]
        last = joined.by_row([*accumulate(lengths)]) - 1  # index of the last sample of each reference's block
        first = last - joined.by_row(lengths) + 1
        after = np.empty(times.shape, dtype=np.intp)
        for block_stamps, references in zip(stamps, joined.rows, strict=True):
            after[..., references] = block_stamps.searchsorted(times[..., references])
        after = np.minimum(np.maximum(after, 1) + first, last)
        all_stamps = np.concatenate(stamps)
        begin = all_stamps.take(after - 1)
        step = all_stamps.take(after) - begin
        self._after, self._step, self._share = after, step[..., None], ((times - begin) / step)[..., None]
        self.known = (times >= all_stamps.take(first)) & (times <= all_stamps.take(last)) & (step <= gap_s)

    def interpolate(self, columns: Sequence[tuple[Array, Array]], row: EllipsisType | int = ...) -> Array:
        """Interpolate values (N, k) of each block with slopes (N, k), see `spline_slopes`, at one row of the times."""
        values, slope = (np.concatenate(parts) for parts in zip(*columns, strict=True))
        after, step, share = self._after[row], self._step[row], self._share[row]
        before, rest = after - 1, 1.0 - share
        return np.asarray(
            values.take(before, axis=0) * (rest * rest * (1.0 + 2.0 * share))
            + values.take(after, axis=0) * (share * share * (1.0 + 2.0 * rest))
            + step * share * rest * (slope.take(before, axis=0) * rest - slope.take(after, axis=0) * share)
        )


def predicted(blocks: Sequence[FitBlock], x: Array, parameters: Parameters) -> list[PredictedRows | None]:
    """Return the rows of each block about a state x (20,); None without a comparable reference."""
    rows_of_blocks: list[PredictedRows | None] = [None] * len(blocks)
    for numbers, joined in joined_blocks(blocks):
        for number, rows in zip(numbers, _predicted(joined, x, parameters), strict=True):
            rows_of_blocks[number] = rows
    return rows_of_blocks


def joined_blocks(blocks: Sequence[FitBlock]) -> Iterator[tuple[list[int], JoinedBlocks]]:
    """Yield the numbers of comparable blocks and these blocks, up to AT_ONCE together."""
    comparable = [number for number, block in enumerate(blocks) if block.is_comparable]
    for at in range(0, len(comparable), AT_ONCE):
        numbers = comparable[at : at + AT_ONCE]
        yield numbers, JoinedBlocks([blocks[number] for number in numbers])


class _AtReferences(NamedTuple):
    """Streams at the delayed times of the J usable references of joined blocks.

    used: (J,) their indices.
    turns: (J, 1) 0 for a reference in body axes, else 1.
    velocity, earlier, later: (J, 3) m/s of the DVL, its frame, then, and `reach` (J,) s before and after.
    """

    used: Index
    turns: Array
    imu: AttitudeAt
    velocity: Array
    earlier: Array
    later: Array
    reach: Array


def _at_references(joined: JoinedBlocks, x: Array, parameters: Parameters) -> _AtReferences:
    """Interpolate the streams at delays of a state x (20,), and select the usable references."""
    reference = joined.reference
    at = reference.times - x[REFERENCE_DELAY]
    imu = joined.attitude_at(at, parameters.imu_timeout)
    reach, stamps = joined.by_row([block.slope_reach_s for block in joined.blocks]), at + x[DELAY]
    velocity, known = joined.dvl_at(np.stack([stamps, stamps - reach, stamps + reach]))
    use = known[0] & (imu.oriented | reference.in_body) & imu.rates_known
    # by the DVL, which is less noisy: selected by the reference, samples near the limit would bias the scale
    use &= squared(velocity[0]) >= parameters.min_speed**2
    if parameters.max_turn_rate > 0.0:
        use &= squared(imu.rates) <= parameters.max_turn_rate**2
    used = np.flatnonzero(use)
    turns = np.where(reference.in_body[used, None], 0.0, 1.0)
    now, earlier, later = velocity[:, used]
    return _AtReferences(used, turns, imu.part(used), now, earlier, later, reach[used])


def _velocity_in_body(streams: _AtReferences, x: Array, parameters: Parameters) -> tuple[Array, Array]:
    """Return the velocity (J, 3) m/s of the reference point by the DVL, body frame, and its derivatives (J, 3, 20).

    It is Tᵀ (I + [φ×])⁻¹ (v - b) / (1 + δk) - ω × l, with the states x (20,), by which it is differentiated.
    """
    t = parameters.rotation_dvl_from_body
    inverse = np.linalg.inv(np.eye(3) + skew(x[PHI]))
    gain = 1.0 / (1.0 + np.append(x[SCALE], 0.0))
    arm = np.array(parameters.lever_arm) + x[LEVER_ARM]
    scaled = (streams.velocity - x[BIAS]) * gain
    in_dvl = scaled @ inverse.T
    through = t.T @ inverse * gain
    acceleration = (streams.later - streams.earlier) / (2.0 * streams.reach[:, None]) @ through.T
    rates = streams.imu.rates
    body = in_dvl @ t - cross(rates, arm)
    columns = np.zeros((len(body), 3, N_STATE))
    columns[:, :, PHI] = turned_skew(t.T @ inverse, in_dvl.T).transpose(2, 0, 1)
    columns[:, :, SCALE] = -(t.T @ inverse)[None, :, :2] * (scaled * gain)[:, None, :2]
    columns[:, :, LEVER_ARM] = -skew(rates)
    columns[:, :, BIAS] = -through
    columns[:, :, DELAY] = acceleration
    of_rotation = streams.turns * cross(rates, body)  # the attitude of another time rotates the reference
    columns[:, :, REFERENCE_DELAY] = cross(streams.imu.turning, arm) - acceleration - of_rotation
    return body, columns


def _predicted(joined: JoinedBlocks, x: Array, parameters: Parameters) -> list[PredictedRows | None]:
    """Return the rows of each of the joined blocks, see `predicted`."""
    streams = _at_references(joined, x, parameters)
    used, turns, rotation = streams.used, streams.turns, streams.imu.rotation
    if not len(used):
        return [None] * len(joined.blocks)
    body, body_columns = _velocity_in_body(streams, x, parameters)
    upwards = rotation[:, 2] * streams.imu.oriented[:, None]
    up_columns = np.einsum("ni,nik->nk", upwards, body_columns)
    up = np.column_stack([up_columns, (upwards * body).sum(axis=1)])
    # to the frame of the reference, with the heading deviation
    in_body, cycles = joined.reference.in_body[used], heading_cycles(rotation)
    deviation = np.where(in_body, 0.0, cycles @ x[HEADING])
    onto = np.where(in_body[:, None, None], np.eye(3), _about_up(deviation) @ rotation)
    velocity = np.matmul(onto, body[..., None])[..., 0]
    columns = onto @ body_columns
    across = np.stack([-velocity[:, 1], velocity[:, 0], np.zeros(len(used))], axis=1) * turns
    columns[:, :, HEADING] = across[:, :, None] * cycles[:, None, :]
    columns[:, :, REFERENCE_ERROR] = turns[:, :, None] * np.eye(3)
    slow = np.zeros((len(used), 3, SLOW))
    slow[:, :, :3] = np.eye(3)
    slow[:, :, 3:6] = -turns[:, :, None] * skew(velocity)
    of_dvl = body + cross(streams.imu.rates, np.array(parameters.lever_arm) + x[LEVER_ARM])
    body_up = np.sign(rotation[:, 2, 2:]) * _UP  # a body may be z-down
    slow[:, :, CONSTANT] = turns * (np.matmul(onto, cross(body_up, of_dvl)[..., None])[..., 0] - cross(_UP, velocity))
    rows = PredictedRows(
        times=joined.reference.times[used],
        residual=joined.reference.velocity[used] - velocity - turns * x[REFERENCE_ERROR], columns=columns, slow=slow,
        weight=joined.measured[used].astype(float), fold=np.concatenate([block.fold for block in joined.blocks])[used],
        up=up, oriented=streams.imu.oriented, dvl=0.5 * (streams.earlier + streams.later),
    )  # fmt: skip
    return rows.parts(np.searchsorted(used, [0, *(own.stop for own in joined.rows)]).tolist())


def _about_up(angle: Array) -> Array:
    """Return rotations (J, 3, 3) by angles (J,) rad about the third axis."""
    turned = np.zeros((len(angle), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angle)
    turned[:, 1, 0] = np.sin(angle)
    turned[:, 0, 1] = -turned[:, 1, 0]
    turned[:, 2, 2] = 1.0
    return turned


def deviation_of(state: GaussianState) -> GaussianState:
    """Return the heading deviation of a state x (20,), P (20, 20), see `Estimate.heading_deviation`."""
    return GaussianState(-state.x[HEADING], state.p[HEADING, HEADING])


def bias_by_data(state: GaussianState, prior: GaussianState) -> GaussianState | None:
    """Return the DVL's bias x (3,) m/s, P (3, 3), DVL axes, by the data without its prior; None if it is known exactly.

    state, prior: x, P, whose first 20 states are those of the first day, before `with_bias_in_mounting`.
    """
    if (np.diag(prior.p)[BIAS] < EXACT_MPS**2).any():
        return None
    (after, vector), (before, known) = (GaussianState(x[BIAS], p[BIAS, BIAS]).information for x, p in (state, prior))
    values, axes = np.linalg.eigh(after - before)
    covariance = axes / np.maximum(values, LEAST_LEARNED * np.linalg.eigvalsh(before)[0]) @ axes.T
    return GaussianState(covariance @ (vector - known), covariance)


def with_bias_in_mounting(x: Array, p: Array) -> GaussianState:
    """Return the states x (20,), P (20, 20) of one day at zero DVL bias, with the bias's uncertainty in P.

    Published velocities are not corrected for bias, so the mounting absorbs it (docs/models.md, "full: all unknowns in
    one fit").
    """
    gain = p[:, BIAS] @ np.linalg.inv(p[BIAS, BIAS])
    moved = gain @ x[BIAS]
    return GaussianState(x - moved, p + np.outer(moved, moved))
