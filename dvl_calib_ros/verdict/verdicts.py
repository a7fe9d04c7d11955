"""Reasons of a verdict, of a model's selection, and manoeuvres to drive next."""

from __future__ import annotations

from .kinds import accept, marginal, on_page, reject, warning

_HELD_OUT = (
    "on {samples} held-out samples the velocity error is {uncorrected:.3f} m/s rms without correction, "
    "{corrected:.3f} with it, {predicted:.3f} predicted"
)
VERDICTS = on_page(
    "troubleshooting.md#reasons-of-a-verdict",
    # use of the samples
    reject(
        "NO_SAMPLE_USED",
        "no sample was used",
        means="No reference, no attitude, or every sample was refused.",
        remedy="there is nothing to apply",
    ),
    reject(
        "MOST_SAMPLES_GATED",
        "{gated} of {given} samples were rejected as outliers; the estimate describes only the other {used}",
        means="Most data contradict the estimate: check the configuration.",
    ),
    reject(
        "NOTHING_COMPARED",
        "there is no IMU, so no DVL sample can be compared with the reference",
        remedy="record the IMU's topic, with orientation",
    ),
    reject(
        "NO_ANGLE_SHOWN",
        "none of the angles is observable in the data yet",
        means="σ of each angle is still that of the prior: drive more.",
    ),
    marginal(
        "DRIFT_OPEN",
        "with this calibration dead reckoning may still drift by {open:.0f} m per km (1σ), more than {limit:.0f}",
        means="A predicted drift of up to five times `target_drift` is accepted.",
        remedy="drive on: other headings, other speeds, turns to both sides",
    ),
    # estimated values
    reject(
        "MISALIGNMENT_LARGE",
        "the misalignment is {degrees:.1f}°; from {limit:.1f}° on a calibration is rejected",
        means="The bracket is seldom the cause.",
        remedy=(
            "check mounting_rpy, the frames and a compass's declination; if they are right, try "
            "-p mounting_rpy:=[{roll:.0f}deg,{pitch:.0f}deg,{yaw:.0f}deg]"
        ),
    ),
    reject(
        "SCALE_LARGE",
        "a scale is {percent:.1f} % off, more than {limit:.1f} %",
        means="Units, speed of sound or reference are wrong. Limit: `max_scale_error`.",
    ),
    accept(
        "MOUNTING_FAR",
        "inspect the mounting: it is {degrees:.1f}° from mounting_rpy, more than {limit:.1f}°",
        means="The calibration may be good and the bracket bent. Limit: `accept_misalignment`.",
    ),
    marginal(
        "LEVER_ARM_NOT_SHOWN",
        "the lever arm is poorly observable, and {turns}",
        means="σ includes it.",
        remedy="give lever_arm and initial_std_lever_arm, or go straight and turn both ways",
    ),
    reject(
        "LEVER_ARM_TURNS_ANGLE",
        "the lever arm is known to ±{std:.2g} m, and {turns}",
        means="This model assumes the arm.",
        remedy="give lever_arm and initial_std_lever_arm, or go straight and turn both ways",
    ),
    # errors on held-out data
    accept("HELD_OUT", _HELD_OUT),
    marginal(
        "HELD_OUT_TOO_FEW",
        "too few samples with a reference velocity to verify the calibration on held-out data",
        means="There are fewer than 20 samples, or all are in one stretch.",
    ),
    marginal("HELD_OUT_OUTLIERS", _HELD_OUT + ", {typical:.3f} without outliers: there are many of them"),
    reject("HELD_OUT_WORSE", _HELD_OUT + ": the calibration increases the error"),
    marginal("HELD_OUT_NO_BETTER", _HELD_OUT + ": the calibration makes no difference, perhaps for lack of data"),
    reject(
        "HELD_OUT_SEVERAL_TIMES",
        _HELD_OUT + ": the error is several times the predicted one",
        means="The error is more than three times the predicted one.",
        remedy="the configuration is wrong, or an effect is missing from the model (dvl-calib diagnose looks for it)",
    ),
    reject(
        "HELD_OUT_IMPLAUSIBLE",
        _HELD_OUT + ": implausibly small, as if the DVL were fused into the reference, which then cannot judge it",
        remedy="use the velocity of GNSS alone as the reference",
    ),
    marginal(
        "HELD_OUT_NOISIER",
        _HELD_OUT + ": the reference is noisier than it says, or an effect is missing from the model",
        means="Limit: `max_error_ratio`.",
    ),
    # dead reckoning
    marginal(
        "DRIFT_NO_BETTER",
        "on held-out data dead reckoning gets no better: {after:.1f} m per km calibrated, {before:.1f} as mounted",
        means="The velocity fits better, but a lasting error remains.",
    ),
    reject(
        "DRIFT_WORSE",
        "on held-out data dead reckoning gets worse: {after:.1f} m per km calibrated, {before:.1f} as mounted",
        remedy="an effect is missing from the model (dvl-calib diagnose looks for it)",
    ),
    # clocks
    reject(
        "CLOCKS_APART",
        "{whose} stamps are {seconds:.1f} s {side} {other} that arrived at the same time{known}",
        remedy="synchronise the clocks; use the recording times for this bag: --restamp log",
    ),
    # several recordings
    reject(
        "BAGS_OVERLAP",
        "the DVL is in {first} and in {second} at the same time, so of samples at one time only the first is used",
        means="One recording is given twice, or there are two DVLs.",
        remedy="replay each by itself, and compare them",
    ),
    reject(
        "BAGS_MOUNTING_DIFFERS", "the mounting differs {moved} {between}, so the average is no recording's mounting"
    ),
    reject(
        "BAGS_DELAY_CHANGED",
        "the delay of the DVL's stamps differs between recordings, but one delay is used for recordings that follow "
        "each other so closely",
        remedy="calibrate each by itself",
    ),
)


MANOEUVRES = on_page(
    "troubleshooting.md#what-to-drive-next",
    accept(
        "NEXT_LEG",
        "drive straight, {name} ({compass:.0f}°)",
        means="Another heading separates a current from the mounting.",
    ),
    accept("NEXT_AHEAD", "drive straight ahead", means="Motion ahead makes yaw, pitch and scale observable."),
    accept("NEXT_FASTER", "drive straight, at {speed:.1f} m/s", means="An angle's error grows with the speed."),
    accept("NEXT_SPEEDS", "speed up and slow down by half", means="Accelerations separate a delay, two speeds a bias."),
    accept("NEXT_CIRCLE", "circle to {side}", means="Turns separate the lever arm and average earth-fixed errors."),
    accept("NEXT_EIGHT", "drive a figure eight", means="Turns to both sides separate lever arm and yaw."),
    accept("NEXT_DIVE", "dive and rise by 10° of pitch", means="Pitching makes the vertical axis observable."),
    accept("NEXT_REFERENCE", "surface: {model} learns only with the reference"),
    accept("NEXT_WAIT", "keep on: nothing is learnt yet"),
    accept("NEXT_REJECTED", "nothing: the findings say why this calibration is not to be used"),
    accept("NEXT_STANDS", "keep on until the drift has stayed on target"),
    accept("NEXT_IS_GOOD", "good enough: save"),
    accept("NEXT_IS_GOOD_BUT_SCALE", "as accurate as possible without a reference: save; the scale stays unknown"),
    accept(
        "LONGER_AS_DRIFT_GREW",
        "it takes longer than promised: the predicted drift has grown from {before:.1f} to {now:.1f} m per km",
    ),
    accept(
        "LONGER_AS_LITTLE_SHOWN",
        "it takes longer than promised: the motion since then was less informative than the suggested one "
        "({before:.1f} m per km then, {now:.1f} now)",
    ),
    accept(
        "WORTH_OF_ANOTHER_MODEL",
        "no longer good enough: the model is {model} now",
        means="`auto` follows the reference; in an outage it uses a model without one.",
        remedy="Wait for the reference, or set the parameter model.",
    ),
    accept(
        "WORTH_HAS_FALLEN",
        "no longer good enough: the predicted drift has grown to {worth:.1f} m per km",
        remedy="Drive on. If it happens again, look for the cause with `dvl-calib doctor`.",
    ),
)


SELECTIONS = on_page(
    "troubleshooting.md#why-a-model-is-selected",
    accept("MODEL_NAMED", "set by parameter model"),
    accept("MODEL_CHOSEN", "{by}: {gnss}"),
    accept("MODEL_CHOSEN_AS", "{by}: {gnss}; {why}"),
    accept("GNSS_AVAILABLE", "GNSS is available"),
    accept("GNSS_NOT_AVAILABLE", "GNSS is not available", means="No reference for `gnss_timeout`."),
    accept("GNSS_GOING", "GNSS has stopped; it counts as lost after gnss_hysteresis"),
    accept("GNSS_COMING", "GNSS is back; it counts as available after gnss_hysteresis"),
    accept(
        "CALIBRATION_KEPT",
        "the calibration with the reference so far stays in use",
        means="The mounting was estimated while there was a reference.",
    ),
    accept(
        "ARM_LOOKS_LIKE_ANGLE",
        "on this track a {metres:g} m error of the lever arm looks like {degrees:.1f}° of {angle}",
        means="Turns to one side at one speed confuse lever arm and angle.",
    ),
    accept(
        "POSITIONS_NOISY",
        "velocities from the positions would have {noise:.1f} m/s of noise, so positions are compared over legs",
    ),
    accept(
        "POSITIONS_SELDOM",
        "positions are too infrequent for velocities, so they are compared over legs",
        means="Positions more than three `position_window` apart are compared over legs.",
    ),
)


# Conclusions of comparisons and diagnoses.

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
        means="A mounting that moved far is often rejected, and the σ of a rejected calibration is not reliable.",
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
        remedy="check the speed of sound and the DVL's settings",
    ),
    marginal(
        "DELAY_CHANGED",
        "the DVL's stamps come {seconds:.2f} s ± {std:.2f} s {way} {between}",
        remedy="check the clocks; a delay says nothing about the mounting",
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
        "{name} was calibrated with another lever arm than {other} {verb} ({arm} m); a wrong arm turns the angles",
        remedy="if {arm} m is right, calibrate {name} again with -p lever_arm:=[{arm}]",
    ),
)


_FALLS = "the error falls from {before:.1f} to {after:.1f} mm/s on held-out data, where the noise is {noise:.1f} mm/s"
DIAGNOSES = on_page(
    "troubleshooting.md#what-a-diagnosis-says",
    accept("GAP_EXPLAINED", "the gap is {explained} by {names}: " + _FALLS),
    marginal("GAP_AMBIGUOUS", "the gap is {explained} by {names}: " + _FALLS + "; these data cannot tell which"),
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
    reject(
        "CALIBRATION_REJECTS",
        "the calibration rejects this recording: {says}",
        means="The diagnosis fits a mounting and a scale, which may absorb the error.",
    ),
    marginal(
        "GAP_TOO_SHORT",
        "no gap can be measured in this recording: {samples} samples over {seconds:.0f} s are too few",
        means="Only samples with DVL, reference and attitude count.",
        remedy="record {wanted:.0f} s at least, better 600 s",
    ),
    marginal(
        "GAP_REFERENCE_CONSTANT",
        "no gap can be measured in this recording: the reference velocity is constant to the last digit",
        remedy="check the receiver",
    ),
    marginal(
        "GAP_REFERENCE_VERTICAL",
        "no gap can be measured in this recording: the reference does not measure the horizontal velocity",
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
    accept("NEXT_NOTHING", "nothing: all effects are observable"),
    accept("NEXT_ANYTHING", "straight legs on several headings and at several speeds, with turns to both sides"),
)


UNPAIRED = on_page(
    "troubleshooting.md#what-a-comparison-with-a-simulator-says",
    reject("SIMULATOR_LACKS", "the simulator lacks {names}"),
    reject("SIMULATOR_OTHER_SIZE", "the simulator has {names} of another size than the vehicle"),
    reject("SIMULATOR_ALONE_HAS", "the simulator has {names}, which the vehicle lacks"),
    marginal("SIMULATOR_FRAME", "the simulator's DVL is mounted {simulator}, the vehicle's {vehicle}"),
    accept(
        "SIMULATOR_PUT_RIGHT",
        "corrected, the simulator's held-out error on the vehicle's motion falls from {before:.1f} to {after:.1f} mm/s",
    ),
    accept(
        "SIMULATOR_ROUNDS",
        "after round {round}, with {names}, the simulator's error on the vehicle's own motion is {after:.1f} mm/s "
        "instead of {before:.1f}, held out; noise alone causes {floor:.1f}",
    ),
    marginal(
        "SIMULATOR_ROUNDS_IN_VAIN",
        "corrected, the simulator comes no closer: its error on the vehicle's own motion stays {before:.1f} mm/s, "
        "held out; noise alone causes {floor:.1f}",
        means="In no round was the corrected simulator closer to the vehicle than the simulator as recorded.",
    ),
    marginal(
        "SIMULATOR_NOT_ADDED",
        "no round of corrections can remove {names}",
        means="The effect happens once in a run, differs between recordings, or is observable in one log only.",
    ),
    accept(
        "SIMULATOR_NO_ROUNDS",
        "no difference can be corrected, so no round was made",
        means="The comparison claims no difference.",
    ),
    marginal(
        "SIMULATOR_NOT_SHOWN",
        "these recordings show no difference in effects, but cannot show some differences that matter",
    ),
    accept("SIMULATOR_ALIKE", "the simulator lacks no effect that is observable in these recordings"),
    marginal("SIMULATOR_NOISE", "the noise differs in {names}"),
    marginal(
        "SIMULATOR_UNKNOWN_REST",
        "a part of the error in the log of the {sides} follows no effect of the library",
        means="The diagnosis of that side says `unknown`.",
    ),
    marginal(
        "SIMULATOR_NOTHING_COMPARED",
        "nothing can be compared ({side}: {why})",
        means="That side's recordings cannot be diagnosed.",
    ),
)
