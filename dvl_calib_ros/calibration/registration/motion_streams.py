"""Motion: DVL, reference and IMU streams as smoothed columns, in s since a common epoch.

Shapes: J points of time, N samples.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import ENU_FROM_NED, Array
from ..numerics.robust import median
from ..numerics.samples import FRAME_CODES, Index, Mask, SampleBlock, Streams, VelocityFrame
from ..streams.clock_correction import Clocks
from ..streams.interpolation import (
    BIN_S,
    GAP_S,
    LEAST_SLOPE_REACH_S,
    MOST_REACH_S,
    REACH_INTERVALS,
    DvlColumns,
    ImuColumns,
    LocalFit,
    TurnRates,
    angular_velocity_at,
    binned,
    local_fit,
    reach_at,
    spacing_at,
)
from ..streams.outliers import without_spikes
from ..streams.position_velocities import are_positions, of_moments
from ..streams.screening import measured_axes, screen_columns, unit_quaternions
from ..streams.stream_order import strays


@dataclass(frozen=True)
class MotionStreams:
    """Streams of one vehicle with increasing stamps.

    dvl: velocity in the DVL frame.
    reference_times (M,) s, reference (M, 3) m/s: ENU if in_earth, else body frame.
    measured: (3,) measured axes of the reference.
    imu: attitudes, may be missing.
    turns: angular rates.
    epoch_ns: stamp of time 0, before corrections.
    """

    dvl: DvlColumns
    reference_times: Array
    reference: Array
    in_earth: bool
    measured: tuple[bool, bool, bool]
    imu: ImuColumns
    turns: TurnRates
    epoch_ns: int = 0

    @cached_property
    def has_attitude(self) -> bool:
        """True if there are attitudes to interpolate between."""
        return int(np.count_nonzero(~np.isnan(self.imu.orientation[:, 0]))) > 1

    @cached_property
    def curves(self) -> Curves:
        """Smoothed velocity of the DVL and turn rates."""
        return Curves(self)

    def part(self, rows: Index, margin_s: float) -> MotionStreams:
        """Return consecutive references, with DVL and IMU samples within a margin (s) around them."""
        times = self.reference_times[rows]
        is_near = (self.dvl.times >= times[0] - margin_s) & (self.dvl.times <= times[-1] + margin_s)
        dvl = DvlColumns(self.dvl.times[is_near], self.dvl.velocity[is_near])
        first, end = np.searchsorted(self.imu.times, (times[0] - margin_s, times[-1] + margin_s)).tolist()
        imu = ImuColumns(*(column[first:end] for column in self.imu))
        return replace(self, reference_times=times, reference=self.reference[rows], dvl=dvl, imu=imu)


def motion_of(streams: Streams, parameters: Parameters) -> MotionStreams | None:
    """Return the motion in samples after the configured clock corrections, or None if there are too few samples.

    streams: as decoded, the IMU's data in the body's axes.
    """
    jump_ns = round(parameters.max_time_jump * 1e9)
    streams = Streams(*(block.part(~strays(block.stamps_ns, jump_ns)) for block in streams))
    dvl, reference = (_valid(block, parameters) for block in (streams.dvl, streams.reference))
    imu = streams.imu.part(streams.imu.refused == 0)
    if len(dvl) < 2 or len(reference) < 2:
        return None
    clocks = Clocks.of(parameters)
    first_ns = int(dvl.stamps_ns[0])
    code = int(np.bincount(reference.frames).argmax())
    reference = reference.part(reference.frames == code)
    times = 1e-9 * (clocks.dvl(dvl.stamps_ns, first_ns) - first_ns)
    dvl_times, velocity = in_order(times, dvl.values)
    reference_times, reading = in_order(1e-9 * (reference.stamps_ns - clocks.reference_ns - first_ns), reference.values)
    imu_times, numbers = in_order(
        1e-9 * (imu.stamps_ns - clocks.imu_ns - first_ns),
        np.hstack([unit_quaternions(imu.orientation), imu.angular_velocity]),
    )
    # contiguous, because each use of a slice of wider rows would copy it
    columns = ImuColumns(imu_times, *map(np.ascontiguousarray, np.split(numbers, [4], axis=1)))
    if are_positions(parameters):
        reading = of_moments(reference_times, reading, columns, parameters)
    if code == FRAME_CODES[VelocityFrame.NED]:
        reading = reading @ ENU_FROM_NED.T
    measured = measured_axes(reference.values, screen_columns(reference.covariances).unmeasured, parameters.gnss_axes)
    if code == FRAME_CODES[VelocityFrame.NED]:
        measured = measured[1], measured[0], measured[2]
    made = make_motion(
        (dvl_times, velocity), (reference_times, reading), code != FRAME_CODES[VelocityFrame.BODY], measured, columns
    )
    return None if made is None else replace(made, epoch_ns=first_ns)


def make_motion(
    dvl: tuple[Array, Array],
    reference: tuple[Array, Array],
    in_earth: bool,
    measured: tuple[bool, bool, bool],
    imu: ImuColumns,
) -> MotionStreams | None:
    """Return a motion without velocity spikes, or None if too few samples remain or no axis is measured.

    dvl, reference: increasing times (N,) s and velocities (N, 3) m/s.
    """
    times, velocity = _cleaned(*dvl)
    reference_times, velocities = _cleaned(*reference)
    if min(len(times), len(reference_times)) < 2 or not any(measured):
        return None
    columns = DvlColumns(times, velocity)
    return MotionStreams(columns, reference_times, velocities, in_earth, measured, imu, TurnRates.of(imu))


def _cleaned(times: Array, velocity: Array) -> tuple[Array, Array]:
    """Return finite velocities without spikes, binned to the rate that is needed."""
    finite = np.isfinite(velocity).all(axis=1)
    times, velocity = times[finite], velocity[finite]
    good = without_spikes(velocity, smallest=0.1, also_at_ends=True)
    times, velocity = binned(times[good], velocity[good])
    return times, velocity


def in_order(times: Array, values: Array) -> tuple[Array, Array]:
    """Return times (N,) and samples (N, k) without those whose stamps go backward."""
    later = np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0.0
    return times[later], values[later]


def _valid(block: SampleBlock, parameters: Parameters) -> SampleBlock:
    speed = np.sqrt((block.values[:, :3] ** 2).sum(axis=1))
    return block.part((block.refused == 0) & (speed <= parameters.max_speed) & (speed > 0.0))


# Most grid points of the smoothed curves of a long recording, and points per pass.
MOST_GRID, AT_ONCE = 18_000, 1000
# Turn rates farther from the DVL data are not used, s: larger than any searched delay.
TURNS_BEYOND_S = 3600.0


class Curves:
    """Smoothed DVL velocity, its slope and turn rates on a fine grid, computed once for all delays."""

    def __init__(self, motion: MotionStreams) -> None:
        """Smooth the DVL's velocity and the turn rates of a motion on grids with steps of BIN_S or more."""
        times = motion.dvl.times
        length_s = float(times[-1] - times[0])
        self._step, self._start = max(BIN_S, length_s / MOST_GRID), float(times[0])
        self._grid = self._start + self._step * np.arange(int(length_s / self._step) + 2)
        self._smooth_velocity(motion.dvl)
        self._turns, self._turns_start = np.zeros((3, 2)), 0.0
        # near the DVL data only: the grid must not span an arbitrary IMU clock offset
        imu_times = motion.turns.times
        imu_times = imu_times[(imu_times >= times[0] - TURNS_BEYOND_S) & (imu_times <= times[-1] + TURNS_BEYOND_S)]
        if len(imu_times) > 1:
            grid = np.arange(imu_times[0], imu_times[-1] + self._step, self._step)
            self._turns_start = float(grid[0])
            rates = [angular_velocity_at(motion.turns, grid[at], GAP_S) for at in _parts(len(grid))]
            self._turns = np.nan_to_num(np.concatenate(rates).T.copy())

    def _smooth_velocity(self, dvl: DvlColumns) -> None:
        """Fit velocity (m/s), slope (m/s²) and the slope's noise gain at the grid, over a reach (s) by the spacing."""
        reach = reach_at(spacing_at(dvl.times, self._grid), LEAST_SLOPE_REACH_S, MOST_REACH_S)
        reach = np.clip(reach, LEAST_SLOPE_REACH_S, None)
        usual = REACH_INTERVALS * float(median(np.diff(dvl.times)))
        reach[np.isnan(reach)] = max(LEAST_SLOPE_REACH_S, min(usual, MOST_REACH_S))
        fits = [local_fit(dvl.times, dvl.velocity, self._grid[at], reach[at]) for at in _parts(len(self._grid))]
        columns = [np.vstack([fit.value.T, fit.slope.T, fit.slope_gain]) for fit in fits]
        self._velocity = np.concatenate(columns, axis=1)
        self._found = np.concatenate([fit.found for fit in fits])

    def signed(self, signs: Array) -> Curves:
        """Return the curves of a DVL with these axis signs (3,)."""
        made = copy(self)
        made._velocity = self._velocity * np.concatenate([signs, signs, [1.0]])[:, None]
        return made

    def velocity(self, at: Array) -> LocalFit:
        """Return the DVL's velocity (J, 3) m/s and its slope (J, 3) m/s² at times (J,) s."""
        before, share, inside = self._places(at, self._start, len(self._grid))
        columns = _between(self._velocity, before, share)
        found = inside & self._found[before] & self._found[before + 1]
        return LocalFit(columns[:3].T, columns[3:6].T, columns[6], found)

    def rates(self, at: Array) -> Array:
        """Return angular rates (3, J) rad/s at times (J,) s, zero where unknown."""
        before, share, inside = self._places(at, self._turns_start, self._turns.shape[1])
        return np.where(inside, _between(self._turns, before, share), 0.0)

    def _places(self, at: Array, start: float, n: int) -> tuple[Index, Array, Mask]:
        """Return the grid point before each time (J,) s, the share of a step beyond it (J,), and whether inside."""
        place = (at - start) / self._step
        before = np.minimum(np.maximum(place, 0), n - 2).astype(np.intp)
        return before, place - before, (place >= 0.0) & (place <= n - 1)


def _parts(n: int) -> list[slice]:
    """Return slices of n points, small enough for the memory of a node."""
    return [slice(first, first + AT_ONCE) for first in range(0, n, AT_ONCE)]


def _between(values: Array, before: Index, share: Array) -> Array:
    """Interpolate columns linearly between index `before` and the next, at a share (0..1)."""
    before_value = values.take(before, axis=1)
    values_at: Array = values.take(before + 1, axis=1)
    values_at -= before_value
    values_at *= share
    values_at += before_value
    return values_at
