"""Verification of `full`: velocity error on held-out samples, with lever arm and delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..models.own import DELAY, LEVER_ARM, REFERENCE_DELAY
from ..models.parameters import Parameters
from ..numerics.error_model import correction_matrix
from ..numerics.frames import Array, cross
from ..numerics.robust import median, steps
from ..numerics.samples import Index, Mask, Stamps
from ..streams.interpolation import DvlColumns, ImuColumns, ReferenceColumns, attitude_at, linear_at

# Shortest interval of thinned samples, s: five per second suffice for a velocity error.
KEPT_EVERY_S = 0.19
# Size of an outlier in root median squared errors.
OUTLIER_RATIO = 5.0
# Variance of an axis that is not measured, and the limit below which an axis is measured, (m/s)²
NOT_MEASURED, MEASURED_BELOW = 1e6, 1e4


class ThinnedBlock(NamedTuple):
    """Thinned columns of one block, for verification; times in s since an epoch."""

    dvl: DvlColumns
    noise_dvl: Array
    reference: ReferenceColumns
    imu: ImuColumns

    def __deepcopy__(self, _: object) -> ThinnedBlock:
        """Return the block itself, which nobody changes."""
        return self

    @staticmethod
    def between(
        from_s: float, to_s: float, dvl: DvlColumns, noise_dvl: Array, reference: ReferenceColumns, imu: ImuColumns
    ) -> ThinnedBlock:
        """Return the thinned columns of a block. noise_dvl: (3, 3) (m/s)²."""
        first, last = np.searchsorted(dvl.times, (from_s, to_s)).tolist()
        dvl_rows = first + _thinned_seconds(dvl.times[first:last])
        thinned_dvl = DvlColumns(dvl.times[dvl_rows], dvl.velocity[dvl_rows].copy())
        first, last = np.searchsorted(imu.times, (from_s, to_s)).tolist()
        imu_rows = first + _thinned_seconds(imu.times[first:last])
        # rates are averaged: the noise of one sample exceeds the change until the next kept one
        reach = 0.5 * KEPT_EVERY_S
        first, last = np.searchsorted(imu.times, (from_s - 2.0 * reach, to_s + 2.0 * reach)).tolist()
        rates = mean_around(imu.times[first:last], imu.angular_velocity[first:last], imu.times[imu_rows], reach)
        thinned_imu = ImuColumns(imu.times[imu_rows], imu.orientation[imu_rows], rates)
        # copies, because views would keep the whole arrays in memory
        return ThinnedBlock(thinned_dvl, noise_dvl, reference._replace(velocity=reference.velocity.copy()), thinned_imu)


def typical_error(recording: ThinnedRecording, terms: Terms, p: Parameters) -> float | None:
    """Return the velocity error with these terms, m/s rms, without outliers; None if nothing is compared."""
    return without_outliers(recording.compared(np.arange(len(recording.dvl.times)), terms, p).error)


def without_outliers(error: Array) -> float | None:
    """Return the RMS of errors (N, 3) m/s without outliers; None if all are nan."""
    square = (error[np.isfinite(error[:, 0])] ** 2).sum(axis=1)
    if not len(square):
        return None
    inliers = square[square <= OUTLIER_RATIO**2 * median(square)]
    return math.sqrt(float(inliers.mean()))


class Terms(NamedTuple):
    """Corrections beyond the configured ones: errors (6,) φ rad and δk, lever_arm (3,) m, delays s."""

    errors: Array
    lever_arm: Array
    time_offset: float
    reference_time_offset: float = 0.0

    @staticmethod
    def of_state(state: Array) -> Terms:
        """Return the terms of a state (n,) of `full`."""
        return Terms(np.array([*state[:5], 0.0]), state[LEVER_ARM], float(state[DELAY]), float(state[REFERENCE_DELAY]))


NO_TERMS = Terms(np.zeros(6), np.zeros(3), 0.0)


class Compared(NamedTuple):
    """Comparison of N DVL samples with the reference.

    error (N, 3): reference minus corrected DVL, body, m/s; nan without reference, 0 along unmeasured axes.
    measured (N, 3, 3): projection on the measured axes, body.
    body (N, 3): reference velocity.
    rotation_enu_from_body (N, 3, 3), oriented (N,): its validity.
    rates (N, 3): rad/s.
    """

    error: Array
    measured: Array
    body: Array
    rotation_enu_from_body: Array
    oriented: Mask
    rates: Array


class ThinnedRecording(NamedTuple):
    """All thinned samples, times in s since an epoch."""

    dvl: DvlColumns
    noise_dvl: Array
    reference: ReferenceColumns
    imu: ImuColumns

    @staticmethod
    def of(blocks: Sequence[ThinnedBlock]) -> ThinnedRecording:
        """Return the joined blocks."""
        dvl = DvlColumns(*(np.concatenate(column) for column in zip(*(block.dvl for block in blocks), strict=True)))
        noise = np.concatenate([np.full(len(block.dvl.times), np.trace(block.noise_dvl)) for block in blocks])
        reference = zip(*(block.reference for block in blocks), strict=True)
        imu = zip(*(block.imu for block in blocks), strict=True)
        return ThinnedRecording(
            dvl, noise, ReferenceColumns(*map(np.concatenate, reference)), ImuColumns(*map(np.concatenate, imu))
        )

    def judged(self, p: Parameters) -> tuple[float, Array]:
        """Return the first two sums of `Moments` over all comparable samples."""
        comparison = self.compared(np.arange(len(self.dvl.times)), NO_TERMS, p)
        use = np.isfinite(comparison.error[:, 0])
        v, is_measured = (self.dvl.velocity[use], np.diagonal(comparison.measured[use], axis1=1, axis2=2) > 0.5)
        return float(np.count_nonzero(use)), np.einsum("nk,ni,nj->kij", is_measured, v, v)

    def compared(self, rows: Index, terms: Terms, p: Parameters) -> Compared:
        """Return the comparison of DVL samples, corrected and interpolated as in pairing."""
        times, velocity = self.dvl.times[rows] - terms.time_offset, self.dvl.velocity[rows]
        stamps = self.reference.times - terms.reference_time_offset
        after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        gap = stamps[after] - stamps[after - 1]
        fraction = ((times - stamps[after - 1]) / gap)[:, None]
        before, later = self.reference.velocity[after - 1], self.reference.velocity[after]
        in_body = self.reference.in_body[after]
        rotation, oriented = attitude_at(self.imu, times, p.imu_timeout)
        body_from_reference = np.where(in_body[:, None, None], np.eye(3), rotation.swapaxes(1, 2))
        body = np.matmul(body_from_reference, (before + (later - before) * fraction)[..., None])[..., 0]
        rates = np.zeros_like(velocity)
        if len(self.imu.times):
            rates = linear_at(self.imu.times, self.imu.angular_velocity, times)
        arm = np.array(p.lever_arm) + terms.lever_arm
        matrix = correction_matrix(terms.errors[:3], terms.errors[3:], p.rotation_dvl_from_body)
        error = body + (cross(rates, arm) if arm.any() else 0.0) - velocity @ matrix.T
        is_comparable = (times >= stamps[0]) & (times <= stamps[-1]) & (gap <= p.gnss_timeout) & (oriented | in_body)
        is_comparable &= (velocity**2).sum(axis=1) >= p.min_speed**2
        # unmeasured axes are removed in the frame of the reference: at a tilt of 2° an unmeasured vertical would reach
        # the horizontal of the body
        variance = np.diagonal(self.reference.noise, axis1=1, axis2=2)
        axes = (np.maximum(variance[after], variance[after - 1]) < MEASURED_BELOW).astype(float)
        measured = (body_from_reference * axes[:, None]) @ body_from_reference.swapaxes(1, 2)
        error = np.matmul(measured, error[..., None])[..., 0]
        error[~is_comparable] = np.nan
        return Compared(error, measured, body, rotation, oriented, rates)


def thinned(stamps_ns: Stamps) -> Index:
    """Return indices of increasing stamps at intervals of about KEPT_EVERY_S or more."""
    return _thinned_seconds((stamps_ns - stamps_ns[0]) * 1e-9 if len(stamps_ns) else np.zeros(0))


def _thinned_seconds(times: Array) -> Index:
    """Return indices of times (N,) s about `KEPT_EVERY_S` apart."""
    if len(times) < 2 or steps(times).min() >= KEPT_EVERY_S:
        return np.arange(len(times))
    bins = np.floor(times / KEPT_EVERY_S)
    return np.append(0, np.flatnonzero(steps(bins)) + 1)


def mean_around(times: Array, values: Array, centres: Array, reach: float) -> Array:
    """Return means (M, c) of finite values (N, c) within reach (s) of times (M,) s; nan where there is none."""
    first, end = times.searchsorted(centres - reach), times.searchsorted(centres + reach, side="right")
    sums, finite = np.zeros((len(times) + 1, values.shape[1])), np.isfinite(values)
    if finite.all():
        np.cumsum(values, axis=0, out=sums[1:])
        number = (end - first)[:, None]
    else:
        np.cumsum(np.where(finite, values, 0.0), axis=0, out=sums[1:])
        counts = np.pad(np.cumsum(finite, axis=0), ((1, 0), (0, 0)))
        number = counts[end] - counts[first]
    return np.where(number > 0, (sums[end] - sums[first]) / np.maximum(number, 1), np.nan)
