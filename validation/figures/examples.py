"""What pages show of commands on bags that anybody can make: examples of the diagnosis, shipped bags, damaged bags."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

from .registry import CHEAP, ROOT, Found, dvl_calib, measurement

# The shipped bags and what was simulated in them (bags/README.md): pitch, yaw in degrees; scale ahead in per cent
SHIPPED = {"harbour_box": (1.47, -3.02, 0.33), "straight_leg": (-2.02, 4.00, -0.01)}
_MISALIGNED = ("--misalignment", 1, -1, 2, "--scale", 0.5)


@measurement(
    cost=CHEAP,
    command="dvl-calib simulate and dvl-calib diagnose as above",
    seeds="seeds 3 and 4",
    tolerances={"sound.*": "5%", "two.*": 0.005},
)
def diagnosis_examples(folder: Path) -> Found:
    """The two examples of docs/diagnosis.md: a bag with nothing wrong, and one with two faults; m, s, mm/s."""
    common = ("--trajectory", "free", "--gnss-std", 0.05, *_MISALIGNED)
    dvl_calib("simulate", folder / "sound", *common, "--seed", 3)
    faults = ("--effect", "lever_arm:x_m=0.8,y_m=-0.3", "--effect", "dvl_time_offset:seconds=0.25")
    dvl_calib("simulate", folder / "two", *common, "--seed", 4, *faults)
    said_of_sound = dvl_calib("diagnose", folder / "sound", "--json", folder / "sound.json")
    applied = ("--apply", folder / "two.yaml")
    said_of_two = dvl_calib("diagnose", folder / "two", "--json", folder / "two.json", *applied)
    dvl_calib("diagnose", folder / "two", "--params", folder / "two.yaml", "--json", folder / "again.json")
    sound, two, again = (json.loads((folder / f"{name}.json").read_text()) for name in ("sound", "two", "again"))
    detectable = sound["minimum_detectable"]
    found: dict[str, Any] = {
        "sound.says": said_of_sound.splitlines()[0],
        "two.says": said_of_two.splitlines()[0],
        "sound.verdict": sound["verdict"],
        "sound.lever_x_cm": 100.0 * detectable["lever_arm"]["x_m"],
        "sound.late_s": detectable["dvl_time_offset"]["seconds"],
        "two.verdict": two["verdict"],
        "again.verdict": again["verdict"],
    }
    for effect in two["effects"]:
        for name, each in effect["parameters"].items():
            low, high = each["ci95"]
            found[f"two.{name}"], found[f"two.{name}_low"], found[f"two.{name}_high"] = each["value"], low, high
    return found


@measurement(
    cost=CHEAP,
    command="dvl-calib replay of the two shipped bags",
    tolerances={"*.scale": 0.02, "*": 0.02},
)
def shipped(folder: Path) -> Found:
    """Pitch and yaw of φ in degrees, scale ahead in per cent: error of what is found, and its σ."""
    found: dict[str, Any] = {}
    for name, (pitch, yaw, scale) in SHIPPED.items():
        options = ("--params", "bags/straight_leg.yaml") if name == "straight_leg" else ()
        dvl_calib("replay", f"bags/{name}", *options, "--json", folder / f"{name}.json")
        replayed = json.loads((folder / f"{name}.json").read_text())
        selected = replayed["selected"][-1]["model"]
        model = replayed["models"][selected]
        values = dict(zip(model["state_names"], model["state"], strict=True))
        stds = {
            each: math.sqrt(row[at]) for at, (each, row) in enumerate(zip(values, model["covariance"], strict=True))
        }
        found[f"{name}.model"], found[f"{name}.verdict"] = selected, replayed["verification"][selected]["verdict"]
        for label, state, truth, to_shown in (
            ("pitch", "phi_y", pitch, math.degrees(1)), ("yaw", "phi_z", yaw, math.degrees(1)),
            ("scale", "delta_k_x", scale, 100.0),
        ):  # fmt: skip
            found[f"{name}.{label}"] = to_shown * values[state] - truth
            found[f"{name}.{label}_std"] = to_shown * stds[state]
    return found


@measurement(cost=CHEAP, command="python test/damage.py", tolerances={})
def damage(_: Path) -> Found:
    """The table of damaged bags: messages recovered by each reader."""
    command = [sys.executable, str(ROOT / "test" / "damage.py")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    rows = [line for line in done.stdout.splitlines() if line.startswith("|")]
    return {"table": "\n".join(rows)}
