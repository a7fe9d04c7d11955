"""What a calibration's counts say that a user must not overlook: sentences, for the replay and for /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping

from .results import Estimate

# Share of gated samples above which the configuration is more likely wrong than the data.
SUSPICIOUS_GATED = 0.2
# Fewer samples say nothing yet.
ENOUGH_SAMPLES = 20
# Share of DVL velocities that repeat the one before exactly above which its driver hangs.
SUSPICIOUS_REPEATED = 0.05
# So many losses of GNSS are flapping.
FLAPPING = 3

_STREAMS = {"dvl": "DVL", "reference": "GNSS", "imu": "IMU"}
_MESSAGE_FAULTS = {
    "invalid": "are invalid (not finite, above max_speed, or with an impossible covariance): check the sensor, its "
    "bottom lock or fix, and its driver",
    "duplicate": "repeat the stamp of the one before: is there a second publisher, or a driver that sends twice?",
    "out_of_order": "are older than the one before: is there a second publisher on the topic, or was a clock set back?",
    "stray": "are more than max_time_jump from their neighbours in time: check the clock of the driver",
    "late": "came after a DVL sample had gone on without them: raise max_latency",
    "before_restart": "were from before the clock was set back or the bag looped",
}

INITIAL_WINDOW_WARNING = (
    "prior_source initial_window: the mean of the DVL's own first seconds already holds the misalignment, so M5 and "
    "M6 gain nothing over no calibration; prefer fixed"
)


def message_advice(counts: Mapping[str, Mapping[str, int]]) -> list[str]:
    """What is wrong with messages of each stream that were not used, and the remedy; from `Calibrator.counts`."""
    sentences = []
    for stream, name in _STREAMS.items():
        for fault, what in _MESSAGE_FAULTS.items():
            count = counts[stream].get(fault, 0)
            if count:
                sentences.append(f"{count} {name} samples {what}; they are not used")
    return sentences


def data_advice(counts: Mapping[str, Mapping[str, int]]) -> list[str]:
    """What is wrong with the data that came, and the remedy; from `Calibrator.counts`."""
    dvl, pairing = counts["dvl"], counts["pairing"]
    sentences = []
    if dvl["received"] >= ENOUGH_SAMPLES and not dvl["accepted"]:
        lost = ", ".join(f"{count} {name}" for name, count in dvl.items() if count and name != "received")
        sentences.append(f"none of {dvl['received']} DVL messages can be used: {lost}")
    if _never_meet(counts):
        sentences.append(
            "no DVL sample has a reference velocity at its time, though both come: do their stamps agree? A DVL that "
            "stamps with a clock of its own must be synchronised (NTP)"
        )
    if pairing["without_attitude"]:
        sentences.append(
            f"{pairing['without_attitude']} DVL samples have an earth-frame reference but no attitude: the models with "
            "GNSS cannot use them; is the IMU topic right, and does it give an orientation?"
        )
    if dvl["dropouts"]:
        sentences.append(f"the DVL dropped out {dvl['dropouts']} times: check its power, cable and bottom lock")
    if dvl["frozen"]:
        sentences.append(
            f"{dvl['frozen']} DVL samples repeat one velocity more than max_repeats times: its driver hangs"
        )
    elif dvl["repeated"] >= ENOUGH_SAMPLES and dvl["repeated"] > SUSPICIOUS_REPEATED * dvl["usable"]:
        sentences.append(
            f"{dvl['repeated']} DVL samples repeat the velocity before exactly and are used: if its driver hangs, set "
            "max_repeats"
        )
    if pairing["gnss_losses"] >= FLAPPING:
        sentences.append(
            f"GNSS was lost {pairing['gnss_losses']} times: check its antenna; if models switch to and fro, raise "
            "gnss_hysteresis"
        )
    if dvl["no_turn_rate"]:
        sentences.append(f"{dvl['no_turn_rate']} samples have no angular velocity for max_turn_rate and are not used")
    if dvl.get("lever_arm_uncompensated"):
        count = dvl["lever_arm_uncompensated"]
        sentences.append(f"lever_arm is not compensated in {count} samples: no angular velocity")
    if dvl["accepted"] and dvl["slow"] == dvl["accepted"]:
        sentences.append("every sample is slower than min_speed: nothing is learnt")
    return sentences


def _never_meet(counts: Mapping[str, Mapping[str, int]]) -> bool:
    """Whether valid DVL and reference samples come, and enough of them have gone by without a single pair."""
    reference, pairing = counts["reference"], counts["pairing"]
    usable = 2 * reference["received"] - sum(reference.values())
    if pairing["paired"] or pairing["without_attitude"]:
        return False
    return usable >= ENOUGH_SAMPLES and pairing["unpaired"] >= ENOUGH_SAMPLES


def gate_advice(estimate: Estimate) -> list[str]:
    """Whether a model's gate throws away so much that the configuration must be wrong."""
    given = estimate.used + estimate.gated
    if given < ENOUGH_SAMPLES or estimate.gated <= SUSPICIOUS_GATED * given:
        return []
    return [
        f"{estimate.model}: {estimate.gated} of {given} samples are gated; check mounting_rpy and the frames before "
        "believing it"
    ]


def consistency_advice(estimate: Estimate) -> list[str]:
    """Whether a model's innovations are larger than it believes; smaller ones only make σ too large."""
    if estimate.used < ENOUGH_SAMPLES or estimate.mean_nis <= estimate.nis_bounds[1]:
        return []
    return [
        f"{estimate.model}: innovations are larger than R and P allow (mean NIS {estimate.mean_nis:.1f}, at most "
        f"{estimate.nis_bounds[1]:.1f}): σ is too small, raise gnss_aided_std or gnss_free_std"
    ]
