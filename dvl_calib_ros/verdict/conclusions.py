"""Conclusions of comparisons and diagnoses."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from .kinds import Kind, Severity

_COMPARISONS = (
    Kind(
        "MOUNTING_SAME",
        "no movement found; smaller than {smallest:.1f}° is not detectable ({angles}; {power:.0f} of 100 such "
        "movements are found){unseen}",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "MOUNTING_SCATTERS",
        "the calibrations differ, but no single date explains it: {count} calibrations differ by at most {apart:.2f}° "
        "in any angle (χ² {chi_square:.1f} of {freedom}, p {p:.2g})",
        "σ is too small, or the mounting moves all the time.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "MOUNTING_MOVED",
        "the mounting has moved {moved} {between}",
        "",
        "",
        Severity.REJECT,
    ),
    Kind(
        "MOUNTING_SUSPECTED",
        "suspected move: {name} is rejected ({why}), and differs from {other} {moved}",
        "A mounting that moved far is often rejected; σ of a reject does not hold.",
        "inspect the mounting, and calibrate once more",
        Severity.MARGINAL,
    ),
    Kind(
        "MOUNTING_SUSPICIOUS",
        "the mounting may have moved {moved} {between}; without a movement, 1 of {often:.0f} comparisons "
        "differs this much",
        "",
        "calibrate once more before you rely on either",
        Severity.MARGINAL,
    ),
    Kind(
        "SCALE_CHANGED",
        "the scale has changed by {percent:+.2f} % ± {std:.2f} % {between}",
        "",
        "the speed of sound, or the DVL's settings",
        Severity.MARGINAL,
    ),
    Kind(
        "DELAY_CHANGED",
        "the DVL's stamps come {seconds:.2f} s ± {std:.2f} s {way} {between}",
        "",
        "a clock, not the mounting",
        Severity.MARGINAL,
    ),
    Kind(
        "SCATTER_BESIDE_MOVES",
        "apart from that, the calibrations scatter by {by:.1f} times their σ, so the size of the move is as uncertain",
        "",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "SCATTER",
        "the calibrations scatter by {by:.1f} times their σ, and no single date explains it: σ is too small",
        "",
        "",
        Severity.MARGINAL,
    ),
    # remarks that weaken a comparison
    Kind(
        "CALIBRATION_DOUBTED",
        "{name}: {remark}",
        "",
        "calibrate again, or leave it out of the comparison",
    ),
    Kind(
        "MODELS_DIFFER",
        "the models differ ({models}): so may their errors",
        "",
        "calibrate all with one model (-p model:=full)",
    ),
    Kind(
        "ARMS_DIFFER",
        "{name} was calibrated with another lever arm than {other} {verb} ({arm} m); the wrong one turns its angles",
        "",
        "if that one is right, calibrate {name} again with -p lever_arm:=[{arm}]",
    ),
)
COMPARISONS = tuple(replace(kind, page="troubleshooting.md#what-a-comparison-says") for kind in _COMPARISONS)


_FALLS = "the error falls from {before:.1f} to {after:.1f} mm/s on held-out data, where the noise is {noise:.1f} mm/s"
_DIAGNOSES = (
    Kind(
        "GAP_EXPLAINED",
        "the gap is {explained} by {names}: " + _FALLS,
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_AMBIGUOUS",
        "the gap is {explained} by {names}: " + _FALLS + "; this data cannot tell which it is",
        "",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_PARTLY_UNKNOWN",
        "the gap is {explained} by {names}, and no effect of the library explains the rest: " + _FALLS,
        "",
        "",
        Severity.REJECT,
    ),
    Kind(
        "GAP_UNKNOWN",
        "no effect of the library explains the error of {before:.1f} mm/s, where the noise is {noise:.1f} mm/s",
        "",
        "",
        Severity.REJECT,
    ),
    Kind(
        "NO_GAP",
        "no gap beyond the noise of {noise:.1f} mm/s; {visible} of {tested} effects would have been found at sizes "
        "that matter",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_NOT_TESTABLE",
        "this recording cannot rule out a gap: only {visible} of {tested} effects would have been found in it",
        "",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "CALIBRATION_REJECTS",
        "the calibration rejects this recording: {says}",
        "The diagnosis fits a mounting and a scale, which may absorb the error.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "GAP_TOO_SHORT",
        "this recording cannot show a gap: {samples} samples over {seconds:.0f} s are too few",
        "Samples with DVL, reference and attitude count.",
        "record {wanted:.0f} s at least, better 600 s",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_CONSTANT",
        "this recording cannot show a gap: the reference velocity is constant to the last digit",
        "",
        "check the receiver",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_VERTICAL",
        "this recording cannot show a gap: the reference does not measure the horizontal velocity",
        "",
        "record a horizontal reference velocity",
        Severity.MARGINAL,
    ),
    Kind(
        "REST_UNEXPLAINED",
        "{rest:.1f} mm/s are not explained",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS",
        "the residual follows {about}",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_PERIOD",
        "the residual follows a period of {seconds:.0f} s",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_NOTHING",
        "the residual follows neither motion nor time",
        "",
        "",
        Severity.ACCEPT,
    ),
    # what to record next
    Kind(
        "NEXT_TELL_APART",
        "to tell {name} from {others}: {manoeuvre}",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_SHOW", "to see {name}: {manoeuvre}", "", "", Severity.ACCEPT),
    Kind(
        "NEXT_SAME_ROUTE",
        "the same route again, to see whether the residual follows place, time or motion",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "NEXT_RECORD",
        "record {needs} as well, to test {names}",
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_NOTHING", "nothing: all effects show", "", "", Severity.ACCEPT),
    Kind(
        "NEXT_ANYTHING",
        "straight legs on several headings and at several speeds, with turns to both sides",
        "",
        "",
        Severity.ACCEPT,
    ),
)
DIAGNOSES = tuple(replace(kind, page="troubleshooting.md#what-a-diagnosis-says") for kind in _DIAGNOSES)


_Said = partial(Kind, page="troubleshooting.md#what-a-comparison-with-a-simulator-says", remedy="")
UNPAIRED = (
    _Said(
        "SIMULATOR_LACKS",
        "the simulator lacks {names}",
        "",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_OTHER_SIZE",
        "the simulator has {names} of another size",
        "",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_ALONE_HAS",
        "the simulator has {names} which the vehicle has not",
        "",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_PUT_RIGHT",
        "put right, its error on the vehicle's own motion falls from {before:.1f} to {after:.1f} mm/s, held out",
        "",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS",
        "after round {round} the simulator's error on the vehicle's own motion is {after:.1f} mm/s instead of "
        "{before:.1f}, held out; noise alone makes {floor:.1f}",
        "",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS_IN_VAIN",
        "put right, the simulator comes no closer: its error on the vehicle's own motion stays {before:.1f} mm/s, "
        "held out; noise alone makes {floor:.1f}",
        "No round is better than the simulator as recorded.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NO_ROUNDS",
        "nothing differs that could be put right, so no round was made",
        "The comparison claims no difference.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOT_SHOWN",
        "these recordings show no difference in effects, and could not have shown some that matter",
        "",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_ALIKE",
        "the simulator lacks no effect that these recordings show",
        "",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOISE",
        "the noise differs in {names}",
        "",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_UNKNOWN_REST",
        "something in the log of the {sides} follows no effect of the library",
        "The diagnosis of that side says `unknown`.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NOTHING_COMPARED",
        "nothing can be compared: of the {side}, {why}",
        "That side's recordings cannot be diagnosed.",
        severity=Severity.MARGINAL,
    ),
)
