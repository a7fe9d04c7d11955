"""Reasons of a verdict, of a model's selection, and manoeuvres to drive next."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from .kinds import Kind, Severity

_HELD_OUT = (
    "on {samples} held-out samples the velocity error is {uncorrected:.3f} m/s rms without correction, "
    "{corrected:.3f} with it, {predicted:.3f} predicted"
)
_KINDS = (
    # what it used
    Kind(
        "NO_SAMPLE_USED",
        "no sample was used",
        "The model had nothing to learn from: no reference, no attitude, or every sample was refused.",
        "there is nothing to apply; the model `full` needs 25 s of data",
        Severity.REJECT,
    ),
    Kind(
        "MOST_SAMPLES_GATED",
        "{gated} of {given} samples were rejected as outliers; the estimate describes only the other {used}",
        "Where most of the data contradict an estimate, the configuration is wrong, or the estimate is.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "NOTHING_COMPARED",
        "there is no IMU, so no DVL sample can be compared with the reference",
        "A velocity in the earth's frame says nothing of the DVL's axes without an attitude.",
        "record the IMU's topic, with orientation",
        Severity.REJECT,
    ),
    Kind(
        "NO_ANGLE_SHOWN",
        "the data has shown none of the angles yet",
        "σ of each angle is still about that of the prior.",
        "",
        Severity.MARGINAL,
    ),
    # what it found
    Kind(
        "MISALIGNMENT_LARGE",
        "the misalignment is {degrees:.1f}°, and from {limit:.1f}° on it is rejected",
        "So large an angle is more often a wrong mounting_rpy or frame than a bracket (reject_misalignment).",
        "is mounting_rpy right, and are the frames?",
        Severity.REJECT,
    ),
    Kind(
        "SCALE_LARGE",
        "a scale is {percent:.1f} % off, more than {limit:.1f} %",
        "No DVL is so wrong; units, speed of sound or a wrong reference are (max_scale_error).",
        "",
        Severity.REJECT,
    ),
    Kind(
        "MOUNTING_FAR",
        "inspect the mounting: it is {degrees:.1f}° from mounting_rpy, which is much (from {limit:.1f}° on)",
        "The calibration may be good, and the bracket bent (accept_misalignment).",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "LEVER_ARM_NOT_SHOWN",
        "the lever arm is not shown well, and {turns}",
        "On this track an error of the lever arm looks like an angle. σ holds it.",
        "give lever_arm and how well it is measured (initial_std_lever_arm), or go straight and turn both ways",
        Severity.MARGINAL,
    ),
    Kind(
        "LEVER_ARM_TURNS_ANGLE",
        "the lever arm is known to ±{std:.2g} m, and {turns}",
        "On this track an error of the lever arm looks like an angle, and this model takes the arm as known.",
        "give lever_arm and how well it is measured (initial_std_lever_arm), or go straight and turn both ways",
        Severity.REJECT,
    ),
    # what it does on data that it had not seen
    Kind(
        "HELD_OUT",
        _HELD_OUT,
        "As good as its σ promises.",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "HELD_OUT_TOO_FEW",
        "too few samples with a reference velocity to verify it on held-out data",
        "Fewer than 20, or all of them in one stretch of the recording.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_OUTLIERS",
        _HELD_OUT + ", {typical:.3f} without outliers: there are many of them",
        "The error is large by outliers alone, which the calibration leaves out.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_WORSE",
        _HELD_OUT + ": the calibration makes it worse",
        "By more than the variance of the estimate explains.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_NO_BETTER",
        _HELD_OUT + ": the calibration makes no difference, perhaps for lack of data",
        "Worse by no more than what its σ by blocks of time allows.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_SEVERAL_TIMES",
        _HELD_OUT + ": the error is several times the predicted one",
        "The error is more than three times what the noise explains.",
        "the configuration is wrong, or an effect is missing from the model (dvl-calib diagnose looks for it)",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_IMPLAUSIBLE",
        _HELD_OUT + ": implausibly small, as if the DVL were fused into the reference, which then cannot judge it",
        "Less than a fifth of what the instruments claim is less than their noise: they share it.",
        "take GNSS alone",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_NOISIER",
        _HELD_OUT + ": the reference is noisier than it says, or an effect is missing from the model",
        "The error is larger than predicted by more than chance (max_error_ratio).",
        "",
        Severity.MARGINAL,
    ),
    # dead reckoning
    Kind(
        "DRIFT_NO_BETTER",
        "on data held out dead reckoning gets no better: {after:.1f} m per km with it, {before:.1f} as mounted",
        "Velocities may fit better and the track no better, where an error lasts.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "DRIFT_WORSE",
        "on data held out dead reckoning drifts by {after:.1f} m per km with it, by {before:.1f} as mounted",
        "More than half as much again, and more than noise explains.",
        "an effect is missing from the model (dvl-calib diagnose looks for it)",
        Severity.REJECT,
    ),
    # clocks
    Kind(
        "CLOCKS_APART",
        "{whose} stamps are {seconds:.1f} s {side} {other} with which they came{known}",
        "The two drivers stamp by different clocks, further apart than any model looks for.",
        "set the clocks by one source; this recording: --restamp log takes the times at which messages were recorded",
        Severity.REJECT,
    ),
    # several recordings
    Kind(
        "BAGS_OVERLAP",
        "{first} and {second} hold the DVL at the same time, so of many samples only the first is used",
        "Two recordings of one time are one recording twice, or of two DVLs.",
        "replay each by itself, and compare them",
        Severity.REJECT,
    ),
    Kind(
        "BAGS_MOUNTING_DIFFERS",
        "the mounting differs {moved} {between}: the average of all is the mounting of none",
        "Each recording was calibrated alone, and two of them contradict each other.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "BAGS_DELAY_CHANGED",
        "the delay of the DVL's stamps differs between recordings, but one delay is used for all that follow each "
        "other so closely",
        "A model with one delay averages two.",
        "calibrate each by itself",
        Severity.REJECT,
    ),
)
VERDICTS = tuple(replace(kind, page="troubleshooting.md#reasons-of-a-verdict") for kind in _KINDS)


_Said = partial(Kind, page="troubleshooting.md#what-to-drive-next", severity=Severity.ACCEPT, remedy="")
MANOEUVRES = (
    _Said("NEXT_LEG", "drive straight, {name} ({compass:.0f}°)", "Another heading tells a current from the mounting."),
    _Said("NEXT_AHEAD", "drive straight ahead", "Motion ahead shows yaw, pitch and scale."),
    _Said("NEXT_FASTER", "drive straight, at {speed:.1f} m/s", "An angle shows in proportion to the speed."),
    _Said("NEXT_SPEEDS", "speed up and slow down by half", "A delay shows in accelerations, a bias at two speeds."),
    _Said("NEXT_CIRCLE", "circle to {side}", "Turns show the lever arm, and average what stays with the earth."),
    _Said("NEXT_EIGHT", "drive a figure eight", "Turns to both sides tell a lever arm from a yaw."),
    _Said("NEXT_DIVE", "dive and rise by 10° of pitch", "Pitching shows what the vertical axis brings."),
    _Said("NEXT_WAIT", "keep on: nothing is learnt yet", "The models have not used a sample, or the vehicle stands."),
    _Said(
        "NEXT_REJECTED",
        "nothing: the findings say why this calibration is not to be used",
        "A replay would reject it: more data of the same kind do not help.",
    ),
    _Said(
        "NEXT_STANDS",
        "keep on: the goal is reached, if it stays so",
        "What is predicted differs from second to second, so that it has to stand for half a minute.",
    ),
    _Said("NEXT_IS_GOOD", "good enough: save", "The predicted drift is within target_drift."),
    _Said(
        "NEXT_IS_GOOD_BUT_SCALE",
        "as good as it gets without a reference: save; the scale stays unknown",
        "The drift by yaw is within target_drift. Only a reference velocity shows a scale.",
    ),
    _Said(
        "LONGER_AS_DRIFT_GREW",
        "it takes longer than promised: the predicted drift has grown from {before:.1f} to {now:.1f} m per km",
        "Newer data differ from the older by more than the σ had claimed.",
    ),
    _Said(
        "LONGER_AS_LITTLE_SHOWN",
        "it takes longer than promised: the motion since then has shown less than what was asked for "
        "({before:.1f} m per km then, {now:.1f} now)",
        "The time is that of the manoeuvre that is named next, at the usual speed.",
    ),
    _Said(
        "WORTH_OF_ANOTHER_MODEL",
        "no longer good enough: the model is {model} now",
        "Model auto follows the reference. In an outage a model without a reference is in use, and would be saved.",
        remedy="Wait for the reference, or name the model.",
    ),
    _Said(
        "WORTH_HAS_FALLEN",
        "no longer good enough: the predicted drift has grown to {worth:.1f} m per km",
        "Newer data differ from the older by more than the σ had claimed.",
        remedy="Drive on. If it happens again, look for the cause with `dvl-calib doctor`.",
    ),
)


_Selected = partial(Kind, page="troubleshooting.md#why-a-model-is-selected", severity=Severity.ACCEPT)
SELECTIONS = (
    _Selected("MODEL_NAMED", "set by parameter model", "The parameter names one model.", ""),
    _Selected("MODEL_CHOSEN", "{by}: {gnss}", "The parameter model is auto or iac, which go by GNSS.", ""),
    _Selected("MODEL_CHOSEN_AS", "{by}: {gnss}; {why}", "As MODEL_CHOSEN, and by what the data show beside.", ""),
    _Selected("GNSS_AVAILABLE", "GNSS is available", "References keep coming (gnss_timeout).", ""),
    _Selected("GNSS_NOT_AVAILABLE", "GNSS is not available", "No reference has come for gnss_timeout.", ""),
    _Selected(
        "GNSS_GOING",
        "GNSS has stopped; the model changes if it stays away for gnss_hysteresis",
        "No reference comes, but the outage is still short.",
        "",
    ),
    _Selected(
        "GNSS_COMING",
        "GNSS is back; the model changes if it stays for gnss_hysteresis",
        "References come again, but not for long yet.",
        "",
    ),
    _Selected(
        "HEADINGS_TELL_CURRENT",
        "headings tell a current from the mounting",
        "The mounting turns with the vehicle, a current does not.",
        "",
    ),
    _Selected(
        "HEADINGS_TOO_FEW",
        "no attitude over headings that would tell a current from the mounting",
        "On one heading, or without an IMU, a current looks like a mounting.",
        "",
    ),
    _Selected("TRIM_KNOWN", "the trim is known", "The IMU gives roll and pitch, which a model with attitude uses.", ""),
    _Selected(
        "ARM_LOOKS_LIKE_ANGLE",
        "on this track a {metres:g} m error of the lever arm looks like {degrees:.1f}° of {angle}",
        "Turns to one side at one speed do not tell a lever arm from an angle.",
        "",
    ),
    _Selected(
        "POSITIONS_NOISY",
        "velocities made of the positions would be off by {noise:.1f} m/s, so these are compared over legs",
        "Positions with metres of noise: USBL, plain GPS.",
        "",
    ),
    _Selected(
        "POSITIONS_SELDOM",
        "positions come too seldom to make velocities of them, so these are compared over legs",
        "More than three times position_window between two.",
        "",
    ),
)
