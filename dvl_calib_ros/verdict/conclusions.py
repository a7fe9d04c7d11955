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
        "No quantity differs at 2 σ, corrected for the number of tests.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "MOUNTING_SCATTERS",
        "the calibrations differ, but no single date explains it: {count} calibrations differ by at most {apart:.2f}° "
        "in any angle (χ² {chi_square:.1f} of {freedom}, p {p:.2g})",
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
        "MOUNTING_SUSPECTED",
        "suspected move: {name} is rejected ({why}), and differs from {other} {moved}",
        "A mounting that moved far is often rejected; σ of a rejected calibration does not hold.",
        "inspect the mounting, and calibrate once more",
        Severity.MARGINAL,
    ),
    Kind(
        "MOUNTING_SUSPICIOUS",
        "the mounting may have moved {moved} {between}; without a movement, 1 of {often:.0f} comparisons "
        "differs this much",
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
        "σ does not include all differences between the recordings.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "SCATTER",
        "the calibrations scatter by {by:.1f} times their σ, and no single date explains it: σ is too small",
        "σ does not include all differences between the recordings.",
        "",
        Severity.MARGINAL,
    ),
    # remarks that weaken a comparison
    Kind(
        "CALIBRATION_DOUBTED",
        "{name}: {remark}",
        "A remark in its result file.",
        "calibrate again, or leave it out of the comparison",
    ),
    Kind(
        "MODELS_DIFFER",
        "the models differ ({models}): so may their errors",
        "An error common to both models cancels in the difference; an error of one model does not.",
        "calibrate all with one model (-p model:=full)",
    ),
    Kind(
        "ARMS_DIFFER",
        "{name} was calibrated with another lever arm than {other} {verb} ({arm} m); the wrong one turns its angles",
        "A wrong lever arm that is not estimated changes the yaw.",
        "if that one is right, calibrate {name} again with -p lever_arm:=[{arm}]",
    ),
)
COMPARISONS = tuple(replace(kind, page="troubleshooting.md#what-a-comparison-says") for kind in _COMPARISONS)


_FALLS = "the error falls from {before:.1f} to {after:.1f} mm/s on held-out data, where the noise is {noise:.1f} mm/s"
_DIAGNOSES = (
    Kind(
        "GAP_EXPLAINED",
        "the gap is explained by {names}: " + _FALLS,
        "The verdict known.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_AMBIGUOUS",
        "the gap is explained by {names}: " + _FALLS + "; this data cannot tell which it is",
        "The verdict ambiguous: several effects explain the data as well.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_PARTLY_UNKNOWN",
        "{names} explain only part of the gap, and no effect of the library explains the rest: " + _FALLS,
        "The verdict unknown, with effects that were found.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "GAP_UNKNOWN",
        "no effect of the library explains the error of {before:.1f} mm/s, where the noise is {noise:.1f} mm/s",
        "The verdict unknown.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "NO_GAP",
        "no gap beyond the noise of {noise:.1f} mm/s; {visible} of {tested} effects would have been found at sizes "
        "that matter",
        "The verdict no_gap.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "GAP_NOT_TESTABLE",
        "this recording cannot rule out a gap: only {visible} of {tested} effects would have been found in it",
        "The verdict insufficient_excitation: too little motion shows too few effects.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_TOO_SHORT",
        "this recording cannot show a gap: {samples} samples over {seconds:.0f} s are too few",
        "Samples are those that have DVL, reference and attitude together.",
        "record {wanted:.0f} s at least, better 600 s",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_CONSTANT",
        "this recording cannot show a gap: the reference velocity is constant to the last digit",
        "A stopped receiver measures nothing.",
        "check the receiver",
        Severity.MARGINAL,
    ),
    Kind(
        "GAP_REFERENCE_VERTICAL",
        "this recording cannot show a gap: the reference does not measure the horizontal velocity",
        "Only x and y of the body tell most effects.",
        "record a horizontal reference velocity",
        Severity.MARGINAL,
    ),
    Kind(
        "REST_UNEXPLAINED",
        "{rest:.1f} mm/s are not explained",
        "Residual on held-out data beyond the noise.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS",
        "the residual follows {about}",
        "The dependence is statistically significant.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_PERIOD",
        "the residual follows a period of {seconds:.0f} s",
        "The dependence is statistically significant.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "REST_FOLLOWS_NOTHING",
        "the residual follows neither motion nor time",
        "No dependence is statistically significant.",
        "",
        Severity.ACCEPT,
    ),
    # what to record next
    Kind(
        "NEXT_TELL_APART",
        "to tell {name} from {others}: {manoeuvre}",
        "Several effects explain the gap as well.",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_SHOW", "to see {name}: {manoeuvre}", "The least observable effect here.", "", Severity.ACCEPT),
    Kind(
        "NEXT_SAME_ROUTE",
        "the same route again, to see whether the residual follows place, time or motion",
        "No effect of the library explains the gap.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "NEXT_RECORD",
        "record {needs} as well, to test {names}",
        "All effects that this recording can test would be found.",
        "",
        Severity.ACCEPT,
    ),
    Kind("NEXT_NOTHING", "nothing: all effects show", "No other motion would tell more.", "", Severity.ACCEPT),
    Kind(
        "NEXT_ANYTHING",
        "straight legs on several headings and at several speeds, with turns to both sides",
        "Nothing could be tested.",
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
        "The vehicle's recordings show these effects, and the simulator's do not.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_OTHER_SIZE",
        "the simulator has {names} of another size",
        "Both show these effects, and their 95 % intervals differ by more than chance.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_ALONE_HAS",
        "the simulator has {names} which the vehicle has not",
        "The simulator's recordings show these effects, and the vehicle's do not.",
        severity=Severity.REJECT,
    ),
    _Said(
        "SIMULATOR_PUT_RIGHT",
        "put right, its error on the vehicle's own motion falls from {before:.1f} to {after:.1f} mm/s, held out",
        "Each side's DVL is simulated on the stretches of the vehicle's motion that were held out.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS",
        "after round {round} the simulator's error on the vehicle's own motion is {after:.1f} mm/s instead of "
        "{before:.1f}, held out; noise alone makes {floor:.1f}",
        "In each round the simulator's DVL was put right, simulated on the simulator's motion and compared again.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_ROUNDS_IN_VAIN",
        "put right, the simulator comes no closer: its error on the vehicle's own motion stays {before:.1f} mm/s, "
        "held out; noise alone makes {floor:.1f}",
        "No round differs in less, or has a smaller error, than the simulator as it was recorded.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NO_ROUNDS",
        "nothing differs that could be put right, so no round was made",
        "The loop ends where the comparison claims no difference.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOT_SHOWN",
        "these recordings show no difference in effects, and could not have shown some that matter",
        "One side's motion shows too few effects.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_ALIKE",
        "the simulator lacks no effect that these recordings show",
        "What both can show is of one size.",
        severity=Severity.ACCEPT,
    ),
    _Said(
        "SIMULATOR_NOISE",
        "the noise differs in {names}",
        "Noise, rate, gaps or outliers of the streams.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_UNKNOWN_REST",
        "something in the log of the {sides} follows no effect of the library",
        "The diagnosis of that side alone says unknown.",
        severity=Severity.MARGINAL,
    ),
    _Said(
        "SIMULATOR_NOTHING_COMPARED",
        "nothing can be compared: of the {side}, {why}",
        "That side's recordings cannot be diagnosed.",
        severity=Severity.MARGINAL,
    ),
)
