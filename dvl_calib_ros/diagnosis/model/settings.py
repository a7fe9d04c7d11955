"""Thresholds of the diagnosis, with reasons."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DiagnosisSettings:
    """Thresholds. Times in s, rates in Hz, velocities in m/s, angles in rad.

    Reading: samples of a stream closer than 1 / max_stream_rate are averaged (effects lie below 1 Hz); a gap is longer
    than max_gap_intervals of a stream. own_rates_from: lowest rate of gyroscopes in use; at lower rates the derivative
    of the attitude is better.

    Comparing: the residual is averaged over bins_per_interval intervals of the rougher stream, so that interpolation
    errors near its Nyquist frequency do not resemble a delay. Bins are at least shortest_bin long and at most max_bins
    in number. max_points: number of samples of a stream; longer recordings are averaged.

    Finding: level: family-wise, of any effect.
    max_effects: largest number of effects.
    indistinguishable: deviance within which two explanations are equivalent: for a rival better by d, the odds are
      those of a normal variable beyond √d.
    robust_level: p under noise of any colour, of an effect by the scatter of blocks, and of each kind of regressor that
      a residual may follow by held-out data.

    outlying: robust standard deviations of an outlier. conclusive: deviance that leaves no doubt between two fits.

    Judging: block, folds: of hold-out. instead_of: deviance up to which an unknown cause may replace effects; a larger
    unknown cause would be significant without a test, and interpolation leaves more than noise of it. prior_angle,
    prior_scale: standard deviation of misalignment and scale. They hold insignificant parameters (roll, scale of
    sway), which would absorb a lever arm.
    """

    max_stream_rate: float = 10.0
    max_gap_intervals: float = 3.5
    own_rates_from: float = 4.0
    bins_per_interval: float = 2.0
    shortest_bin: float = 0.4
    max_bins: int = 12_000
    max_points: int = 60_000
    min_bins: int = 60
    min_seconds: float = 60.0
    level: float = 0.008
    max_effects: int = 4
    indistinguishable: float = 6.0
    robust_level: float = 0.0005
    block: float = 20.0
    folds: int = 5
    outlying: float = 6.0
    conclusive: float = 40.0
    instead_of: float = 1500.0
    prior_angle: float = 0.1
    prior_scale: float = 0.02


SETTINGS = DiagnosisSettings()
