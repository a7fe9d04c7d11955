"""From a vehicle's bag to another simulator's log and back: does it differ in anything but what the export said?

    python test/round_trip.py --cases 40 --seed 1

A vehicle with effects by chance is simulated and diagnosed, the diagnosis is exported, a simulator is made of the file
as its settings say (`other_simulators`, which knows nothing of the export), and its log of another motion is diagnosed.
What then differs must be listed as missing: number by number between the two diagnoses, and by what
`diagnose VEHICLE --simulator LOG` claims of the two bags.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from other_simulators import READERS, write_log
from scipy.spatial.transform import Rotation

from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.cli.common import write_json
from dvl_calib_ros.diagnosis.answer.results import diagnosis_document
from dvl_calib_ros.recordings.recording import open_recording
from dvl_calib_ros.recordings.topics import Topics
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors
from dvl_calib_ros.simulation.trajectories import Waves
from dvl_calib_ros.simulator_export.dvl_description import load_description
from dvl_calib_ros.simulator_export.simulators import SIMULATORS, export
from dvl_calib_ros.unpaired.both_sides import Log, RecordedSide, read_log
from dvl_calib_ros.unpaired.comparison import compare_logs

SECONDS = 240.0
# A number of the log that is further from the source's than that, in its own standard deviations, is another one. Of
# some ten numbers a case, forty cases hold one beyond 4 by chance in one of forty runs
FAR = 4.0
SAME_NOISE = 0.25
# What the comparison of both bags calls what the diagnosis and the export call otherwise
CALLED = {"heavy_tails": "outliers", "stale": "stale_samples", "repeats": "stale_samples"}


@dataclass(frozen=True)
class Outcome:
    """A case: what the vehicle had, what was found, what differs in the simulator's log, what the export said.

    differs: by the numbers of both diagnoses. claimed: by the comparison of both bags.
    """

    simulator: str
    injected: tuple[str, ...]
    found: tuple[str, ...]
    differs: frozenset[str]
    claimed: frozenset[str]
    missing: frozenset[str]

    @property
    def unsaid(self) -> frozenset[str]:
        return (self.differs | self.claimed) - self.missing


def effects(rng: np.random.Generator) -> list[str]:
    """Up to two systematic effects and, now and then, one of the noise."""

    def either(low: float, high: float) -> float:
        return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))

    pool = [
        f"lever_arm:x_m={either(0.5, 2.5):.3f},y_m={either(0.0, 0.5):.3f},z_m={either(0.0, 0.4):.3f}",
        f"dvl_time_offset:seconds={either(0.1, 0.8):.3f}",
        f"velocity_bias:x_mps={either(0.02, 0.06):.4f},y_mps={either(0.0, 0.03):.4f}",
        f"quadratic_scale:coefficient_s_per_m={either(0.02, 0.04):.4f}",
        f"mount_flexure:z_rad_per_mps={either(0.03, 0.05):.4f}",
        f"scale_drift:rate_per_hour={either(0.2, 0.5):.3f}",
    ]
    drawn = rng.choice(len(pool), size=int(rng.integers(0, 3)), replace=False)
    noise = ["outliers:share=0.02"] if rng.uniform() < 0.15 else []
    return [pool[index] for index in drawn] + noise


def run(simulator: str, seed: int, folder: Path) -> Outcome:
    rng = np.random.default_rng(seed)
    mounting = (0.0, 0.0, float(rng.choice([0.0, np.pi / 4])))
    scale = float(rng.normal(0.0, 0.006))
    injected = effects(rng)
    scenario = Scenario(
        trajectory="free", seconds=SECONDS, seed=seed, waves=Waves(0.3, 5.0), mounting_rpy=mounting,
        errors=DvlErrors(tuple(rng.normal(0.0, 0.025, 3)), (scale,) * 3, beam_std=float(rng.uniform(0.002, 0.01))),
        dvl_rate=float(rng.choice([2.0, 4.0, 5.0, 8.0])), gnss_std=float(rng.uniform(0.02, 0.05)),
        effects=tuple(injection(text) for text in injected),
    )  # fmt: skip
    write_bag(scenario, folder / "vehicle", Storage.MCAP, Compression.NONE)
    parameters = Parameters(mounting_rpy=mounting, min_speed=0.0)
    vehicle, source = diagnosed(folder / "vehicle", parameters)
    description = load_description(folder / "vehicle.json")
    exported = export(simulator, SIMULATORS[simulator], description)
    (folder / "settings").write_text(exported.settings.text)
    write_log(folder / "log", READERS[simulator](folder / "settings"), SECONDS, seed + 10_000)
    made, log = diagnosed(folder / "log", parameters)
    return Outcome(
        simulator,
        tuple(injected),
        tuple(each["name"] for each in source["effects"]),
        frozenset(differences(source, log, description, load_description(folder / "log.json"))),
        frozenset(claimed(vehicle, made)),
        frozenset(each.name for each in exported.missing),
    )


def diagnosed(bag: Path, parameters: Parameters) -> tuple[Log, dict]:
    log = read_log(RecordedSide(open_recording([bag]), parameters, Topics()))
    write_json(bag.with_suffix(".json"), diagnosis_document(log.diagnosis))
    return log, json.loads(bag.with_suffix(".json").read_text())


def claimed(vehicle: Log, simulator: Log) -> list[str]:
    """What the comparison of both sides claims to differ, by the names of the export."""
    comparison = compare_logs(vehicle, simulator)
    found = [each.name for each in comparison.effects if each.status.is_claim]
    for each in comparison.noise:
        if each.status.is_claim:
            found.append("noise" if each.name.startswith("level_") else CALLED.get(each.name, each.name))
    return found


def differences(source: dict, log: dict, of_source, of_log) -> list[str]:
    """What is in one and not in the other, or of another size."""
    found = [] if log["verdict"] != "unknown" or source["verdict"] == "unknown" else ["unknown"]
    found += effects_that_differ(source["effects"], log["effects"])
    before, after = ({each["name"] for each in document["noise"]} for document in (source, log))
    found += before ^ after
    turned = Rotation.from_euler("xyz", of_source.mounting_rpy).inv() * Rotation.from_euler("xyz", of_log.mounting_rpy)
    std = np.array([deviation(log["calibration"]["phi_rad"][axis]) for axis in "xyz"])
    if (np.abs(turned.as_rotvec()) > FAR * std).any():
        found.append("misalignment")
    std = np.array([deviation(log["calibration"]["delta_k"][axis]) for axis in "xyz"])
    if (np.abs(np.subtract(of_log.scale, of_source.scale)) > FAR * std).any():
        found.append("scale")
    if (np.abs(np.log(np.divide(of_log.noise_std, of_source.noise_std))) > SAME_NOISE).any():
        found.append("noise")
    if abs(of_log.rate_hz / of_source.rate_hz - 1.0) > 0.01:
        found.append("rate")
    return found


def effects_that_differ(source: list[dict], log: list[dict]) -> list[str]:
    found, left = [], list(log)
    for effect in source:
        same = next((each for each in left if effect["name"] in (each["name"], *each["equivalent_to"])), None)
        if same is None:
            found.append(effect["name"])
            continue
        left.remove(same)
        if same["name"] == effect["name"] and any(
            abs(value["value"] - effect["parameters"][name]["value"]) > FAR * deviation(value)
            for name, value in same["parameters"].items()
            if value["value"] is not None
        ):
            found.append(effect["name"])
    return found + [each["name"] for each in left]


def deviation(value: dict) -> float:
    low, high = value["ci95"]
    return (high - low) / 3.92


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    names, good = list(SIMULATORS), 0
    for number in range(arguments.cases):
        with tempfile.TemporaryDirectory() as folder:
            outcome = run(names[number % len(names)], arguments.seed * 1000 + number, Path(folder))
        good += not outcome.unsaid
        said = "ok" if not outcome.unsaid else f"NOT SAID: {', '.join(sorted(outcome.unsaid))}"
        print(
            f"{number:3d} {outcome.simulator:13s} {said} | injected {'; '.join(outcome.injected) or 'nothing'}"
            f" | found {', '.join(outcome.found) or 'nothing'}"
            f" | differs {', '.join(sorted(outcome.differs)) or 'nothing'}"
            f" | claimed {', '.join(sorted(outcome.claimed)) or 'nothing'}",
            flush=True,
        )
    print(f"{good} of {arguments.cases}: nothing but what the export said it could not represent")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
