"""Time blocks of all streams prepared for the fit: copied, thinned, in seconds, without outliers.

Neighbours identify an outlier (outliers.py). Between samples of a slow stream a vehicle may turn, so a larger scatter
is assumed there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..models.parameters import Parameters
from ..numerics.frames import ENU_FROM_NED, Array
from ..numerics.robust import median, steps
from ..numerics.samples import AXIS_BITS, FRAME_CODES, Codes, Index, Mask, Stamps, VelocityFrame
from ..results.thinned_recording import NOT_MEASURED, thinned
from ..streams.interpolation import MARGIN_S, DvlColumns, ImuColumns, ReferenceColumns, binned
from ..streams.outliers import without_spikes
from ..streams.position_velocities import are_positions, of_moments

_BODY, _NED = FRAME_CODES[VelocityFrame.BODY], FRAME_CODES[VelocityFrame.NED]
# Smallest scatter about interpolation, m/s, assumed of a stream. SLOW_S: interval (s) from which the larger value
# applies, because a vehicle turns between samples.
LEAST_SCATTER_MPS, SLOW_S, LEAST_SCATTER_SLOW_MPS = 0.01, 0.45, 0.1


class Cleaned(NamedTuple):
    """Samples of a block, without outliers.

    raw: its references (J,) from the messages, thinned.
    reference: without outliers, with their stamps reference_ns.
    dvl: without outliers.
    binned_dvl: for interpolation.
    noise_dvl: (3, 3) (m/s)², mean covariance.
    reference_spikes, dvl_spikes: number of outliers within the block.
    own_dvl, own_imu: the block's own samples, without margins.
    are_compared: whether it has references and DVL data for them; else DVL and IMU are empty.
    """

    block: Block
    raw: ReferenceSamples
    reference: ReferenceColumns
    reference_ns: Stamps
    reference_spikes: int
    dvl: DvlColumns
    binned_dvl: DvlColumns
    dvl_spikes: int
    noise_dvl: Array
    imu: ImuColumns
    own_dvl: slice
    own_imu: slice
    are_compared: bool


def cleaned(block: Block, parameters: Parameters, epoch_ns: int) -> Cleaned:
    """Return the samples of a block without outliers. epoch_ns: stamp of time 0."""
    if are_positions(parameters):  # their velocities are means over a window
        around, imu = block.reference, _imu(block.imu, epoch_ns)
        velocity = of_moments(seconds(around.stamps_ns, epoch_ns), around.values[:, :3], imu, parameters)
        block = block._replace(reference=around._replace(values=np.hstack([velocity, around.values[:, 3:]])))
    own = _own_references(block)
    raw = block.reference.part(own)
    good = _good(block.reference.stamps_ns, _measured_velocity(block.reference))[own]
    reference = _reference(raw.part(np.flatnonzero(good)), parameters, epoch_ns)
    are_compared = len(reference.times) > 0 and not block.silent
    cleaned_dvl = _cleaned_dvl(block, parameters, epoch_ns) if are_compared else _NO_DVL
    imu = _imu(block.imu, epoch_ns) if are_compared else _NO_IMU
    dvl = cleaned_dvl.dvl
    from_s, to_s = seconds(np.array([block.from_ns, block.end_ns]), epoch_ns).tolist()
    return Cleaned(
        block=block, raw=raw, reference=reference, reference_ns=raw.stamps_ns[good],
        reference_spikes=int(np.count_nonzero(~good)), dvl=dvl,
        binned_dvl=dvl if is_slow(dvl.times) else DvlColumns(*binned(*dvl)), dvl_spikes=cleaned_dvl.n_spikes,
        noise_dvl=cleaned_dvl.noise, imu=imu, own_dvl=slice(*np.searchsorted(dvl.times, (from_s, to_s)).tolist()),
        own_imu=slice(*np.searchsorted(imu.times, (from_s, to_s)).tolist()), are_compared=are_compared,
    )  # fmt: skip


class _CleanedDvl(NamedTuple):
    """DVL samples without outliers, mean covariance (3, 3) (m/s)², and number of outliers within the block."""

    dvl: DvlColumns
    noise: Array
    n_spikes: int


_NO_DVL = _CleanedDvl(DvlColumns(np.zeros(0), np.zeros((0, 3))), np.eye(3), 0)
_NO_IMU = ImuColumns(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 3)))


def _cleaned_dvl(block: Block, p: Parameters, epoch_ns: int) -> _CleanedDvl:
    """Return the DVL samples of a block and its margins without outliers."""
    stamps_ns, velocity, covariance = block.dvl
    # an outlier distorts interpolation for all references near it, which no gate would detect
    good = _good(stamps_ns, velocity)
    n_spikes = 0
    if not good.all():
        spikes = stamps_ns[~good]
        stamps_ns, velocity, covariance = stamps_ns[good], velocity[good], covariance[good]
        n_spikes = int(np.count_nonzero((spikes >= block.from_ns) & (spikes < block.end_ns)))
    given = ~np.isnan(covariance[:, 0, 0])
    noise: Array = np.eye(3) * p.gnss_free_std**2
    if given.any() and p.use_message_covariance:
        noise = covariance[given].mean(axis=0)
    return _CleanedDvl(DvlColumns(seconds(stamps_ns, epoch_ns), velocity), noise, n_spikes)


def _imu(samples: ImuSamples, epoch_ns: int) -> ImuColumns:
    values = samples.values
    return ImuColumns(seconds(samples.stamps_ns, epoch_ns), values[:, :4], values[:, 4:7])


def _measured_velocity(samples: ReferenceSamples) -> Array:
    """Return velocities (J, 3) m/s with 0 along unmeasured axes."""
    if not samples.unmeasured.any():
        return samples.values[:, :3]
    return np.where((samples.unmeasured[:, None] & AXIS_BITS) == 0, samples.values[:, :3], 0.0)


def _reference(samples: ReferenceSamples, p: Parameters, epoch_ns: int) -> ReferenceColumns:
    """Return references in ENU or body axes, with the noise of their messages or the parameter's."""
    stamps_ns, values, frames, unmeasured = samples
    noise = values[:, 3:12].reshape(-1, 3, 3)
    given = ~np.isnan(noise[:, 0, 0]) & p.use_message_covariance
    noise = np.where(given[:, None, None], noise, np.eye(3) * p.gnss_aided_std**2)
    velocity, ned = _measured_velocity(samples), frames == _NED
    if unmeasured.any():
        axes = (unmeasured[:, None] & AXIS_BITS) != 0
        of_measured = np.where(axes[:, :, None] | axes[:, None, :], 0.0, noise)
        noise = of_measured + np.eye(3) * np.where(axes[:, :, None], NOT_MEASURED, 0.0)
    if ned.any():
        velocity = np.where(ned[:, None], velocity @ ENU_FROM_NED.T, velocity)
        noise = np.where(ned[:, None, None], ENU_FROM_NED @ noise @ ENU_FROM_NED.T, noise)
    return ReferenceColumns(seconds(stamps_ns, epoch_ns), velocity, noise, frames == _BODY, given)


def _own_references(block: Block) -> Index:
    """Return indices of the block's references without margins, thinned."""
    stamps_ns = block.reference.stamps_ns
    start, end = np.searchsorted(stamps_ns, (block.from_ns, block.end_ns)).tolist()
    return start + thinned(stamps_ns[start:end])


def is_slow(times: Array) -> bool:
    """Return whether samples at times (N,) s are so sparse that a vehicle turns between them."""
    if len(times) < 2:
        return False
    apart = steps(times)
    return float(apart.max()) > SLOW_S and float(median(apart)) > SLOW_S


def _good(stamps_ns: Stamps, velocity: Array) -> Mask:
    """Return which samples (N,) of a stream are no spikes, from stamps (N,) ns and velocities (N, 3) m/s."""
    smallest = LEAST_SCATTER_SLOW_MPS if is_slow(1e-9 * stamps_ns) else LEAST_SCATTER_MPS
    return without_spikes(velocity, smallest=smallest, also_at_ends=True)


def seconds(stamps_ns: Stamps, epoch_ns: int) -> Array:
    """Return times (N,) s since the epoch."""
    since: Array = (stamps_ns - epoch_ns) * 1e-9
    return since


MARGIN_NS = round(MARGIN_S * 1e9)


class DvlSamples(NamedTuple):
    """DVL stamps (N,), velocities (N, 3) m/s and covariances (N, 3, 3) (m/s)², nan if not given; DVL frame."""

    stamps_ns: Stamps
    velocity: Array
    covariance: Array


class ReferenceSamples(NamedTuple):
    """Reference stamps_ns (J,), values (J, 12), frames (J,) and unmeasured (J,), see `Track`."""

    stamps_ns: Stamps
    values: Array
    frames: Codes
    unmeasured: Codes

    def part(self, at: Index) -> ReferenceSamples:
        """Return the rows of some indices."""
        return ReferenceSamples(self.stamps_ns[at], self.values[at], self.frames[at], self.unmeasured[at])


class ImuSamples(NamedTuple):
    """IMU stamps_ns (M,) and values (M, 12), see `Track`."""

    stamps_ns: Stamps
    values: Array


class Block(NamedTuple):
    """Copies of all streams from MARGIN_NS before from_ns to MARGIN_NS after end_ns.

    new_days: number of days that begin with it. silent: whether the DVL then pauses so long that tracks drop earlier
    data.
    """

    from_ns: int
    end_ns: int
    new_days: int
    silent: bool
    dvl: DvlSamples
    reference: ReferenceSamples
    imu: ImuSamples
