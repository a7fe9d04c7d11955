"""Conclusions of comparisons and diagnoses."""

from __future__ import annotations

from .kinds import accept, marginal, on_page, reject, warning

COMPARISONS = on_page(
    "troubleshooting.md#what-a-comparison-says",
    accept(
        "MOUNTING_SAME",
        "no movement found; smaller than {smallest:.1f}° is not detectable ({angles}; {power:.0f} of 100 such "
        "movements are found){unseen}",
    ),
    accept(
        "MOUNTING_SCATTERS",
        "the calibrations differ, but no single date explains it: {count} calibrations differ by at most {apart:.2f}° "
        "in any angle (χ² {chi_square:.1f} of {freedom}, p {p:.2g})",
        means="σ is too small, or the mounting moves all the time.",
    ),
    reject("MOUNTING_MOVED", "the mounting has moved {moved} {between}"),
    marginal(
        "MOUNTING_SUSPECTED",
        "suspected move: {name} is rejected ({why}), and differs from {other} {moved}",
        means="A mounting that moved far is often rejected; σ of a reject does not hold.",
        remedy="inspect the mounting, and calibrate once more",
    ),
    marginal(
        "MOUNTING_SUSPICIOUS",
        "the mounting may have moved {moved} {between}; without a movement, 1 of {often:.0f} comparisons "
        "differs this much",
        remedy="calibrate once more before you rely on either",
    ),
    marginal(
        "SCALE_CHANGED",
        "the scale has changed by {percent:+.2f} % ± {std:.2f} % {between}",
        remedy="the speed of sound, or the DVL's settings",
    ),
    marginal(
        "DELAY_CHANGED",
        "the DVL's stamps come {seconds:.2f} s ± {std:.2f} s {way} {between}",
        remedy="a clock, not the mounting",
    ),
    marginal(
        "SCATTER_BESIDE_MOVES",
        "apart from that, the calibrations scatter by {by:.1f} times their σ, so the size of the move is as uncertain",
    ),
    marginal(
        "SCATTER",
        "the calibrations scatter by {by:.1f} times their σ, and no single date explains it: σ is too small",
    ),
    # remarks that weaken a comparison
    warning("CALIBRATION_DOUBTED", "{name}: {remark}", remedy="calibrate again, or leave it out of the comparison"),
    warning(
        "MODELS_DIFFER",
        "the models differ ({models}): so may their errors",
        remedy="calibrate all with one model (-p model:=full)",
    ),
    warning(
        "ARMS_DIFFER",
        "{name} was calibrated with another lever arm than {other} {verb} ({arm} m); the wrong one turns its angles",
        remedy="if that one is right, calibrate {name} again with -p lever_arm:=[{arm}]",
    ),
)


_FALLS = "the error falls from {before:.1f} to {after:.1f} mm/s on held-out data, where the noise is {noise:.1f} mm/s"
DIAGNOSES = on_page(
    "troubleshooting.md#what-a-diagnosis-says",
    accept("GAP_EXPLAINED", "the gap is {explained} by {names}: " + _FALLS),
    marginal("GAP_AMBIGUOUS", "the gap is {explained} by {names}: " + _FALLS + "; this data cannot tell which it is"),
    reject(
        "GAP_PARTLY_UNKNOWN",
        "the gap is {explained} by {names}, and no effect of the library explains the rest: " + _FALLS,
    ),
    reject(
        "GAP_UNKNOWN",
        "no effect of the library explains the error of {before:.1f} mm/s, where the noise is {noise:.1f} mm/s",
    ),
    accept(
        "NO_GAP",
        "no gap beyond the noise of {noise:.1f} mm/s; {visible} of {tested} effects would have been found at sizes "
        "that matter",
    ),
    marginal(
        "GAP_NOT_TESTABLE",
        "this recording cannot rule out a gap: only {visible} of {tested} effects would have been found in it",
    ),
    marginal(
        "GAP_TOO_SHORT",
        "this recording cannot show a gap: {samples} samples over {seconds:.0f} s are too few",
        means="Samples with DVL, reference and attitude count.",
        remedy="record {wanted:.0f} s at least, better 600 s",
    ),
    marginal(
        "GAP_REFERENCE_CONSTANT",
        "this recording cannot show a gap: the reference velocity is constant to the last digit",
        remedy="check the receiver",
    ),
    marginal(
        "GAP_REFERENCE_VERTICAL",
        "this recording cannot show a gap: the reference does not measure the horizontal velocity",
        remedy="record a horizontal reference velocity",
    ),
    accept("REST_UNEXPLAINED", "{rest:.1f} mm/s are not explained"),
    accept("REST_FOLLOWS", "the residual follows {about}"),
    accept("REST_FOLLOWS_PERIOD", "the residual follows a period of {seconds:.0f} s"),
    accept("REST_FOLLOWS_NOTHING", "the residual follows neither motion nor time"),
    # what to record next
    accept("NEXT_TELL_APART", "to tell {name} from {others}: {manoeuvre}"),
    accept("NEXT_SHOW", "to see {name}: {manoeuvre}"),
    accept("NEXT_SAME_ROUTE", "the same route again, to see whether the residual follows place, time or motion"),
    accept("NEXT_RECORD", "record {needs} as well, to test {names}"),
    accept("NEXT_NOTHING", "nothing: all effects show"),
    accept("NEXT_ANYTHING", "straight legs on several headings and at several speeds, with turns to both sides"),
)


UNPAIRED = on_page(
    "troubleshooting.md#what-a-comparison-with-a-simulator-says",
    reject("SIMULATOR_LACKS", "the simulator lacks {names}"),
    reject("SIMULATOR_OTHER_SIZE", "the simulator has {names} of another size"),
    reject("SIMULATOR_ALONE_HAS", "the simulator has {names} which the vehicle has not"),
    accept(
        "SIMULATOR_PUT_RIGHT",
        "put right, its error on the vehicle's own motion falls from {before:.1f} to {after:.1f} mm/s, held out",
    ),
    accept(
        "SIMULATOR_ROUNDS",
        "after round {round} the simulator's error on the vehicle's own motion is {after:.1f} mm/s instead of "
        "{before:.1f}, held out; noise alone makes {floor:.1f}",
    ),
    marginal(
        "SIMULATOR_ROUNDS_IN_VAIN",
        "put right, the simulator comes no closer: its error on the vehicle's own motion stays {before:.1f} mm/s, "
        "held out; noise alone makes {floor:.1f}",
        means="No round is better than the simulator as recorded.",
    ),
    accept(
        "SIMULATOR_NO_ROUNDS",
        "nothing differs that could be put right, so no round was made",
        means="The comparison claims no difference.",
    ),
    marginal(
        "SIMULATOR_NOT_SHOWN",
        "these recordings show no difference in effects, and could not have shown some that matter",
    ),
    accept("SIMULATOR_ALIKE", "the simulator lacks no effect that these recordings show"),
    marginal("SIMULATOR_NOISE", "the noise differs in {names}"),
    marginal(
        "SIMULATOR_UNKNOWN_REST",
        "something in the log of the {sides} follows no effect of the library",
        means="The diagnosis of that side says `unknown`.",
    ),
    marginal(
        "SIMULATOR_NOTHING_COMPARED",
        "nothing can be compared: of the {side}, {why}",
        means="That side's recordings cannot be diagnosed.",
    ),
)
