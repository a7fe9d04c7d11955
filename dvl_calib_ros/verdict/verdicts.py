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
    # use of the samples
    Kind(
        "NO_SAMPLE_USED",
        "no sample was used",
        "No reference, no attitude, or every sample was refused.",
        "there is nothing to apply",
        Severity.REJECT,
    ),
    Kind(
        "MOST_SAMPLES_GATED",
        "{gated} of {given} samples were rejected as outliers; the estimate describes only the other {used}",
        "Most data contradict the estimate: check the configuration.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "NOTHING_COMPARED",
        "there is no IMU, so no DVL sample can be compared with the reference",
        "",
        "record the IMU's topic, with orientation",
        Severity.REJECT,
    ),
    Kind(
        "NO_ANGLE_SHOWN",
        "none of the angles is observable in the data yet",
        "σ of each angle is still that of the prior: drive more.",
        "",
        Severity.REJECT,
    ),
    Kind(
        "DRIFT_OPEN",
        "the calibration leaves {open:.0f} m of drift per km open (1σ), more than {limit:.0f}",
        "Up to five times `target_drift` is accepted.",
        "drive on: other headings, other speeds, turns to both sides",
        Severity.MARGINAL,
    ),
    # estimated values
    Kind(
        "MISALIGNMENT_LARGE",
        "the misalignment is {degrees:.1f}°, and from {limit:.1f}° on it is rejected",
        "Seldom the bracket.",
        "are mounting_rpy, the frames and a compass's declination right?",
        Severity.REJECT,
    ),
    Kind(
        "SCALE_LARGE",
        "a scale is {percent:.1f} % off, more than {limit:.1f} %",
        "Wrong units, speed of sound or reference (`max_scale_error`).",
        "",
        Severity.REJECT,
    ),
    Kind(
        "MOUNTING_FAR",
        "inspect the mounting: it is {degrees:.1f}° from mounting_rpy, which is much (from {limit:.1f}° on)",
        "The calibration may be good and the bracket bent (`accept_misalignment`).",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "LEVER_ARM_NOT_SHOWN",
        "the lever arm is poorly observable, and {turns}",
        "σ includes it.",
        "give lever_arm and initial_std_lever_arm, or go straight and turn both ways",
        Severity.MARGINAL,
    ),
    Kind(
        "LEVER_ARM_TURNS_ANGLE",
        "the lever arm is known to ±{std:.2g} m, and {turns}",
        "This model assumes the arm.",
        "give lever_arm and initial_std_lever_arm, or go straight and turn both ways",
        Severity.REJECT,
    ),
    # errors on held-out data
    Kind(
        "HELD_OUT",
        _HELD_OUT,
        "",
        "",
        Severity.ACCEPT,
    ),
    Kind(
        "HELD_OUT_TOO_FEW",
        "too few samples with a reference velocity to verify it on held-out data",
        "Fewer than 20 samples, or all in one stretch.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_OUTLIERS",
        _HELD_OUT + ", {typical:.3f} without outliers: there are many of them",
        "",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_WORSE",
        _HELD_OUT + ": the calibration makes it worse",
        "",
        "",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_NO_BETTER",
        _HELD_OUT + ": the calibration makes no difference, perhaps for lack of data",
        "",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "HELD_OUT_SEVERAL_TIMES",
        _HELD_OUT + ": the error is several times the predicted one",
        "More than three times.",
        "the configuration is wrong, or an effect is missing from the model (dvl-calib diagnose looks for it)",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_IMPLAUSIBLE",
        _HELD_OUT + ": implausibly small, as if the DVL were fused into the reference, which then cannot judge it",
        "",
        "take GNSS alone",
        Severity.REJECT,
    ),
    Kind(
        "HELD_OUT_NOISIER",
        _HELD_OUT + ": the reference is noisier than it says, or an effect is missing from the model",
        "Limit: `max_error_ratio`.",
        "",
        Severity.MARGINAL,
    ),
    # dead reckoning
    Kind(
        "DRIFT_NO_BETTER",
        "on data held out dead reckoning gets no better: {after:.1f} m per km with it, {before:.1f} as mounted",
        "The velocity fits better, but a lasting error remains.",
        "",
        Severity.MARGINAL,
    ),
    Kind(
        "DRIFT_WORSE",
        "on data held out dead reckoning drifts by {after:.1f} m per km with it, by {before:.1f} as mounted",
        "",
        "an effect is missing from the model (dvl-calib diagnose looks for it)",
        Severity.REJECT,
    ),
    # clocks
    Kind(
        "CLOCKS_APART",
        "{whose} stamps are {seconds:.1f} s {side} {other} that arrived at the same time{known}",
        "",
        "set the clocks by one source; this recording: --restamp log (recording times)",
        Severity.REJECT,
    ),
    # several recordings
    Kind(
        "BAGS_OVERLAP",
        "{first} and {second} hold the DVL at the same time, so of many samples only the first is used",
        "One recording twice, or two DVLs.",
        "replay each by itself, and compare them",
        Severity.REJECT,
    ),
    Kind(
        "BAGS_MOUNTING_DIFFERS",
        "the mounting differs {moved} {between}: the average of all is the mounting of none",
        "",
        "",
        Severity.REJECT,
    ),
    Kind(
        "BAGS_DELAY_CHANGED",
        "the delay of the DVL's stamps differs between recordings, but one delay is used for recordings that follow "
        "each other so closely",
        "",
        "calibrate each by itself",
        Severity.REJECT,
    ),
)
VERDICTS = tuple(replace(kind, page="troubleshooting.md#reasons-of-a-verdict") for kind in _KINDS)


_Said = partial(Kind, page="troubleshooting.md#what-to-drive-next", severity=Severity.ACCEPT, remedy="")
MANOEUVRES = (
    _Said(
        "NEXT_LEG", "drive straight, {name} ({compass:.0f}°)", "Another heading separates a current from the mounting."
    ),
    _Said("NEXT_AHEAD", "drive straight ahead", "Motion ahead makes yaw, pitch and scale observable."),
    _Said("NEXT_FASTER", "drive straight, at {speed:.1f} m/s", "Angles show in proportion to the speed."),
    _Said("NEXT_SPEEDS", "speed up and slow down by half", "Accelerations show a delay, two speeds a bias."),
    _Said("NEXT_CIRCLE", "circle to {side}", "Turns show the lever arm and average earth-fixed errors."),
    _Said("NEXT_EIGHT", "drive a figure eight", "Turns to both sides separate lever arm and yaw."),
    _Said("NEXT_DIVE", "dive and rise by 10° of pitch", "Pitching shows the vertical axis."),
    _Said("NEXT_WAIT", "keep on: nothing is learnt yet", ""),
    _Said(
        "NEXT_REJECTED",
        "nothing: the findings say why this calibration is not to be used",
        "",
    ),
    _Said(
        "NEXT_STANDS",
        "keep on: the goal is reached, if it stays so",
        "",
    ),
    _Said("NEXT_IS_GOOD", "good enough: save", ""),
    _Said(
        "NEXT_IS_GOOD_BUT_SCALE",
        "as good as it gets without a reference: save; the scale stays unknown",
        "",
    ),
    _Said(
        "LONGER_AS_DRIFT_GREW",
        "it takes longer than promised: the predicted drift has grown from {before:.1f} to {now:.1f} m per km",
        "",
    ),
    _Said(
        "LONGER_AS_LITTLE_SHOWN",
        "it takes longer than promised: the motion since then was less informative than the suggested one "
        "({before:.1f} m per km then, {now:.1f} now)",
        "",
    ),
    _Said(
        "WORTH_OF_ANOTHER_MODEL",
        "no longer good enough: the model is {model} now",
        "`auto` follows the reference; in an outage it uses a model without one.",
        remedy="Wait for the reference, or name the model.",
    ),
    _Said(
        "WORTH_HAS_FALLEN",
        "no longer good enough: the predicted drift has grown to {worth:.1f} m per km",
        "",
        remedy="Drive on. If it happens again, look for the cause with `dvl-calib doctor`.",
    ),
)


_Selected = partial(Kind, page="troubleshooting.md#why-a-model-is-selected", severity=Severity.ACCEPT)
SELECTIONS = (
    _Selected("MODEL_NAMED", "set by parameter model", "", ""),
    _Selected("MODEL_CHOSEN", "{by}: {gnss}", "", ""),
    _Selected("MODEL_CHOSEN_AS", "{by}: {gnss}; {why}", "", ""),
    _Selected("GNSS_AVAILABLE", "GNSS is available", "", ""),
    _Selected("GNSS_NOT_AVAILABLE", "GNSS is not available", "No reference for `gnss_timeout`.", ""),
    _Selected(
        "GNSS_GOING",
        "GNSS has stopped; the model changes if it stays away for gnss_hysteresis",
        "",
        "",
    ),
    _Selected(
        "GNSS_COMING",
        "GNSS is back; the model changes if it stays for gnss_hysteresis",
        "",
        "",
    ),
    _Selected(
        "HEADINGS_TELL_CURRENT",
        "headings distinguish a current from the mounting",
        "",
        "",
    ),
    _Selected(
        "HEADINGS_TOO_FEW",
        "no attitude over headings that would distinguish a current from the mounting",
        "On one heading, or without an IMU, a current looks like a mounting.",
        "",
    ),
    _Selected("TRIM_KNOWN", "the trim is known", "The IMU gives roll and pitch.", ""),
    _Selected(
        "ARM_LOOKS_LIKE_ANGLE",
        "on this track a {metres:g} m error of the lever arm looks like {degrees:.1f}° of {angle}",
        "Turns to one side at one speed confuse lever arm and angle.",
        "",
    ),
    _Selected(
        "POSITIONS_NOISY",
        "velocities from the positions would have {noise:.1f} m/s of noise, so positions are compared over legs",
        "",
        "",
    ),
    _Selected(
        "POSITIONS_SELDOM",
        "positions are too infrequent for velocities, so they are compared over legs",
        "Positions more than three `position_window` apart are compared over legs.",
        "",
    ),
)
