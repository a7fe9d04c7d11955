"""The loop closed: a simulator's DVL put right by what a comparison found, simulated on its own motion, compared again.

What is put right from round to round is the document of the vehicle's diagnosis, as `export` and `simulate --diagnosis`
read it: so every round's is a DVL that can be given to a simulator.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bags.writer import Compression, Storage
from ..calibration.models.parameters import Parameters
from ..diagnosis.answer.results import Diagnosis, diagnosis_document
from ..diagnosis.model.hypothesis import amplitudes
from ..disk.text_files import write_json
from ..effects.base import Effect
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
from .comparison import compare, compare_logs
from .gap_ladder import is_of_every_run
from .results import ComparedEffect, SimulatorVerdict, Triple, UnpairedComparison, unpaired_document

MOST_ROUNDS = 9
# The simulator's velocity is its truth: no more is taken off it than the corners between its samples
SMOOTHING_S = 0.2
TRUTH_HZ = 10.0


@dataclass(frozen=True)
class Round:
    """One time round. dvl: document of the DVL that was simulated; None of the simulator as it was recorded."""

    comparison: UnpairedComparison
    dvl: Mapping[str, Any] | None = None

    @property
    def error_mps(self) -> float:
        """RMS, m/s, of recorded less simulated on the vehicle's own motion, held out; nan of nothing compared."""
        rungs = self.comparison.rungs
        return rungs[0].error_mps if rungs else float("nan")

    @property
    def effects(self) -> tuple[str, ...]:
        """Those of the DVL that was simulated."""
        return () if self.dvl is None else tuple(each["name"] for each in self.dvl["effects"])

    @property
    def claims(self) -> tuple[str, ...]:
        """Effects and properties of the noise in which it differs from the vehicle."""
        effects = [each.name for each in self.comparison.effects if each.status.is_claim]
        return (*effects, *(each.name for each in self.comparison.noise if each.status.is_claim))


@dataclass(frozen=True, repr=False)
class ClosedGap(Answering):
    """A simulator put right, round by round. rounds: the first is the simulator as it was recorded."""

    rounds: tuple[Round, ...]

    @property
    def best(self) -> int:
        """The round with the fewest differences in effects, of these with the smallest error."""

        def worth(index: int) -> tuple[int, float]:
            each = self.rounds[index]
            return sum(effect.status.is_claim for effect in each.comparison.effects), each.error_mps

        return min(range(len(self.rounds)), key=worth)

    @property
    def verdict(self) -> SimulatorVerdict:
        """The verdict on the best round."""
        return self.rounds[self.best].comparison.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """The answer: how far the gap shrank, and what the best round still lacks."""
        first, best = self.rounds[0], self.rounds[self.best]
        if len(self.rounds) == 1:
            return (*first.comparison.reasons, finding("SIMULATOR_NO_ROUNDS"))
        floor = 1e3 * best.comparison.floor_mps
        before, after = 1e3 * first.error_mps, 1e3 * best.error_mps
        said = finding("SIMULATOR_ROUNDS", round=self.best, before=before, after=after, floor=floor)
        if self.best == 0:
            said = finding("SIMULATOR_ROUNDS_IN_VAIN", before=before, floor=floor)
        left = tuple(each for each in best.comparison.reasons if each.code != "SIMULATOR_PUT_RIGHT")
        return (said, *left)


def close_gap(
    vehicle: RecordedSide,
    simulator: RecordedSide,
    rounds: int,
    folder: Path,
    on_progress: Callable[[float], None] = lambda _: None,
    effects: Mapping[str, Effect] = EFFECTS,
) -> ClosedGap:
    """Compare, and so many times put right what differs, simulate it on the simulator's motion, compare again.

    It ends early where nothing differs that can be put right. In the folder, which must exist, are then of each round
    ROUND.json, the DVL as `export` and `simulate --diagnosis` take it, and ROUND, or ROUND_NUMBER of several, its bags.

    Parameters
    ----------
    vehicle, simulator: Both sides.
    rounds: At most so many.
    folder: Where bags are simulated to.
    on_progress: Called with the share that is done.
    effects: By name.

    Raises
    ------
    InputError
        For what cannot be compared at all, or a simulator's log without attitude, which has no motion.

    """
    topics = simulator.topics.found_in(simulator.opened.types)
    for path, one in zip(simulator.opened.paths, simulator.opened.each, strict=True):
        if topics.imu not in one.types:
            raise InputError(
                f"{path}: no attitude on {topics.imu}, so rounds have no motion to simulate on; record sensor_msgs/Imu "
                "in the simulator, or compare without rounds"
            )
    steps = 2 + rounds

    def part(number: int) -> Callable[[float], None]:
        return lambda share: on_progress((number + share) / steps)

    real = read_log(vehicle, part(0), effects)
    found = [Round(compare_logs(real, read_log(simulator, part(1), effects), effects))]
    document = None if real.diagnosis.dvl is None else diagnosis_document(real.diagnosis)
    while document is not None and found[-1].claims and len(found) <= rounds:
        if len(found) > 1:
            corrected = put_right(document, found[-1].comparison, effects)
            if corrected == document:
                break
            document = corrected
        made = _simulated(document, len(found), simulator, folder, real.diagnosis)
        comparison = compare_logs(real, read_log(made, part(1 + len(found)), effects), effects)
        found.append(Round(comparison, document))
    on_progress(1.0)
    return ClosedGap(tuple(found))


def check_rounds(rounds: int | None, keep: Path | None) -> None:
    """Raise InputError for a number of rounds that cannot be, and for a folder that is there or belongs to none."""
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
    """Compare both sides once, or with rounds as `close_gap`, in a new folder that is kept or in one that is not.

    Raises InputError, as `check_rounds`, `compare` and `close_gap`.
    """
    check_rounds(rounds, keep)
    if rounds is None:
        return compare(vehicle, simulator, on_progress, with_series=with_series)
    if keep is not None:
        keep.mkdir(parents=True)
        return close_gap(vehicle, simulator, rounds, keep, on_progress)
    with tempfile.TemporaryDirectory(prefix="dvl_calib_rounds_") as folder:
        return close_gap(vehicle, simulator, rounds, Path(folder), on_progress)


def put_right(
    document: Mapping[str, Any], comparison: UnpairedComparison, effects: Mapping[str, Effect] = EFFECTS
) -> dict[str, Any]:
    """The document of a DVL with what differs changed by as much as it differs: effects, noise and rate."""
    corrected: dict[str, Any] = deepcopy(dict(document))
    by_name = {each["name"]: each for each in corrected["effects"]}
    for compared in (each for each in comparison.effects if each.status.is_claim):
        effect = effects[compared.name]
        if not is_of_every_run(effect) or any(" of " in key for key in compared.vehicle):
            continue  # another size every day, or at a time of a run that may be none of the simulator's
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
    differ = {each.name: each for each in comparison.noise if each.status.is_claim}
    if "rate" in differ:
        dvl["rate_hz"] = differ["rate"].vehicle[0]
    levels = {axis: differ[name] for axis, name in enumerate(("level_x", "level_y", "level_z")) if name in differ}
    dvl["noise_std_mps"] = [
        std * levels[axis].vehicle[0] / levels[axis].simulator[0] if axis in levels else std
        for axis, std in enumerate(dvl["noise_std_mps"])
    ]
    return corrected


def _difference(compared: ComparedEffect, name: str) -> float:
    """By how much the vehicle has more of a parameter; of several recordings by their means. 0 where one shows none."""

    def of(side: Mapping[str, Triple]) -> list[float]:
        return [value for key, (value, _, _) in side.items() if key == name or key.startswith(f"{name} of ")]

    vehicle, simulator = of(compared.vehicle), of(compared.simulator)
    return sum(vehicle) / len(vehicle) - sum(simulator) / len(simulator) if vehicle and simulator else 0.0


def _simulated(
    document: Mapping[str, Any], number: int, simulator: RecordedSide, folder: Path, vehicle: Diagnosis
) -> RecordedSide:
    """Bags of a DVL on the motions of the simulator's, and how to read them."""
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
    """The JSON of `diagnose --simulator --rounds --json`: the comparison of each round, and the DVL that it was of."""
    return {
        "sentence": " ".join(each.full_sentence for each in closed.reasons),
        "reasons": [each.as_dict() for each in closed.reasons],
        "best": closed.best,
        "rounds": [
            {
                "error_mps": each.error_mps,
                "differs_in": list(each.claims),
                "dvl": each.dvl,
                "comparison": unpaired_document(each.comparison),
            }
            for each in closed.rounds
        ],
    }
