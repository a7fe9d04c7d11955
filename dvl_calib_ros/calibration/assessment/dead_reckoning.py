"""Dead reckoning with and without the calibration, and reasons against a calibration.

Velocity errors add up to an error of position. Each sample is corrected by an estimate that has not seen its stretch,
with the lever arm and delay that it holds, so the drift is that of data to come; the reference's own noise is in it.
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
from ..checks.data_warnings import one_heading_warnings
from ..checks.heading_deviation import HeadingDeviation, heading_deviation, heading_warnings, severity_of
from ..checks.lever_arm_check import lever_arm_warnings
from ..checks.residual_tests import (
    ResidualTrend,
    is_insignificant,
    moving_bed,
    reference_lag_s,
    residual_trend,
    residual_warnings,
    std_along,
)
from ..models.parameters import Parameters
from ..numerics.frames import Array
from ..numerics.kalman import GaussianState
from ..numerics.robust import median
from ..numerics.samples import Index
from ..results.results import Estimate
from ..results.thinned_recording import NO_TERMS, Terms, ThinnedRecording
from ..streams.position_velocities import are_positions

# Lengths that drift is told over, m: the longest of which there are ENOUGH, else all there is as one.
STRETCHES_M = (1000.0, 500.0, 200.0, 100.0)
ENOUGH = 3
# What is shorter is no track.
SHORTEST_M = 20.0
# Where samples are further apart than this many of their usual intervals, and than this, s, nothing is known between.
GAP_INTERVALS, GAP_S = 5.0, 2.0
# By chance the drift over few stretches is not so many times larger with a calibration than without.
WORSE = 1.5
# Velocities fit clearly better where squares of their errors are so many times smaller, in the median.
FITS_BETTER = 0.5
# Samples that are compared in one go.
COMPARED_AT_ONCE = 2048
# Points of a track that are kept for a map.
POINTS = 1500
# Median of chi-square with one degree of freedom.
MEDIAN_SQUARE = 0.4549


@dataclass(frozen=True)
class Drift:
    """How far dead reckoning goes astray.

    per_km: m per km, rms over stretches. end: m, at the end of the whole track.
    """

    per_km: float
    end: float

    @property
    def percent(self) -> float:
        """Of the distance."""
        return 0.1 * self.per_km


@dataclass(frozen=True)
class Navigation:
    """Dead reckoning beside the reference.

    Parameters
    ----------
    distance_m, seconds
        Of the track, without gaps.
    stretch_m
        Length of the stretches that drift is told over; the whole distance if it is too short for several.
    stretches
        How many there are.
    before, after
        Drift as the DVL was mounted, and corrected by estimates that had not seen the data.
    noise_per_km
        Part of the drift that noise of reference and DVL, as the data show it, may be, m per km.
    on_a_map
        Whether headings are known, so that a track can be drawn: then east and north, else ahead and to port.
    stamps_ns, distances
        (P,) time, and m along the track, of the points kept.
    reference, track_before, track_after
        (P, 2) m from the start.
    error_before, error_after
        (P, 3) m/s, body axes: reference less the DVL's velocity; corrected by all that was found, arm and delay too.
    deviation
        By what the heading is off as it changes; None where that does not show.
    followed
        What the velocity that is left follows; None without attitude, or where there is too little.
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

    @property
    def speed(self) -> float:
        """m/s, mean over the track."""
        return self.distance_m / max(self.seconds, 1e-9)

    @property
    def fits_better(self) -> bool:
        """Whether velocities do, clearly and not by outliers: then the way went back on itself, which a wrong mounting
        cancels over, and noise that lasts does not."""
        if not len(self.error_before):
            return False
        before, after = (median((each**2).sum(axis=1)) for each in (self.error_before, self.error_after))
        return bool(after < FITS_BETTER * before)


def dead_reckoned(
    recording: ThinnedRecording,
    folds: NDArray[np.int64],
    terms: Sequence[Terms],
    parameters: Parameters,
    epoch_ns: int = 0,
    heading: GaussianState | None = None,
) -> Navigation | None:
    """The track by the DVL as mounted, and corrected.

    folds: (N,) of each DVL sample, which of `terms` corrects it. epoch_ns: what the recording's times count from.
    heading: as `Estimate.heading_deviation`. None without reference, or with hardly any motion.
    """
    if len(recording.dvl.times) < 2 or len(recording.reference.times) < 2:
        return None
    n = len(recording.dvl.times)
    before, after = _Level.of(n), _Level.of(n, whole=True)
    before.fill(recording, np.arange(n), NO_TERMS, parameters)
    for k, each in enumerate(terms):
        after.fill(recording, np.flatnonzero(folds == k), each, parameters)
    known = np.isfinite(before.error[:, 0]) & np.isfinite(after.error[:, 0])
    on_a_map = bool(known.any() and (before.oriented & after.oriented)[known].all())
    use = np.flatnonzero(known)
    step_s = _steps(recording.dvl.times[use])
    axes = slice(2, 4) if on_a_map else slice(0, 2)
    velocity = before.velocity[use, axes]
    along = np.cumsum(np.linalg.norm(velocity, axis=1) * step_s)
    if not len(along) or along[-1] < SHORTEST_M:
        return None
    errors = [each.error[use, axes] for each in (before, after)]
    astray = [np.cumsum(error * step_s[:, None], axis=0) for error in errors]
    ends = ends_of_stretches(along)
    kept = np.round(np.linspace(0, len(use) - 1, min(POINTS, len(use)))).astype(np.intp)
    reference = np.cumsum(velocity * step_s[:, None], axis=0)
    return Navigation(
        distance_m=float(along[-1]),
        seconds=float(step_s.sum()),
        stretch_m=float(along[-1] if len(ends) == 2 else along[ends[1]] - along[ends[0]]),
        stretches=len(ends) - 1,
        before=drift_over(astray[0], along, ends),
        after=drift_over(astray[1], along, ends),
        noise_per_km=_noise(errors[1], step_s, along, ends),
        on_a_map=on_a_map,
        stamps_ns=np.round(recording.dvl.times[use[kept]] * 1e9).astype(np.int64) + epoch_ns,
        distances=along[kept],
        reference=reference[kept],
        track_before=(reference - astray[0])[kept],
        track_after=(reference - astray[1])[kept],
        error_before=before.in_body[use[kept]],
        error_after=after.in_body[use[kept]],
        deviation=heading_deviation(recording.dvl.times[use], after.yaw[use], heading)
        if on_a_map and heading is not None
        else None,
        followed=_followed(recording, after, use) if on_a_map else None,
    )


class _Level(NamedTuple):
    """Of N samples (N, 4) m/s ahead and to port, and east and north where that is known: reference velocity, and error
    of the DVL's; whether that is known (N,), and yaw (N,) rad. in_body: error (N, 3) m/s. whole, where that is
    wanted: rotation_enu_from_body (N, 3, 3), velocity and error (N, 3) m/s, rates (N, 3) rad/s, body."""

    velocity: Array
    error: Array
    oriented: NDArray[np.bool_]
    yaw: Array
    in_body: Array
    whole: tuple[Array, ...]

    @staticmethod
    def of(n: int, *, whole: bool = False) -> _Level:
        """To be filled."""
        error = np.empty((n, 3))
        kept = (np.empty((n, 3, 3)), np.empty((n, 3)), error, np.empty((n, 3))) if whole else ()
        return _Level(np.empty((n, 4)), np.empty((n, 4)), np.empty(n, dtype=bool), np.empty(n), error, kept)

    def fill(self, recording: ThinnedRecording, at: Index, terms: Terms, parameters: Parameters) -> None:
        """Write those of some samples, corrected by these terms."""
        # on the way to them is twenty times as much
        for start in range(0, len(at), COMPARED_AT_ONCE):
            some = at[start : start + COMPARED_AT_ONCE]
            seen = recording.compared(some, terms, parameters)
            self.oriented[some] = seen.oriented
            rotation = seen.rotation_enu_from_body
            self.yaw[some] = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
            self.in_body[some] = seen.error
            for kept, own in zip(self.whole, (rotation, seen.body, seen.error, seen.rates), strict=False):
                kept[some] = own
            for level, body in ((self.velocity, seen.body), (self.error, seen.error)):
                level[some, :2] = body[:, :2]
                level[some, 2:] = np.matmul(seen.rotation_enu_from_body, body[..., None])[:, :2, 0]


def _followed(recording: ThinnedRecording, after: _Level, use: Index) -> ResidualTrend | None:
    """As of `residual_trend`, of the samples that are used."""
    rotation, velocity, error, rates = (each[use] for each in after.whole)
    interval_s = float(median(np.diff(recording.reference.times)))
    return residual_trend(recording.dvl.times[use], rotation, velocity, error, rates, interval_s)


def _steps(times: Array) -> Array:
    """Time (N,) s that each sample stands for: since the one before, 0 after a gap."""
    interval = np.diff(times, prepend=times[:1])
    if len(interval) < 2:
        return np.zeros(len(times))
    usual = float(median(interval[1:]))
    return np.where(interval > max(GAP_S, GAP_INTERVALS * usual), 0.0, np.maximum(interval, 0.0))


def ends_of_stretches(along: Array) -> Index:
    """Where stretches end (S + 1,), beginning with 0: of the longest length that there are enough of."""
    for length in STRETCHES_M:
        n = int(along[-1] // length)
        if n >= ENOUGH:
            return np.asarray(np.searchsorted(along, length * np.arange(n + 1)).clip(0, len(along) - 1))
    return np.array([0, len(along) - 1])


def drift_over(astray: Array, along: Array, ends: Index) -> Drift:
    """Of a track that leads astray (N, 2) m, at N distances along it (m), over the stretches between ends (S + 1,)."""
    off = np.linalg.norm(np.diff(astray[ends], axis=0), axis=1)
    share = off / np.maximum(np.diff(along[ends]), 1e-9)
    return Drift(1000.0 * math.sqrt(float(np.mean(share**2))), float(np.linalg.norm(astray[-1])))


def _noise(errors: Array, step_s: Array, along: Array, ends: Index) -> float:
    """What white noise of these errors (K, 2) makes of drift, m per km, rms over stretches.

    Its size is that of differences of neighbours, which nothing slow is in.
    """
    if len(errors) < 3:
        return 0.0
    variance = median(np.diff(errors, axis=0) ** 2).sum() / (2.0 * MEDIAN_SQUARE)
    squares = np.concatenate([[0.0], np.cumsum(step_s[1:] ** 2)])
    share = variance * np.diff(squares[ends]) / np.maximum(np.diff(along[ends]), 1e-9) ** 2
    return 1000.0 * math.sqrt(float(np.mean(share)))


def navigation_document(navigation: Navigation | None) -> dict[str, Any] | None:
    """Figures for `--json`."""
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


def objections(navigation: Navigation | None, known_to: float = 0.0) -> list[Reason]:
    """What the drift says against a calibration: velocities may fit better and the track worse.

    known_to: m per km (σ) that the estimate leaves open; what is worse by no more contradicts nothing.
    """
    if navigation is None or navigation.stretches < ENOUGH:
        return []
    before, after, noise = navigation.before.per_km, navigation.after.per_km, navigation.noise_per_km
    if after < WORSE * before or after**2 - before**2 < (2.0 * noise) ** 2:
        if float(metres(after)) <= float(metres(before)):
            return []
        return [finding("DRIFT_NO_BETTER", after=after, before=before)]
    worse = finding("DRIFT_WORSE", after=after, before=before)
    is_open = after**2 - before**2 < (2.0 * known_to) ** 2
    return [worse.weighed(Severity.MARGINAL) if navigation.fits_better or is_open else worse]


def in_words(navigation: Navigation) -> list[str]:
    """What there is to say of it, a sentence each."""
    n, before, after = navigation, navigation.before, navigation.after
    over = f"over stretches of {n.stretch_m:.0f} m" if n.stretches > 1 else f"over {n.distance_m:.0f} m"
    said = [
        f"Dead reckoning on data held out, {over}: {metres(before.per_km)} m of drift per km as mounted "
        f"({before.percent:.2g} % of distance), {metres(after.per_km)} m corrected ({after.percent:.2g} %). "
        f"Noise of reference and DVL alone may make {metres(n.noise_per_km)} m."
    ]
    said.append(
        f"After {n.distance_m:.0f} m it is {metres(before.end)} m off as mounted, {metres(after.end)} m corrected"
        + ("." if n.on_a_map else "; without headings, as on one course.")
    )
    return said


def metres(value: float) -> str:
    """A distance, m, with as many digits as people read."""
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
    """Each as bad as it is to a verdict; a warning is nothing to that, but worth saying.

    Parameters
    ----------
    estimate: Of the selected model.
    finders: Estimates that hold what the data show of the lever arm, the best first; others do not matter.
    navigation: What is left with the selected model, on data held out; None where that is not known.
    parameters: What was told.
    suggested: Whether another configuration fits, which would be why the arm is another.
    in_earth: Whether the reference is in an earth frame.
    is_level: Whether the IMU knows the heading alone, see `IMU_LEVEL`.
    """
    found = [finding("IMU_LEVEL")] if is_level else []
    if not suggested:
        found += [each.weighed(Severity.MARGINAL) for each in lever_arm_warnings(finders, parameters)]
    if navigation is None:
        return found
    bed = moving_bed(navigation.followed, estimate)
    if bed is not None:  # which looks like a heading error, and like one of the reference
        found.append(bed)
    elif navigation.deviation is not None:
        found.append(heading_warnings(navigation.deviation).weighed(severity_of(navigation.deviation, estimate)))
    if in_earth and bed is None:
        found += one_heading_warnings(estimate, parameters, navigation.speed)
    return found + residual_warnings(
        navigation.followed,
        are_positions(parameters),
        reference_lag_s(estimate, parameters),
        is_insignificant(estimate),
        std_along(estimate, parameters),
    )
