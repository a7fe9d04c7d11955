"""Every threshold of the diagnosis, with its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DiagnosisSettings:
    """Thresholds. Times in s, rates in Hz, velocities in m/s, angles in rad.

    Reading: samples of a stream closer than 1 / max_stream_rate are averaged (what the effects do lies below 1 Hz);
    across max_gap_intervals of a stream nothing is known of it. own_rates_from: angular velocities of an IMU at least
    so fast are its own; a slower one says more by the curve of its attitude. unmeasured_std: a standard deviation from
    which on an axis counts as not measured (drivers write 1e3 (m/s)² and more).

    Comparing: the residual is averaged over bins_per_interval intervals of the slower stream, so that what is lost and
    gained near its Nyquist frequency by interpolation at one phase or another does not look like a delay; over
    shortest_bin at least, and so that no more than max_bins are left. max_points: of a stream, to which a long
    recording is averaged.

    Finding: level: family-wise, of the claim that
    there is an effect. max_effects: named at most. ghost_share: of what is explained already that a further effect
    must add; less is what the inexactness of a strong one leaves, unless it is all that is left, or an arm, a clock or
    a lag and more than ghost_of_noise of the noise's deviance. indistinguishable: deviance within which two
    explanations are one answer: with truth j and a rival that looks better by d, the odds are those of a normal
    variable beyond √d. robust_level: p of an effect by the scatter of its blocks, a test with few degrees of freedom
    that no colour of the noise upsets.

    Judging: block, folds: of hold-out. noise_tolerance: so many standard errors may the noise of all frequencies lie
    above that of the high ones. instead_of: deviance of effects that an unknown cause may stand in for; more would show
    without a test, and what a curve between samples leaves of it is more than noise. instead_share: of that, by which
    it must explain more.
    prior_angle, prior_scale: standard deviation of misalignment and scale, held so where the data says little (roll,
    the scale of sway): else these would take in much of a lever arm.
    """

    max_stream_rate: float = 10.0
    max_gap_intervals: float = 3.5
    own_rates_from: float = 4.0
    unmeasured_std: float = 31.0
    bins_per_interval: float = 2.0
    shortest_bin: float = 0.4
    max_bins: int = 12_000
    max_points: int = 60_000
    min_bins: int = 60
    min_seconds: float = 60.0
    level: float = 0.008
    max_effects: int = 4
    ghost_share: float = 0.0008
    ghost_of_noise: float = 0.25
    indistinguishable: float = 6.0
    robust_level: float = 0.0005
    block: float = 20.0
    folds: int = 5
    noise_tolerance: float = 3.0
    instead_of: float = 1500.0
    instead_share: float = 0.15
    prior_angle: float = 0.1
    prior_scale: float = 0.02


SETTINGS = DiagnosisSettings()
