"""Reasons of a verdict, of a model's selection, and manoeuvres to drive next."""

from __future__ import annotations

from .kinds import accept, marginal, on_page, reject

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
        "the calibration leaves {open:.0f} m of drift per km open (1σ), more than {limit:.0f}",
        means="Up to five times `target_drift` is accepted.",
        remedy="drive on: other headings, other speeds, turns to both sides",
    ),
    # estimated values
    reject(
        "MISALIGNMENT_LARGE",
        "the misalignment is {degrees:.1f}°, and from {limit:.1f}° on it is rejected",
        means="Seldom the bracket.",
        remedy="is mounting_rpy right, and are the frames?",
    ),
    reject(
        "SCALE_LARGE",
        "a scale is {percent:.1f} % off, more than {limit:.1f} %",
        means="Wrong units, speed of sound or reference (`max_scale_error`).",
    ),
    accept(
        "MOUNTING_FAR",
        "inspect the mounting: it is {degrees:.1f}° from mounting_rpy, which is much (from {limit:.1f}° on)",
        means="The calibration may be good and the bracket bent (`accept_misalignment`).",
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
        "too few samples with a reference velocity to verify it on held-out data",
        means="Fewer than 20 samples, or all in one stretch.",
    ),
    marginal("HELD_OUT_OUTLIERS", _HELD_OUT + ", {typical:.3f} without outliers: there are many of them"),
    reject("HELD_OUT_WORSE", _HELD_OUT + ": the calibration makes it worse"),
    marginal("HELD_OUT_NO_BETTER", _HELD_OUT + ": the calibration makes no difference, perhaps for lack of data"),
    reject(
        "HELD_OUT_SEVERAL_TIMES",
        _HELD_OUT + ": the error is several times the predicted one",
        means="More than three times.",
        remedy="the configuration is wrong, or an effect is missing from the model (dvl-calib diagnose looks for it)",
    ),
    reject(
        "HELD_OUT_IMPLAUSIBLE",
        _HELD_OUT + ": implausibly small, as if the DVL were fused into the reference, which then cannot judge it",
        remedy="take GNSS alone",
    ),
    marginal(
        "HELD_OUT_NOISIER",
        _HELD_OUT + ": the reference is noisier than it says, or an effect is missing from the model",
        means="Limit: `max_error_ratio`.",
    ),
    # dead reckoning
    marginal(
        "DRIFT_NO_BETTER",
        "on data held out dead reckoning gets no better: {after:.1f} m per km with it, {before:.1f} as mounted",
        means="The velocity fits better, but a lasting error remains.",
    ),
    reject(
        "DRIFT_WORSE",
        "on data held out dead reckoning drifts by {after:.1f} m per km with it, by {before:.1f} as mounted",
        remedy="an effect is missing from the model (dvl-calib diagnose looks for it)",
    ),
    # clocks
    reject(
        "CLOCKS_APART",
        "{whose} stamps are {seconds:.1f} s {side} {other} that arrived at the same time{known}",
        remedy="set the clocks by one source; this recording: --restamp log (recording times)",
    ),
    # several recordings
    reject(
        "BAGS_OVERLAP",
        "{first} and {second} hold the DVL at the same time, so of many samples only the first is used",
        means="One recording twice, or two DVLs.",
        remedy="replay each by itself, and compare them",
    ),
    reject(
        "BAGS_MOUNTING_DIFFERS",
        "the mounting differs {moved} {between}: the average of all is the mounting of none",
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
    accept("NEXT_FASTER", "drive straight, at {speed:.1f} m/s", means="Angles show in proportion to the speed."),
    accept("NEXT_SPEEDS", "speed up and slow down by half", means="Accelerations show a delay, two speeds a bias."),
    accept("NEXT_CIRCLE", "circle to {side}", means="Turns show the lever arm and average earth-fixed errors."),
    accept("NEXT_EIGHT", "drive a figure eight", means="Turns to both sides separate lever arm and yaw."),
    accept("NEXT_DIVE", "dive and rise by 10° of pitch", means="Pitching shows the vertical axis."),
    accept("NEXT_WAIT", "keep on: nothing is learnt yet"),
    accept("NEXT_REJECTED", "nothing: the findings say why this calibration is not to be used"),
    accept("NEXT_STANDS", "keep on: the goal is reached, if it stays so"),
    accept("NEXT_IS_GOOD", "good enough: save"),
    accept("NEXT_IS_GOOD_BUT_SCALE", "as good as it gets without a reference: save; the scale stays unknown"),
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
        remedy="Wait for the reference, or name the model.",
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
    accept("GNSS_GOING", "GNSS has stopped; the model changes if it stays away for gnss_hysteresis"),
    accept("GNSS_COMING", "GNSS is back; the model changes if it stays for gnss_hysteresis"),
    accept("HEADINGS_TELL_CURRENT", "headings distinguish a current from the mounting"),
    accept(
        "HEADINGS_TOO_FEW",
        "no attitude over headings that would distinguish a current from the mounting",
        means="On one heading, or without an IMU, a current looks like a mounting.",
    ),
    accept("TRIM_KNOWN", "the trim is known", means="The IMU gives roll and pitch."),
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
