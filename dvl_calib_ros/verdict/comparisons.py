"""What is said of several calibrations of one DVL: whether the mounting moved, and what makes that worth less."""

from __future__ import annotations

from dataclasses import replace

from .kinds import Kind, Severity

_SAME = (
    "{count} calibrations differ by at most {apart:.2f}° about any axis (χ² {chi_square:.1f} of {freedom}, p {p:.2g})"
)
_KINDS = (
    Kind(
        "MOUNTING_SAME",
        "the same mounting within σ: " + _SAME,
        "No pair differs by more than 2 σ.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "MOUNTING_SCATTERS",
        "the calibrations differ, but no single date explains it: " + _SAME,
        "They scatter by more than their σ says; σ is too small, or the mounting moves all the time.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "MOUNTING_MOVED",
        "the mounting has moved {moved} {between}",
        "A mounting that did not move differs this much less often than a normal error exceeds 4 σ.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "MOUNTING_SUSPICIOUS",
        "the mounting may have moved {moved} {between}; by chance alone so large a difference comes up in 1 of "
        "{often:.0f} comparisons",
        "Between 2 and 4 σ.",
        "calibrate once more before you rely on either",
        Severity.MARGINAL,
    ),
    Kind(
        "SCALE_CHANGED",
        "the scale has changed by {percent:+.2f} % ± {std:.2f} % {between}",
        "A scale is no part of the mounting.",
        "the speed of sound, or the DVL's settings",
        Severity.MARGINAL,
    ),
    Kind(
        "DELAY_CHANGED",
        "the DVL's stamps come {seconds:.2f} s ± {std:.2f} s {way} {between}",
        "A delay is no part of the mounting.",
        "a clock, not the mounting",
        Severity.MARGINAL,
    ),
    Kind(
        "SCATTER_BESIDE_MOVES",
        "apart from that, the calibrations scatter by {by:.1f} times their σ, so the size of the move is as uncertain",
        "σ does not hold all that differs between the recordings.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "SCATTER",
        "the calibrations scatter by {by:.1f} times their σ, and no single date explains it: σ is too small",
        "σ does not hold all that differs between the recordings.",
        "",
        Severity.MARGINAL,
    ),
    # what makes a comparison worth less
    Kind(
        "CALIBRATION_DOUBTED",
        "{name}: {remark}",
        "Its result file says so.",
        "calibrate it anew, or leave it out of the comparison",
    ),
    Kind(
        "MODELS_DIFFER",
        "the models differ ({models}): so may their errors",
        "An error that two models make alike cancels in a difference; one that one of them makes does not.",
        "calibrate all with one model (-p model:=G2)",
    ),
    Kind(
        "ARMS_DIFFER",
        "{name} was calibrated with another lever arm than {other} {verb} ({arm} m); the wrong one turns its angles",
        "A lever arm that is taken as known and is wrong turns the yaw.",
        "if that one is right, calibrate {name} again with -p lever_arm:=[{arm}]",
    ),
)
COMPARISONS = tuple(replace(kind, page="troubleshooting.md#what-a-comparison-says") for kind in _KINDS)
