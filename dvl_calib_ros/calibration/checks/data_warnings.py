"""Warnings from a calibration's counts and estimates, for the replay and for /diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...verdict.reasons import Reason, finding
from ..models.parameters import Parameters
from ..numerics.robust import FEWEST_SAMPLES
from ..results.results import ARM, OFFSETS, TAPE_STD_M, Estimate

# Share of gated samples above which the configuration is more likely wrong than the data.
SUSPICIOUS_GATED = 0.2
# Share of exactly repeated DVL velocities above which the driver repeats stale data. Share of samples without attitude
# or turn rate, such as those before the IMU's first, that changes no answer.
SUSPICIOUS_REPEATED, UNIMPORTANT_SHARE = 0.05, 0.01
# Largest error of an intact reference, in `reference_offset_std`.
MAX_OFFSET_RATIO = 4.0
# Share of the reference error that yaw absorbs, above which the two are not separable.
INSEPARABLE_SHARE = 0.6
# Uncertainty due to a clock offset that is reported: delay (s), yaw (°); a lever arm from `TAPE_STD_M`.
REPORTED_FROM_S, REPORTED_FROM_DEG = 0.05, 0.1
# GNSS losses from which reception is unstable.
FLAPPING = 3

STREAMS = {"dvl": "DVL", "reference": "GNSS", "imu": "IMU"}
_MESSAGE_FAULTS = {
    "invalid": "SAMPLES_INVALID",
    "duplicate": "STAMP_REPEATED",
    "out_of_order": "STAMP_OUT_OF_ORDER",
    "stray": "STAMP_STRAY",
    "late": "SAMPLES_LATE",
    "before_restart": "SAMPLES_BEFORE_RESTART",
}


def message_warnings(counts: Mapping[str, Mapping[str, int]]) -> list[Reason]:
    """Return warnings on rejected messages of each stream, from `Calibrator.counts`."""
    return [
        finding(code, count=counts[stream][fault], stream=name)
        for stream, name in STREAMS.items()
        for fault, code in _MESSAGE_FAULTS.items()
        if counts[stream].get(fault)
    ]


def recording_warnings(counts: Mapping[str, Mapping[str, int]]) -> list[Reason]:
    """Return warnings on the data received, from `Calibrator.counts`."""
    dvl, pairing = counts["dvl"], counts["pairing"]
    found = []
    if dvl["received"] >= FEWEST_SAMPLES and not dvl["accepted"]:
        reasons = ", ".join(f"{count} {name}" for name, count in dvl.items() if count and name != "received")
        found.append(finding("DVL_NONE_USABLE", count=dvl["received"], reasons=reasons))
    if _none_is_paired(counts):
        found.append(finding("DVL_NO_REFERENCE"))
    if pairing["without_attitude"] > UNIMPORTANT_SHARE * dvl["received"]:
        found.append(finding("REFERENCE_NO_ATTITUDE", count=pairing["without_attitude"]))
    if dvl["dropouts"]:
        found.append(finding("DVL_DROPOUTS", count=dvl["dropouts"]))
    if dvl["frozen"]:
        found.append(finding("DVL_FROZEN", count=dvl["frozen"]))
    elif dvl["repeated"] >= FEWEST_SAMPLES and dvl["repeated"] > SUSPICIOUS_REPEATED * dvl["usable"]:
        found.append(finding("DVL_REPEATS", count=dvl["repeated"]))
    if pairing["gnss_losses"] >= FLAPPING:
        found.append(finding("GNSS_LOSSES", count=pairing["gnss_losses"]))
    if dvl["no_turn_rate"]:
        found.append(finding("NO_TURN_RATE", count=dvl["no_turn_rate"]))
    if dvl.get("lever_arm_uncompensated", 0) > UNIMPORTANT_SHARE * dvl["received"]:
        found.append(finding("LEVER_ARM_NOT_COMPENSATED", count=dvl["lever_arm_uncompensated"]))
    for name, count in counts["calibration"].items():
        if count and name.endswith(" restarted"):
            found.append(finding("MODEL_RESTARTED", model=name.removesuffix(" restarted"), count=count))
    if dvl["accepted"] and dvl["slow"] == dvl["accepted"]:
        found.append(finding("ALL_SLOW"))
    return found


def _none_is_paired(counts: Mapping[str, Mapping[str, int]]) -> bool:
    """Return whether enough valid DVL and reference samples arrived, but none could be paired."""
    reference, pairing = counts["reference"], counts["pairing"]
    usable = 2 * reference["received"] - sum(reference.values())
    if pairing["paired"] or pairing["without_attitude"]:
        return False
    return usable >= FEWEST_SAMPLES and pairing["unpaired"] >= FEWEST_SAMPLES


def gate_warnings(estimate: Estimate) -> list[Reason]:
    """Return a warning if a model's gate rejects so many samples that the configuration must be wrong."""
    given = estimate.used + estimate.gated
    if given < FEWEST_SAMPLES or estimate.gated <= SUSPICIOUS_GATED * given:
        return []
    return [finding("SAMPLES_GATED", model=estimate.model, gated=estimate.gated, given=given)]


def consistency_warnings(estimate: Estimate) -> list[Reason]:
    """Return a warning if a model's innovations exceed their predicted covariance; smaller ones only enlarge σ."""
    if estimate.used < FEWEST_SAMPLES or estimate.mean_nis <= estimate.nis_bounds[1]:
        return []
    return [finding("INNOVATIONS_LARGE", model=estimate.model, nis=estimate.mean_nis, limit=estimate.nis_bounds[1])]


def one_heading_warnings(estimate: Estimate, parameters: Parameters, speed: float) -> list[Reason]:
    """Return a warning if only priors separate a constant velocity error from yaw and scale. speed: usual, m/s."""
    names, assumed = estimate.state_names, parameters.reference_offset_std
    if OFFSETS[0] not in names or not estimate.used or speed <= 0.0:
        return []
    offset_states = [names.index(name) for name in OFFSETS]
    body_z, p = parameters.rotation_dvl_from_body[:, 2], estimate.filter_covariance
    yaw_by_offset = np.linalg.solve(p[np.ix_(offset_states, offset_states)], p[offset_states, :3] @ body_z)
    if float(np.linalg.norm(yaw_by_offset)) * speed < INSEPARABLE_SHARE:
        return []
    largest_offset = MAX_OFFSET_RATIO * assumed
    share = largest_offset / speed
    return [finding("ONE_HEADING", off=largest_offset, degrees=math.degrees(share), percent=100.0 * share)]


def reference_warnings(estimate: Estimate) -> list[Reason]:
    """Return warnings on a clock offset that leaves lever arm or yaw uncertain."""
    if estimate.std_of(*OFFSETS) is None:
        return []
    reasons = []
    open_std = np.sqrt(np.diag(estimate.left_open))
    if open_std.any():
        by_name = dict(zip(estimate.state_names, open_std.tolist(), strict=True))
        metres = math.hypot(*(by_name.get(name, 0.0) for name in ARM))
        degrees = math.degrees(float(np.linalg.norm(open_std[:3])))
        seconds = by_name.get("time_offset", 0.0)
        if metres >= TAPE_STD_M or seconds >= REPORTED_FROM_S:
            reasons.append(finding("CLOCK_OR_ARM", metres=metres, degrees=degrees, seconds=seconds))
        elif degrees >= REPORTED_FROM_DEG:  # the lever arm is configured
            reasons.append(finding("CLOCK_ON_TURN", degrees=degrees))
    return reasons
