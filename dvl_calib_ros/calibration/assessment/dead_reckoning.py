"""Dead reckoning with and without the calibration, and reasons against a calibration.

Integrated velocity errors give the position error. Each sample is corrected by an estimate that has not seen its
stretch, including lever arm and delay, so the drift predicts later data. It includes the reference's noise.

Shapes: N samples, K of them in the track, P points kept for the map.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...verdict.kinds import Severity
from ...verdict.reasons import Reason, finding
from ..checks.beam_faults import BeamFault
from ..checks.data_warnings import one_heading_warnings
from ..checks.heading_deviation import HeadingDeviation, heading_deviation, heading_warning
from ..checks.lever_arm_check import lever_arm_warnings
from ..checks.residual_tests import ResidualTrend, confused_with_bias_std, moving_bed, residual_trend, residual_warnings
from ..filters.observability import KM
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.robust import MEDIAN_SQUARE, median
from ..numerics.samples import Index
from ..results.held_out_verification import ACCEPTED_DRIFT
from ..results.results import Estimate
from ..results.thinned_recording import NO_TERMS, Terms, ThinnedRecording
from ..streams.interpolation import GAP_S
from ..streams.position_velocities import are_positions

# Stretch lengths for the drift, m: the longest with MIN_STRETCHES stretches, else the whole track.
STRETCHES_M = (1000.0, 500.0, 200.0, 100.0)
MIN_STRETCHES = 3
# Shortest track, m.
SHORTEST_M = 20.0
# Longest interval that is integrated, in usual ones; at least `GAP_S`.
GAP_INTERVALS = 5.0
# Ratio of drift with and without calibration that few stretches rarely exceed by noise.
WORSE_RATIO = 1.5
# Samples compared together, which limits memory.
COMPARED_AT_ONCE = 2048
# Points of a track that are kept for a map.
MAP_POINTS = 1500


@dataclass(frozen=True)
class Drift:
    """Drift of dead reckoning. per_km: m per km, rms over stretches. end: m, at the end of the track."""

    per_km: float
    end: float

    @property
    def percent(self) -> float:
        """Drift in per cent of the distance."""
        return 0.1 * self.per_km


class SlowNoise(NamedTuple):
    """Slow errors of reference and attitude, first-order Gauss-Markov (σ).

    velocity: m/s, per horizontal axis.
    heading: rad.
    memory_s: time constant, s.
    """

    velocity: float
    heading: float
    memory_s: float

    def squares(self, seconds: Array, metres: Array) -> Array:
        """Return the mean square of the drift (K,) m² over stretches of these durations (K,) s and lengths (K,) m."""
        ratio = seconds / self.memory_s
        growth = 2.0 * self.memory_s**2 * (ratio - 1.0 + np.exp(-ratio))
        speed = metres / np.maximum(seconds, 1e-9)
        return np.asarray((2.0 * self.velocity**2 + (self.heading * speed) ** 2) * growth)


@dataclass(frozen=True)
class Navigation:
    """Dead reckoning compared with the reference.

    Parameters
    ----------
    distance_m, seconds
        Of the track, without gaps.
    stretch_m
        Length of the stretches for the drift; the whole distance of a short track.
    stretches
        Number of stretches.
    before, after
        Drift with the nominal mounting, and corrected by estimates that had not seen the data.
    noise_per_km
        Drift that noise of reference, attitude and DVL may cause, m per km, white and slow as estimated.
    on_a_map
        Whether headings are known: then positions are east and north, else forward and to port.
    stamps_ns, distances
        (P,) stamps, and m along the track, of the points kept.
    reference, track_before, track_after
        (P, 2) m from the start.
    error_before, error_after
        (P, 3) m/s, body axes: reference minus DVL velocity; after with all corrections, lever arm and delay included.
    deviation
        Heading deviation; None if not significant.
    followed
        Signals that the residual velocity follows; None without attitude, or for too little data.
    bias
        Bias x (3,) m/s, P (3, 3) of the DVL, body axes; None if not estimated.
    beam
        Most significant fault of one beam; None if not tested.
    """

    distance_m: float
    seconds: float
    stretch_m: float
    stretches: int
    before: Drift
    after: Drift
    noise_per_km: float
    on_a_map: bool
    stamps_ns: NDArray[np.int64]
    distances: Array
    reference: Array
    track_before: Array
    track_after: Array
    error_before: Array
    error_after: Array
    deviation: HeadingDeviation | None = None
    followed: ResidualTrend | None = None
    bias: GaussianState | None = None
    beam: BeamFault | None = None

    @property
    def speed(self) -> float:
        """Mean speed, m/s."""
        return self.distance_m / max(self.seconds, 1e-9)


def dead_reckoned(
    recording: ThinnedRecording,
    folds: NDArray[np.int64],
    terms: Sequence[Terms],
    parameters: Parameters,
    epoch_ns: int = 0,
    heading: GaussianState | None = None,
    slow: SlowNoise | None = None,
    bias: GaussianState | None = None,
    beam: BeamFault | None = None,
) -> Navigation | None:
    """Compare the track of the DVL, uncorrected and corrected, with the reference; None without reference or motion.

    folds: (N,) index into `terms` of each DVL sample's correction.
    epoch_ns: stamp of the recording's time 0.
    heading: see `Estimate.heading_deviation`.
    slow, bias (DVL axes), beam: None if not estimated.
    """
    if len(recording.dvl.times) < 2 or len(recording.reference.times) < 2:
        return None
    n = len(recording.dvl.times)
    before, after = _ErrorTable.of(n), _ErrorTable.of(n, whole=True)
    before.fill(recording, np.arange(n), NO_TERMS, parameters)
    for k, terms_of_fold in enumerate(terms):
        after.fill(recording, np.flatnonzero(folds == k), terms_of_fold, parameters)
    known = np.isfinite(before.error[:, 0]) & np.isfinite(after.error[:, 0])
    on_a_map = bool(known.any() and (before.oriented & after.oriented)[known].all())
    used = np.flatnonzero(known)
    step_s = integration_steps(recording.dvl.times[used])
    axes = slice(2, 4) if on_a_map else slice(0, 2)
    velocity = before.velocity[used, axes]
    distance = np.cumsum(np.linalg.norm(velocity, axis=1) * step_s)
    if not len(distance) or distance[-1] < SHORTEST_M:
        return None
    errors = [before.error[used, axes], after.error[used, axes]]
    track_errors = [np.cumsum(error * step_s[:, None], axis=0) for error in errors]
    if slow is not None and recording.reference.in_body.all():
        slow = slow._replace(heading=0.0)  # body velocities need no heading
    ends = ends_of_stretches(distance)
    shown = np.round(np.linspace(0, len(used) - 1, min(MAP_POINTS, len(used)))).astype(np.intp)
    reference = np.cumsum(velocity * step_s[:, None], axis=0)
    return Navigation(
        distance_m=float(distance[-1]),
        seconds=float(step_s.sum()),
        stretch_m=float(distance[-1] if len(ends) == 2 else distance[ends[1]] - distance[ends[0]]),
        stretches=len(ends) - 1,
        before=drift_over(track_errors[0], distance, ends),
        after=drift_over(track_errors[1], distance, ends),
        noise_per_km=_noise(errors[1], step_s, distance, ends, slow),
        on_a_map=on_a_map,
        stamps_ns=np.round(recording.dvl.times[used[shown]] * 1e9).astype(np.int64) + epoch_ns,
        distances=distance[shown],
        reference=reference[shown],
        track_before=(reference - track_errors[0])[shown],
        track_after=(reference - track_errors[1])[shown],
        error_before=before.in_body[used[shown]],
        error_after=after.in_body[used[shown]],
        deviation=heading_deviation(after.yaw[used], heading) if on_a_map and heading is not None else None,
        followed=_followed(recording, after, used, parameters) if on_a_map else None,
        bias=None if bias is None else _in_body(bias, parameters.rotation_dvl_from_body),
        beam=beam,
    )


def _in_body(bias: GaussianState, rotation_dvl_from_body: Array) -> GaussianState:
    """Rotate a velocity x (3,) m/s, P (3, 3) from the DVL's axes to the body's."""
    return GaussianState(bias.x @ rotation_dvl_from_body, rotation_dvl_from_body.T @ bias.p @ rotation_dvl_from_body)


class _ErrorTable(NamedTuple):
    """Reference velocity and DVL error of N samples.

    velocity, error: (N, 4) m/s, forward, port, east, north, the latter two where oriented (N,).
    yaw: (N,) rad.
    in_body: (N, 3) m/s, error.
    whole: if requested, rotation_enu_from_body (N, 3, 3), velocity and error (N, 3) m/s, rates (N, 3) rad/s, body axes.
    """

    velocity: Array
    error: Array
    oriented: NDArray[np.bool_]
    yaw: Array
    in_body: Array
    whole: tuple[Array, ...]

    @staticmethod
    def of(n: int, *, whole: bool = False) -> _ErrorTable:
        """Return an empty table of n samples."""
        error = np.empty((n, 3))
        kept = (np.empty((n, 3, 3)), np.empty((n, 3)), error, np.empty((n, 3))) if whole else ()
        return _ErrorTable(np.empty((n, 4)), np.empty((n, 4)), np.empty(n, dtype=bool), np.empty(n), error, kept)

    def fill(self, recording: ThinnedRecording, rows: Index, terms: Terms, parameters: Parameters) -> None:
        """Fill in some samples, corrected by these terms."""
        # intermediate arrays take twenty times the memory
        for start in range(0, len(rows), COMPARED_AT_ONCE):
            part = rows[start : start + COMPARED_AT_ONCE]
            data = recording.compared(part, terms, parameters)
            self.oriented[part] = data.oriented
            rotation = data.rotation_enu_from_body
            self.yaw[part] = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
            self.in_body[part] = data.error
            for table, column in zip(self.whole, (rotation, data.body, data.error, data.rates), strict=False):
                table[part] = column
            for columns, body in ((self.velocity, data.body), (self.error, data.error)):
                columns[part, :2] = body[:, :2]
                columns[part, 2:] = np.matmul(data.rotation_enu_from_body, body[..., None])[:, :2, 0]


def _followed(recording: ThinnedRecording, after: _ErrorTable, use: Index, p: Parameters) -> ResidualTrend | None:
    """Return `residual_trend` of the samples in use; None without turn rates, as lever arms then look like signals."""
    rotation, velocity, error, rates = (column[use] for column in after.whole)
    if np.isnan(rates).any():
        return None
    interval_s = float(median(np.diff(recording.reference.times)))
    return residual_trend(recording.dvl.times[use], rotation, velocity, error, rates, interval_s)


def integration_steps(times: Array) -> Array:
    """Return the time (N,) s since the previous sample; 0 after a gap, and where a recording follows another."""
    interval = np.diff(times, prepend=times[:1])
    if len(interval) < 2:
        return np.zeros(len(times))
    typical = float(median(interval[1:]))
    return np.where(interval > max(GAP_S, GAP_INTERVALS * typical), 0.0, np.maximum(interval, 0.0))


def ends_of_stretches(distance: Array) -> Index:
    """Return indices (S + 1,) of the limits of stretches, for the longest length with enough stretches."""
    for length in STRETCHES_M:
        n = int(distance[-1] // length)
        if n >= MIN_STRETCHES:
            return np.asarray(np.searchsorted(distance, length * np.arange(n + 1)).clip(0, len(distance) - 1))
    return np.array([0, len(distance) - 1])


def drift_over(error_of_track: Array, distance: Array, ends: Index) -> Drift:
    """Return the drift from track errors (N, 2) m at distances (N,) m, over the stretches between ends (S + 1,)."""
    error_m = np.linalg.norm(np.diff(error_of_track[ends], axis=0), axis=1)
    share = error_m / np.maximum(np.diff(distance[ends]), 1e-9)
    return Drift(1000.0 * math.sqrt(float(np.mean(share**2))), float(np.linalg.norm(error_of_track[-1])))


def _noise(errors: Array, step_s: Array, distance: Array, ends: Index, slow: SlowNoise | None) -> float:
    """Return the drift by white and slow noise, m per km, rms over stretches.

    errors: (K, 2) m/s; differences of neighbours give the white noise.
    step_s: (K,) s.
    distance: (K,) m driven.
    ends: (S + 1,) indices of the ends of stretches.
    """
    if len(errors) < 3:
        return 0.0
    variance = median(np.diff(errors, axis=0) ** 2).sum() / (2.0 * MEDIAN_SQUARE)
    squares = np.concatenate([[0.0], np.cumsum(step_s[1:] ** 2)])
    metres = np.maximum(np.diff(distance[ends]), 1e-9)
    variances = variance * np.diff(squares[ends])
    if slow is not None:
        variances = variances + slow.squares(np.diff(np.cumsum(step_s)[ends]), metres)
    share = variances / metres**2
    return 1000.0 * math.sqrt(float(np.mean(share)))


def navigation_document(navigation: Navigation | None) -> dict[str, Any] | None:
    """Return plain data for `--json`."""
    if navigation is None:
        return None
    return {
        "distance_m": navigation.distance_m,
        "seconds": navigation.seconds,
        "stretch_m": navigation.stretch_m,
        "stretches": navigation.stretches,
        "drift_m_per_km": {"before": navigation.before.per_km, "after": navigation.after.per_km},
        "end_error_m": {"before": navigation.before.end, "after": navigation.after.end},
        "noise_m_per_km": navigation.noise_per_km,
    }


def objections(navigation: Navigation | None, predicted_drift: float = 0.0) -> list[Reason]:
    """Return the reasons against a calibration by its drift, which may grow although velocities fit better.

    predicted_drift: predicted drift, m per km (σ); an increase within it is only marginal.
    """
    if navigation is None or navigation.stretches < MIN_STRETCHES:
        return []
    before, after, noise = navigation.before.per_km, navigation.after.per_km, navigation.noise_per_km
    if after < WORSE_RATIO * before or after**2 - before**2 < (2.0 * noise) ** 2:
        if float(metres(after)) <= float(metres(before)):
            return []
        return [finding("DRIFT_NO_BETTER", after=after, before=before)]
    reason = finding("DRIFT_WORSE", after=after, before=before)
    is_within_prediction = after**2 - before**2 < (2.0 * predicted_drift) ** 2
    return [reason.weighed(Severity.MARGINAL) if is_within_prediction else reason]


def in_words(navigation: Navigation) -> list[str]:
    """Return sentences that describe the drift."""
    before, after = navigation.before, navigation.after
    is_whole = navigation.stretches == 1
    over = f"over {navigation.distance_m:.0f} m" if is_whole else f"over stretches of {navigation.stretch_m:.0f} m"
    end = "." if navigation.on_a_map else "; headings are unknown, so one course is assumed."
    return [
        f"Dead reckoning on data held out, {over}: {metres(before.per_km)} m of drift per km as mounted "
        f"({before.percent:.2g} % of distance), {metres(after.per_km)} m corrected ({after.percent:.2g} %). "
        f"Noise of reference, attitude and DVL alone may make {metres(navigation.noise_per_km)} m.",
        f"After {navigation.distance_m:.0f} m the track is {metres(before.end)} m off as mounted, "
        f"{metres(after.end)} m corrected{end}",
    ]


def metres(value: float) -> str:
    """Format a distance (m) with a sensible number of digits."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.1f}"


def doubts(
    estimate: Estimate,
    finders: Iterable[Estimate],
    navigation: Navigation | None,
    parameters: Parameters,
    *,
    suggested: bool,
    in_earth: bool,
    is_level: bool,
) -> list[Reason]:
    """Return the reasons against a calibration, weighed by their effect on the verdict; warnings have none.

    Parameters
    ----------
    estimate: Of the selected model.
    finders: Estimates of the lever arm, the best first.
    navigation: Held-out drift with the selected model; None if not available.
    parameters: The configuration.
    suggested: Whether another configuration fits, which would explain a different lever arm and a beam.
    in_earth: Whether the reference is in an earth frame.
    is_level: Whether the IMU gives a heading only, see `IMU_LEVEL`.
    """
    reasons = [finding("IMU_LEVEL")] if is_level else []
    if not suggested:
        reasons += [reason.weighed(Severity.MARGINAL) for reason in lever_arm_warnings(finders, parameters)]
    if navigation is None:
        return reasons
    bed_reason = moving_bed(navigation.followed, estimate)
    if bed_reason is not None:  # a moving bed looks like a heading error, and like a reference error
        reasons.append(bed_reason)
    elif navigation.deviation is not None:
        reasons.append(heading_warning(navigation.deviation))
    if in_earth and bed_reason is None:
        reasons += one_heading_warnings(estimate, parameters, navigation.speed)
    return reasons + residual_warnings(
        navigation.followed,
        are_positions(parameters),
        confused_with_bias_std(estimate, parameters),
        navigation.bias,
        None if suggested else navigation.beam,
        ACCEPTED_DRIFT * parameters.target_drift / KM,
        float(estimate.state[:3] @ estimate.state[:3]),
    )
