"""Where the messages of a calibration went."""

from __future__ import annotations

from collections.abc import Mapping

from .alignment import Aligner


def counted(
    aligner: Aligner, gnss_losses: int, restarts: int, restarted: Mapping[str, int]
) -> dict[str, dict[str, int]]:
    """Counts by kind and reason, since the start or the last restart.

    dvl: received = invalid + duplicate + out_of_order + stray + held + refused ones (`Calibrator.refuse`) + accepted;
    accepted = slow + frozen + turning + no_turn_rate + usable + awaiting_imu; repeated and dropouts are counted
    beside these. pairing: accepted and decided = paired + unpaired; awaiting_reference is the rest. usable = oriented +
    not_oriented (no attitude or no angular velocity) + awaiting_attitude. A model's used + gated (+ samples in its
    prior window) is what it was given: usable samples, for the models with GNSS those that were paired, for those with
    attitude the oriented ones.

    gnss_losses: how often the reference stayed away. restarts: of the calibration; restarted: of single models.
    """
    counts = {name: dict(tally) for name, tally in aligner.tally.items()}
    for stream, order in aligner.orders.items():
        own = counts[stream.value]
        own["stray"], own["held"] = order.stray, int(order.held is not None)
        for key in ("received", "invalid", "duplicate", "out_of_order"):
            own.setdefault(key, 0)
    dvl, pairing = counts["dvl"], counts["pairing"]
    unused = ("slow", "frozen", "turning", "no_turn_rate")
    for key in (*unused, "dropouts", "wrong_frame"):
        dvl.setdefault(key, 0)
    dvl["repeated"] = aligner.partners.gates.repeated
    for key in ("wrong_frame", "late"):
        counts["reference"].setdefault(key, 0)
    for key in ("paired", "unpaired", "without_attitude", "oriented", "not_oriented"):
        pairing.setdefault(key, 0)
    not_accepted = {"invalid", "duplicate", "out_of_order", "stray", "held", *aligner.refused_as["dvl"]}
    dvl["accepted"] = dvl["received"] - sum(dvl.get(key, 0) for key in not_accepted)
    dvl["awaiting_imu"] = aligner.rows.end - aligner.partners.n_judged
    dvl["usable"] = dvl["accepted"] - sum(dvl[key] for key in (*unused, "awaiting_imu"))
    pairing["gnss_losses"] = gnss_losses
    pairing["awaiting_reference"] = aligner.partners.n_judged - aligner.partners.n_paired
    pairing["awaiting_attitude"] = dvl["usable"] - pairing["oriented"] - pairing["not_oriented"]
    counts["calibration"] = {"restarts": restarts}
    counts["calibration"] |= {f"{name} restarted": number for name, number in restarted.items() if number}
    return counts
