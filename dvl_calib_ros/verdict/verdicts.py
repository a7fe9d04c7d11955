"""Why a calibration is to be used, to be used with care, or not to be used: the reasons of its verdict."""

from __future__ import annotations

from dataclasses import replace

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
        "there is nothing to apply",
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
        "set the clocks by one source, correct the recording's stamps",
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
