"""What the recordings of the Snapir vehicle show: the published procedure, and five against the vehicle's own INS."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from .registry import CHEAP, LONG, Found, dvl_calib, measurement, snapir, snapir_ins

RECORDINGS = ("T01", "T03", "T05", "T09", "T13")
PUBLISHED_MODELS = ("M1", "M2", "M3", "M4", "M5", "M6", "M7")
IMPORT = ("--gnss-frame", "ned", "--dvl-std", 0.01, "--gnss-std", 0.01)
# A DVL as Gazebo has it: Gaussian noise of one size on the beams, its reference the truth
GAZEBO = ("--trajectory", "free", "--duration", 300, "--beam-std", 0.01, "--dvl-rate", 5, "--gnss-std", 0,
          "--gnss-rate", 10, "--seed", 3)  # fmt: skip


def _json(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text())
    return document


@measurement(
    cost=CHEAP,
    command="dvl-calib evaluate snapir --seeds 10",
    seeds="seeds 0 to 9, 15 combinations of errors each",
    # what another build of the linear algebra changes is far less; what a change of an estimator changes, far more
    tolerances={
        "failures": 0, "seeds": 0, "*.ratio": 0.01, "coverage.*": 1.0, "sigmas.*": "2%", "*deg*": "2%",
        "*": 0.0003,
    },
)  # fmt: skip
def evaluation(folder: Path) -> Found:
    """The published procedure: Avg.VRMSE m/s, coverage in per cent, misalignment against time in degrees."""
    dvl_calib("evaluate", snapir(), "--seeds", 10, "--json", folder / "e.json")
    e = _json(folder / "e.json")
    found: dict[str, Any] = {"failures": len(e["failures"]), "seeds": len(e["seeds"])}
    for name, by_column in e["avg_vrmse"].items():
        for column, value in by_column.items():
            found[f"{name}.{column}"], found[f"{name}.{column}.ratio"] = value, e["ratio"][name].get(column)
    for column, value in e["mean"].items():
        found[f"mean.{column}"] = value
    for column in PUBLISHED_MODELS:
        found[f"published.{column}"] = float(np.mean([each[column] for each in e["published"].values()]))
    for column in e["each"]["median"]:
        found[f"manoeuvring.{column}"] = e["each"]["median_manoeuvring"][column]
        found[f"single.{column}"] = e["single_heading"]["median"][column]
    found["single.stretches"] = len(e["single_heading"]["runs"])
    for name, values in e["baselines"].items():
        found[f"baseline.{_slug(name)}"] = values["mean"]
    for model, values in e["coverage_of_all"].items():
        for level in ("within_68", "within_95"):
            found[f"coverage.{model}.{level[-2:]}"] = 100.0 * values[level]["pooled"]
        found[f"sigmas.{model}"] = values["normalised_rms"]
    times = e["convergence"]["times_s"]
    for curve in e["convergence"]["curves"]:
        std = "none" if curve["gnss_std"] is None else f"{curve['gnss_std']:g}"
        for seconds, angle, level in zip(times, curve["angle_deg"], curve["pitch_and_yaw_deg"], strict=True):
            key = f"{_slug(curve['name'])}.{std}.{seconds:g}"
            found[f"deg.angle.{key}"], found[f"deg.level.{key}"] = angle, level
    return {name: value for name, value in found.items() if value is not None}  # of a model that cannot run there


@measurement(
    cost=LONG,
    command="dvl-calib evaluate snapir --models full --seeds 3",
    seeds="seeds 0 to 2, 15 combinations of errors each",
    tolerances={"coverage.*": 1.0, "sigmas": "2%", "*": 0.0003},
)
def evaluation_full(folder: Path) -> Found:
    """The published procedure with `full`, on the four sets: Avg.VRMSE m/s, coverage in per cent."""
    dvl_calib("evaluate", snapir(), "--models", "full", "--seeds", 3, "--json", folder / "e.json")
    e = _json(folder / "e.json")
    found: dict[str, Any] = {name: by_column["full"] for name, by_column in e["avg_vrmse"].items()}
    found["mean"] = e["mean"]["full"]
    coverage = e["coverage"]["full"]
    for level in ("within_68", "within_95"):
        found[f"coverage.{level[-2:]}"] = 100.0 * coverage[level]["pooled"]
    found["sigmas"] = coverage["normalised_rms"]
    return found


def _slug(name: str) -> str:
    """Fit for a template's field."""
    return "".join(letter if letter.isalnum() else "_" for letter in name.split(" (")[0]).strip("_").lower()


@measurement(
    cost=CHEAP,
    command="dvl-calib import snapir_ins, then dvl-calib replay of each recording, nothing given",
    tolerances={
        "*.verdict": 0, "*.used": 2, "pairs.*": 0, "*.drift*": 0.1, "*.noise*": 0.1, "*.std_*": "10%",
        "*_deg": 0.02, "*.offset_mps": 0.001, "*.scale*": 0.02, "*.lever_*": 0.02, "*.late_s": 0.02, "*": 0.001,
    },
)  # fmt: skip
def recordings(folder: Path) -> Found:
    """Five recordings, each by itself: held-out errors m/s, mounting degrees, lever arm m, delay s, drift m per km."""
    dvl_calib("import", snapir_ins(), "-o", folder / "bags", *IMPORT)
    found: dict[str, Any] = {}
    estimates = {}
    for name in RECORDINGS:
        dvl_calib("replay", folder / "bags" / name, "--json", folder / f"{name}.json")
        dvl_calib("replay", folder / "bags" / name, "-p", "model:=iac", "--json", folder / f"{name}.iac.json")
        replayed, published = _json(folder / f"{name}.json"), _json(folder / f"{name}.iac.json")
        selected = replayed["selected"][-1]["model"]
        held_out = replayed["verification"][selected]["held_out"]
        found[f"{name}.model"] = selected
        found[f"{name}.verdict"] = replayed["verification"][selected]["verdict"]
        found[f"{name}.iac_model"] = published["selected"][-1]["model"]
        found[f"{name}.uncorrected"] = held_out["uncorrected_mps"]
        found[f"{name}.corrected"] = held_out["corrected_mps"]
        found[f"{name}.iac"] = published["verification"][found[f"{name}.iac_model"]]["held_out"]["corrected_mps"]
        for model in ("M3", "full"):
            found[f"{name}.{model}"] = replayed["verification"][model]["held_out"]["corrected_mps"]
        navigation = replayed["navigation"]
        found[f"{name}.drift_before"] = navigation["drift_m_per_km"]["before"]
        found[f"{name}.drift_after"] = navigation["drift_m_per_km"]["after"]
        found[f"{name}.noise_m_per_km"] = navigation["noise_m_per_km"]
        estimates[name] = each = _estimate(replayed["models"]["full"])
        published_here = _estimate(replayed["models"]["M3"])
        found[f"{name}.m3_yaw_deg"], found[f"{name}.std_m3_yaw"] = (
            -np.degrees(published_here["phi_z"][0]),
            np.degrees(published_here["phi_z"][1]),
        )
        found[f"{name}.yaw_deg"], found[f"{name}.std_yaw"] = -np.degrees(each["phi_z"][0]), np.degrees(each["phi_z"][1])
        found[f"{name}.lever_x"], found[f"{name}.std_lever_x"] = each["lever_arm_x"][:2]
        found[f"{name}.late_s"], found[f"{name}.std_late"] = each["time_offset"][:2]
        found[f"{name}.offset_mps"] = math.hypot(each["reference_east"][0], each["reference_north"][0])
    for state, label in (
        ("phi_y", "pitch"), ("phi_z", "yaw"), ("delta_k_x", "scale"), ("lever_arm_x", "lever_x")
    ):  # fmt: skip
        pairs = [(estimates[a][state], estimates[b][state]) for a, b in combinations(RECORDINGS, 2)]
        for sigma, place in (("next_day", 1), ("recording", 2)):
            near = [abs(a[0] - b[0]) <= 2.0 * math.hypot(a[place], b[place]) for a, b in pairs]
            found[f"pairs.{label}.{sigma}"] = sum(near)
    yaws = [found[f"{name}.yaw_deg"] for name in RECORDINGS]
    found["spread.yaw_deg"] = max(yaws) - min(yaws)
    scales = [100.0 * estimates[name]["delta_k_x"][0] for name in RECORDINGS]
    found["spread.scale"] = max(scales) - min(scales)
    return found


def _estimate(model: Mapping[str, Any]) -> dict[str, tuple[float, float, float]]:
    """State: value, its σ as of another day, and as of this recording."""
    stds = [np.sqrt(np.diag(model[name])) for name in ("covariance", "covariance_of_recording")]
    return {
        name: (value, float(day), float(own))
        for name, value, day, own in zip(model["state_names"], model["state"], *stds, strict=True)
    }


@measurement(
    cost=CHEAP,
    command="dvl-calib replay of T01, T03 and T05 together, imported with --start a day apart",
    tolerances={"*.late_s": 0.02, "lever_x": 0.02, "std_*": "10%", "corrected": 0.001},
)
def together(folder: Path) -> Found:
    """Three days of one vehicle in one replay."""
    source, bags = snapir_ins(), []
    for day, name in enumerate(("T01", "T03", "T05")):
        files = (source / f"{name}_dvl.csv", "--gnss", source / f"{name}_gnss.csv",
                 "--attitude", source / f"{name}_attitude.csv")  # fmt: skip
        bags.append(folder / name)
        dvl_calib("import", *files, "-o", bags[-1], "--start", 1_600_000_000 + 86_400 * day, *IMPORT)
    dvl_calib("replay", *bags, "--json", folder / "together.json")
    replayed = _json(folder / "together.json")
    selected = replayed["selected"][-1]["model"]
    verification = replayed["verification"][selected]
    estimate = _estimate(replayed["models"][selected])
    found: dict[str, Any] = {
        "model": selected,
        "verdict": verification["verdict"],
        "corrected": verification["held_out"]["corrected_mps"],
        "lever_x": estimate["lever_arm_x"][0],
        "std_lever_x": estimate["lever_arm_x"][1],
    }
    for name, day in zip(("T01", "T03", "T05"), replayed["days"], strict=True):
        found[f"{name}.late_s"] = day["dvl_time_offset"]
    return found


@measurement(
    cost=CHEAP,
    command="dvl-calib evaluate bags/T01 bags/T03 bags/T05 bags/T13 --models full",
    tolerances={"*": 0.001},
)
def crossed(folder: Path) -> Found:
    """Each recording corrected by the calibration of every other: rms of DVL less reference, m/s."""
    names = ("T01", "T03", "T05", "T13")
    dvl_calib("import", snapir_ins(), "-o", folder / "bags", *IMPORT)
    bags = [folder / "bags" / name for name in names]
    dvl_calib("evaluate", *bags, "--models", "full", "--json", folder / "crossed.json")
    document = _json(folder / "crossed.json")
    found = {f"as_mounted.{Path(bag).name}": value for bag, value in document["uncorrected"].items()}
    for one, by_model in document["corrected"].items():
        for other, value in by_model["full"].items():
            found[f"{Path(one).name}.{Path(other).name}"] = value
    return found


@measurement(
    cost=CHEAP,
    command="dvl-calib diagnose --apply of each recording and of T01, T03, T05; dvl-calib replay --params of each",
    tolerances={"*.lever_x": 0.02, "*.late_s": 0.02, "*.lever_*": 0.02, "*": 0.0015},
)
def diagnosed(folder: Path) -> Found:
    """What the diagnosis names, and what is left once that is compensated; m/s, m, s."""
    dvl_calib("import", snapir_ins(), "-o", folder / "bags", *IMPORT)
    found: dict[str, Any] = {}
    for name in RECORDINGS:
        bag, answer, applied = folder / "bags" / name, folder / f"{name}.json", folder / f"{name}.yaml"
        dvl_calib("diagnose", bag, "--json", answer, "--apply", applied)
        dvl_calib("replay", bag, "--params", applied, "-p", "model:=M3", "--json", folder / f"{name}.replayed.json")
        document = _json(answer)
        found[f"{name}.names"] = "; ".join(_named(each["name"], each["parameters"]) for each in document["effects"])
        found[f"{name}.verdict"] = document["verdict"]
        replayed = _json(folder / f"{name}.replayed.json")["verification"]["M3"]["held_out"]
        found[f"{name}.then_M3"] = replayed["corrected_mps"]
        found[f"{name}.not_explained"] = document["gap"]["not_explained_mps"]
    three = [folder / "bags" / name for name in ("T01", "T03", "T05")]
    dvl_calib("diagnose", *three, "--json", folder / "three.json")
    document = _json(folder / "three.json")
    arm = next(each for each in document["effects"] if each["name"] == "lever_arm")["parameters"]["x_m"]
    low, high = arm["ci95"]
    found["three.lever_x"], found["three.lever_low"], found["three.lever_high"] = arm["value"], low, high
    found["three.verdict"] = document["verdict"]
    return found


# How an effect is told in a table; others by name. To a digit that other builds of the linear algebra do not change.
_SHOWN = {
    "lever_arm": "lever arm {x_m:.1f} m",
    "dvl_time_offset": "stamps {seconds:.1f} s",
    "water_lock": "an earth-fixed difference",
}


def _named(effect: str, parameters: Mapping[str, Mapping[str, float]]) -> str:
    """An effect in a few words, its size to what a table shows of it."""
    shown = _SHOWN.get(effect, effect.replace("_", " "))
    return shown.format(**{name: each["value"] for name, each in parameters.items()})


@measurement(
    cost=CHEAP,
    command="dvl-calib diagnose of each recording with --simulator, a DVL as Gazebo has it, --rounds 1",
    seeds="seed 3 of the simulated log",
    tolerances={"*.distance*": 0.05, "*.p": 0.1, "*": "5%"},
)
def against_simulator(folder: Path) -> Found:
    """Return what a simulated DVL lacks: errors in mm/s as it is, with effects, and after a round; noise; distance."""
    dvl_calib("import", snapir_ins(), "-o", folder / "bags", *IMPORT)
    dvl_calib("simulate", folder / "gz", *GAZEBO)
    found: dict[str, Any] = {}
    for name in RECORDINGS:
        answer = folder / f"{name}.json"
        against = folder / "bags" / name, "--simulator", folder / "gz"
        dvl_calib("diagnose", *against, "--rounds", "1", "--json", answer)
        first, right = _json(answer)["rounds"]
        document = first["comparison"]
        *rows, with_noise = document["shrinks"]
        for row in rows:
            model = row["model"].replace(" ", "_")
            found[f"{name}.{model}"], found[f"{name}.distance.{model}"] = 1e3 * row["error_mps"], row["energy_distance"]
        found[f"{name}.noise"] = 1e3 * document["noise_floor_mps"]
        lacks = [each for each in document["effects"] if each["status"] == "missing_in_simulator"]
        found[f"{name}.lacks"] = "; ".join(_named(each["name"], each["vehicle"]) for each in lacks)
        found[f"{name}.distance.with_noise"], found[f"{name}.p"] = with_noise["energy_distance"], with_noise["p"]
        found[f"{name}.put_right"] = 1e3 * right["error_mps"]
    return found
