"""Registration of clocks and frames from the streams that `full` keeps, per day.

A reference delay pairs velocities with attitudes of another time, which looks almost like a lever arm (docs/models.md,
"Registration: which clock is late").
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ...verdict.reasons import Reason
from ..assessment.dead_reckoning import dead_reckoned
from ..filters.cross_validation import folds_of
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.samples import FRAMES, Codes, Mask
from ..numerics.tables import RowTable, column
from ..registration.configuration_check import fitting_configuration
from ..registration.motion_streams import MotionStreams, make_motion
from ..registration.registration import Registration, register
from ..results.thinned_recording import (
    KEPT_EVERY_S,
    MEASURED_BELOW,
    Terms,
    ThinnedBlock,
    ThinnedRecording,
    typical_error,
)
from ..streams.interpolation import DvlColumns, ImuColumns, ReferenceColumns
from .estimator import Residuals
from .full_fit import KEPT_BLOCKS, JointFit
from .full_forward_model import deviation_of

# Live, registration is repeated once the number of blocks has grown by this factor.
REPEATED_AT_GROWTH = 1.5
# Blocks needed for a registration, and before the first live one (a minute).
MIN_BLOCKS, FIRST_LIVE_BLOCKS = 2, 6
# Rows of each stream in a 10 s block.
ROWS_PER_BLOCK = int(10.0 / KEPT_EVERY_S) + 1


class _DvlVelocities(RowTable):
    """DVL times s, velocities m/s, and trace of the noise covariance, (m/s)²."""

    IS_REUSED = True  # a motion has copies
    times: Array = column(np.float64)
    velocity: Array = column(np.float64, 3)
    noise: Array = column(np.float64)


class _Reference(RowTable):
    """Reference times s, velocities m/s, variances (m/s)² of each axis, see `ReferenceColumns`."""

    IS_REUSED = True  # a motion has copies
    times: Array = column(np.float64)
    velocity: Array = column(np.float64, 3)
    variance: Array = column(np.float64, 3)
    in_body: Mask = column(np.bool_)
    claimed: Mask = column(np.bool_)


class _Imu(RowTable):
    """IMU times s, attitudes and rates, see `ImuColumns`."""

    IS_REUSED = True  # a motion has copies
    times: Array = column(np.float64)
    orientation: Array = column(np.float64, 4)
    angular_velocity: Array = column(np.float64, 3)


class _NewestBlocks:
    """Streams of the newest blocks as registration needs them, without covariances between axes."""

    def __init__(self) -> None:
        self._streams = _DvlVelocities(), _Reference(), _Imu()
        self._blocks: deque[tuple[int, ...]] = deque()  # rows per stream

    def __len__(self) -> int:
        return len(self._blocks)

    def take_room(self) -> None:
        """Reserve the final size now, so that memory does not grow for 40 minutes."""
        for stream in self._streams:
            stream.reserve((KEPT_BLOCKS + 1) * ROWS_PER_BLOCK)

    def add(self, block: ThinnedBlock) -> None:
        """Add a block, and drop the oldest beyond `KEPT_BLOCKS`."""
        r = block.reference
        variance = np.diagonal(r.noise, axis1=1, axis2=2)
        own_noise = np.full(len(block.dvl.times), np.trace(block.noise_dvl))
        columns = (*block.dvl, own_noise), (r.times, r.velocity, variance, r.in_body, r.claimed), block.imu
        for stream, own_columns in zip(self._streams, columns, strict=True):
            rows = stream.extend(len(own_columns[0]))
            for name, values in zip(stream.LAYOUT, own_columns, strict=True):
                getattr(stream, name)[rows] = values
        self._blocks.append(tuple(len(own_columns[0]) for own_columns in columns))
        if len(self._blocks) > KEPT_BLOCKS:
            for stream, n in zip(self._streams, self._blocks.popleft(), strict=True):
                stream.forget_before(stream.begin + n)

    def clear(self) -> None:
        """Forget all blocks."""
        self._blocks.clear()
        for stream in self._streams:
            stream.clear()

    def recording(self) -> ThinnedRecording:
        """Return all blocks as a recording for verification."""
        (dvl_times, dvl, own_noise), (times, velocity, variance, in_body, claimed), imu = self._columns()
        reference = ReferenceColumns(times, velocity, variance[:, :, None] * np.eye(3), in_body, claimed)
        return ThinnedRecording(DvlColumns(dvl_times, dvl), own_noise, reference, ImuColumns(*imu))

    def motion(self) -> MotionStreams | None:
        """Return all blocks with the references of the commoner frame; None for too little data."""
        dvl, (times, velocity, variance, in_body, _), imu = self._columns()
        is_measured = variance < MEASURED_BELOW
        alike = in_body == (2 * np.count_nonzero(in_body) > len(in_body))
        x, y, z = (2 * np.count_nonzero(is_measured[alike], axis=0) > np.count_nonzero(alike)).tolist()
        return make_motion(
            (dvl[0].copy(), dvl[1].copy()), (times[alike], velocity[alike]),
            not bool(in_body[alike].all()) if alike.any() else False, (x, y, z),
            ImuColumns(*(column.copy() for column in imu)),
        )  # fmt: skip

    def _columns(self) -> Iterator[list[Any]]:
        """Yield the columns of each stream, as views."""
        for stream in self._streams:
            yield [getattr(stream, name)[stream.begin : stream.size] for name in stream.LAYOUT]


class FitSoFar(NamedTuple):
    """The fit of all blocks so far, and the stamp (ns) of its time 0."""

    fit: JointFit
    epoch_ns: int


class RegistrationResult(NamedTuple):
    """Registration after a number of blocks, the fitting configuration if not the given one, and live residuals."""

    blocks: int = 0
    registration: Registration | None = None
    configuration: Reason | None = None
    residuals: Residuals | None = None


class RegistrationSchedule:
    """Registration results of earlier days and of the current one."""

    def __init__(self, parameters: Parameters, live: bool) -> None:
        """Start without blocks. live: the run may last hours."""
        self._parameters, self._is_live = parameters, live
        self._newest = _NewestBlocks()
        if live:
            self._newest.take_room()
        self._blocks = 0  # of this day
        self._declared = np.zeros(len(FRAMES), dtype=np.int64)  # references said to be in each frame
        self._contradicted: RegistrationResult | None = None  # of an earlier day with a contradiction
        self._latest = RegistrationResult()

    def add(self, block: ThinnedBlock, frames: Codes, from_ns: int) -> None:
        """Add a block's streams. frames: (J,) declared frame codes of its references. from_ns: the block's start."""
        self._newest.add(block)
        self._declared += np.bincount(frames, minlength=len(FRAMES))
        self._blocks += 1

    def end_day(self) -> None:
        """Begin a new day, whose clock offsets may differ."""
        found = self.latest()
        self._contradicted = found if found.configuration or self.contradiction(found) else None
        self._newest.clear()
        self._blocks, self._latest = 0, RegistrationResult()

    def register_again(self, fit_so_far: FitSoFar | None) -> None:
        """Repeat the registration if there is enough new data. fit_so_far: the fit so far; None without data."""
        enough = max(REPEATED_AT_GROWTH * self._latest.blocks, FIRST_LIVE_BLOCKS)
        if self._contradicted is None and self._blocks >= enough:
            self._latest = self._register(fit_so_far)

    def latest(self, fit_so_far: FitSoFar | None = None, *, fresh: bool = True) -> RegistrationResult:
        """Return the registration of the blocks so far, or of an earlier day with a contradiction.

        fresh: use all blocks, else those of the latest `register_again`.
        """
        if self._contradicted is not None:
            return self._contradicted
        if fresh and self._blocks > self._latest.blocks:
            self._latest = self._register(fit_so_far)
        return self._latest

    def contradiction(self, registered: RegistrationResult) -> Reason | None:
        """Return the clock settings that fit the registration, if the configured ones do not."""
        return None if registered.registration is None else registered.registration.contradiction(self._parameters)

    def _register(self, fit_so_far: FitSoFar | None) -> RegistrationResult:
        """Register clocks and frames from the newest blocks, and compute live residuals of the fit so far."""
        motion = self._newest.motion() if len(self._newest) >= MIN_BLOCKS else None
        if motion is None:
            return RegistrationResult(self._blocks)
        nominal, lever_arm = self._parameters.rotation_dvl_from_body.T, np.array(self._parameters.lever_arm)
        declared = FRAMES[int(self._declared.argmax())]
        try:
            found = register(motion, nominal, lever_arm)
            configuration = fitting_configuration(motion, declared, found, self._parameters)
            residuals = self._residuals(fit_so_far) if self._is_live and fit_so_far is not None else None
            return RegistrationResult(self._blocks, found, configuration, residuals)
        except np.linalg.LinAlgError:  # the fit diverged
            return RegistrationResult(self._blocks)

    def _residuals(self, fit_so_far: FitSoFar) -> Residuals:
        """Return the residuals of all kept blocks, each corrected by the fit without its fold."""
        recording, p = self._newest.recording(), self._parameters
        fit, epoch_ns = fit_so_far
        stamps_ns = np.round(recording.dvl.times * 1e9).astype(np.int64) + epoch_ns
        state = fit.states[-1]
        terms = [Terms.of_state(states_of_days[-1].x) for states_of_days in fit.without_folds()]
        instrument_errors = deviation_of(state), fit.slow_noise, fit.dvl_bias, fit.beam_fault()
        return Residuals(
            held_out=fit.held_out_error(),
            typical=typical_error(recording, Terms.of_state(state.x), p),
            judged=recording.judged(p),
            navigation=dead_reckoned(recording, folds_of(stamps_ns, p), terms, p, epoch_ns, *instrument_errors),
            in_earth=not recording.reference.in_body.any(),
        )
