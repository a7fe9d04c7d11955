"""The examples of the diagnosis on its page: commands on bags that anybody can make."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from .registry import CHEAP, Found, dvl_calib, measurement

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
