"""Iterative correction of a simulator's DVL: correct the differences, simulate its motion again, compare again.

The corrected object is the document of the vehicle's diagnosis, as read by `export` and `simulate --diagnosis`. So each
round's DVL can be given to a simulator.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..bags.writer import Compression, Storage
from ..calibration.models.parameters import Parameters
from ..diagnosis.answer.results import Diagnosis, diagnosis_document
from ..diagnosis.model.hypothesis import amplitudes
from ..disk.text_files import write_json
from ..effects.registry import EFFECTS
from ..errors import InputError
from ..recordings.recording import open_recording
from ..recordings.topics import Topics
from ..simulation.found_effects import with_dvl
from ..simulation.recorded_motion import MotionSource
from ..simulation.scenario import Scenario, write_bag
from ..simulator_export.dvl_description import load_description
from ..verdict.answering import Answering
from ..verdict.reasons import Reason, finding
from .both_sides import RecordedSide, read_log
from .comparison import CLAIMED, compare, compare_logs, other_frame
from .effect_comparison import is_of_every_run
from .results import ComparedEffect, SimulatorVerdict, Triple, UnpairedComparison, unpaired_document

MOST_ROUNDS = 9
# the simulator's velocity is exact: only the corners between its samples are smoothed
SMOOTHING_S = 0.2
TRUTH_HZ = 10.0
# codes of a comparison's reasons that remain valid next to the differences in effects
REMAINING = ("SIMULATOR_NOISE", "SIMULATOR_UNKNOWN_REST")


@dataclass(frozen=True)
class Round:
    """One round. dvl: document of the simulated DVL; None for the simulator as recorded."""

    comparison: UnpairedComparison
    dvl: Mapping[str, Any] | None = None

    @property
    def error_mps(self) -> float:
        """Return the held-out RMS error, m/s, on the vehicle's own motion; nan without a comparison."""
        rungs = self.comparison.rungs
        return rungs[0].error_mps if rungs else float("nan")

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the effects of the simulated DVL."""
        return () if self.dvl is None else tuple(effect["name"] for effect in self.dvl["effects"])

    @property
    def claims(self) -> tuple[str, ...]:
        """Return the effects and noise properties that differ from the vehicle's."""
        effects = [effect.name for effect in self.comparison.effects if effect.status.is_claim]
        return (*effects, *(entry.name for entry in self.comparison.noise if entry.status.is_claim))


@dataclass(frozen=True, repr=False)
class ClosedGap(Answering):
    """Simulator corrected in rounds. rounds: the first is the simulator as recorded."""

    rounds: tuple[Round, ...]

    @property
    def best(self) -> int:
        """Return the index of the round with the fewest differences in effects and, among these, the smallest error."""

        def worth(index: int) -> tuple[int, float]:
            each = self.rounds[index]
            return sum(effect.status.is_claim for effect in each.comparison.effects), each.error_mps

        return min(range(len(self.rounds)), key=worth)

    @property
    def verdict(self) -> SimulatorVerdict:
        """Return the verdict of the best round."""
        return self.rounds[self.best].comparison.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Return the reduction of the gap, the differences found, and the differences that remain in the best round."""
        first, best = self.rounds[0], self.rounds[self.best]
        if len(self.rounds) == 1:
            return (*first.comparison.reasons, finding("SIMULATOR_NO_ROUNDS"))
        floor = 1e3 * best.comparison.floor_mps
        before, after = 1e3 * first.error_mps, 1e3 * best.error_mps
        added = " and ".join(best.effects) or "the vehicle's noise"
        outcome = finding("SIMULATOR_ROUNDS", round=self.best, names=added, before=before, after=after, floor=floor)
        if self.best == 0:
            outcome = finding("SIMULATOR_ROUNDS_IN_VAIN", before=before, floor=floor)
        found = tuple(each for each in first.comparison.reasons if each.code in (*CLAIMED.values(), "SIMULATOR_FRAME"))
        remaining = tuple(reason for reason in best.comparison.reasons if reason.code in REMAINING)
        names = ", ".join(effect.name for effect in best.comparison.effects if effect.status.is_claim)
        not_added = (finding("SIMULATOR_NOT_ADDED", names=names),) if names and self.best else ()
        return (outcome, *found, *not_added, *remaining)


def close_gap(
    vehicle: RecordedSide,
    simulator: RecordedSide,
    rounds: int,
    folder: Path,
    on_progress: Callable[[float], None] = lambda _: None,
) -> ClosedGap:
    """Compare; then repeatedly correct the differences, simulate the simulator's motion and compare again.

    It stops early if no correctable difference remains. The existing folder then has, for each round, ROUND.json (the
    DVL for `export` and `simulate --diagnosis`) and ROUND, or ROUND_NUMBER with several bags.

    Parameters
    ----------
    vehicle, simulator: Both sides.
    rounds: Largest number of rounds.
    folder: Folder for simulated bags.
    on_progress: Receives the finished share.

    Raises
    ------
    InputError
        If the sides cannot be compared, or the simulator's log has no attitude and so no motion.
    """
    topics = simulator.topics.found_in(simulator.opened.types)
    for path, recording in zip(simulator.opened.paths, simulator.opened.each, strict=True):
        if topics.imu not in recording.types:
            raise InputError(
                f"{path}: no attitude on {topics.imu}, so rounds have no motion to simulate on; record sensor_msgs/Imu "
                "in the simulator, or compare without rounds"
            )
    steps = 2 + rounds

    def share_of_step(number: int) -> Callable[[float], None]:
        return lambda share: on_progress((number + share) / steps)

    real = read_log(vehicle, share_of_step(0))
    as_recorded = compare_logs(real, read_log(simulator, share_of_step(1)))
    compared = [Round(replace(as_recorded, reasons=(*as_recorded.reasons, *other_frame(vehicle, simulator))))]
    document = None if real.diagnosis.dvl is None else diagnosis_document(real.diagnosis)
    while document is not None and compared[-1].claims and len(compared) <= rounds:
        if len(compared) > 1:
            corrected = corrected_document(document, compared[-1].comparison)
            if corrected == document:
                break
            document = corrected
        simulated = _simulated(document, len(compared), simulator, folder, real.diagnosis)
        log = read_log(simulated, share_of_step(1 + len(compared)))
        log = replace(log, facts=tuple(replace(fact, latency=np.zeros(0)) for fact in log.facts))  # no real log times
        compared.append(Round(compare_logs(real, log), document))
    on_progress(1.0)
    return ClosedGap(tuple(compared))


def check_rounds(rounds: int | None, keep: Path | None) -> None:
    """Raise InputError for an invalid number of rounds, or a folder that exists or has no rounds."""
    if rounds is not None and not 1 <= rounds <= MOST_ROUNDS:
        raise InputError(f"rounds: {rounds} is outside 1 .. {MOST_ROUNDS}")
    if keep is None:
        return
    if rounds is None:
        raise InputError("keep works only with rounds")
    if os.path.lexists(keep):
        raise InputError(f"{keep}: exists already; give another folder, or remove it first")


def against(
    vehicle: RecordedSide,
    simulator: RecordedSide,
    rounds: int | None = None,
    keep: Path | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
    with_series: bool = False,
) -> UnpairedComparison | ClosedGap:
    """Compare both sides once, or in rounds as `close_gap`, in a new folder (`keep`) or a temporary one.

    Raises InputError, see `check_rounds`, `compare` and `close_gap`.
    """
    check_rounds(rounds, keep)
    if rounds is None:
        return compare(vehicle, simulator, on_progress, with_series=with_series)
    if keep is not None:
        keep.mkdir(parents=True)
        return close_gap(vehicle, simulator, rounds, keep, on_progress)
    with tempfile.TemporaryDirectory(prefix="dvl_calib_rounds_") as folder:
        return close_gap(vehicle, simulator, rounds, Path(folder), on_progress)


def corrected_document(document: Mapping[str, Any], comparison: UnpairedComparison) -> dict[str, Any]:
    """Return a DVL's document corrected by the differences in effects, noise and rate."""
    corrected: dict[str, Any] = deepcopy(dict(document))
    by_name = {effect["name"]: effect for effect in corrected["effects"]}
    for compared in (effect for effect in comparison.effects if effect.status.is_claim):
        effect = EFFECTS[compared.name]
        if not is_of_every_run(effect) or any(" of " in key for key in compared.vehicle):
            continue  # differs per recording, or happens at a time of a run that the simulator's may not have
        entry = by_name.get(effect.name)
        if entry is None:
            entry = {"name": effect.name, "equivalent_to": [], "parameters": {}}
            corrected["effects"].append(entry)
        for spec in amplitudes(effect):
            if not (difference := _difference(compared, spec.name)):
                continue
            at = entry["parameters"].setdefault(spec.name, {"value": spec.default})
            value = at["value"] + difference
            entry["parameters"][spec.name] = {"value": min(max(value, spec.low), spec.high)}
    dvl = corrected["dvl"]
    differ = {entry.name: entry for entry in comparison.noise if entry.status.is_claim}
    if "rate" in differ:
        dvl["rate_hz"] = differ["rate"].vehicle[0]
    levels = {axis: differ[name] for axis, name in enumerate(("level_x", "level_y", "level_z")) if name in differ}
    dvl["noise_std_mps"] = [
        std * levels[axis].vehicle[0] / levels[axis].simulator[0] if axis in levels else std
        for axis, std in enumerate(dvl["noise_std_mps"])
    ]
    return corrected


def _difference(compared: ComparedEffect, name: str) -> float:
    """Return vehicle minus simulator for a parameter, averaged over recordings; 0 if one side does not have it."""

    def size_on(side: Mapping[str, Triple]) -> list[float]:
        return [value for key, (value, _, _) in side.items() if key == name or key.startswith(f"{name} of ")]

    vehicle, simulator = size_on(compared.vehicle), size_on(compared.simulator)
    return sum(vehicle) / len(vehicle) - sum(simulator) / len(simulator) if vehicle and simulator else 0.0


def _simulated(
    document: Mapping[str, Any], number: int, simulator: RecordedSide, folder: Path, vehicle: Diagnosis
) -> RecordedSide:
    """Simulate bags of a DVL on the simulator's motions, and return how to read them."""
    source = folder / f"round_{number}.json"
    write_json(source, document)
    paths = simulator.opened.paths
    bags = [folder / (f"round_{number}" if len(paths) == 1 else f"round_{number}_{i + 1}") for i in range(len(paths))]
    for path, bag in zip(paths, bags, strict=True):
        motion = MotionSource(
            path, simulator.topics.gnss, simulator.topics.imu, simulator.parameters.gnss_frame, SMOOTHING_S
        )
        plain = Scenario(recording=motion, seed=number, gnss_rate=TRUTH_HZ, gnss_std=0.0)
        scenario, _ = with_dvl(plain, load_description(source))
        write_bag(scenario, bag, Storage.MCAP, Compression.NONE)
    known = vehicle.dvl
    if known is None:
        raise ValueError("the vehicle's DVL is not described")
    parameters = Parameters(
        mounting_rpy=known.mounting_rpy,
        lever_arm=known.lever_arm,
        dvl_time_offset=known.time_offset,
        dvl_clock_drift=known.clock_drift,
        min_speed=0.0,
    )
    return RecordedSide(open_recording(bags), parameters, Topics())


def closed_gap_document(closed: ClosedGap) -> dict[str, Any]:
    """Return the JSON of `diagnose --simulator --rounds --json`: comparison and DVL of each round."""
    return {
        "sentence": " ".join(reason.full_sentence for reason in closed.reasons),
        "reasons": [reason.as_dict() for reason in closed.reasons],
        "best": closed.best,
        "rounds": [
            {
                "error_mps": one_round.error_mps,
                "differs_in": list(one_round.claims),
                "dvl": one_round.dvl,
                "comparison": unpaired_document(one_round.comparison),
            }
            for one_round in closed.rounds
        ],
    }
