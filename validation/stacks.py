"""Bags as real stacks record them, each with its truth: answered right by doctor and replay with no option?

The bags are made by cases/stacks.py of the shared folder (DVL_CALIB_SHARED, else ../shared), which has physics of its
own. A bag is right if replay's mounting is the true one within what it says, the position it writes is the DVL's in
base_link or none is written, and doctor says no where replay rejects, and only there.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parent.parent
SCRIPT = Path("cases") / "stacks.py"
# An answer is wrong if it is off by more than three of its σ and by this: degrees of roll, pitch, yaw; per cent; m; s.
ANGLES_DEG, SCALE, POSITION_M, DELAY_S = (0.7, 0.7, 0.5), 0.5, 0.1, 0.06
# A bag that holds no answer: the right one is to say why, first.
NONE_TO_GIVE = {"d_no_imu": "no IMU"}
# A DVL beside the one that is taken: truth's names for both, and the topic of the other.
SECOND = {"f_two_dvls_camera": ("port", "stbd", "/starboard/dvl")}


@dataclass
class Judged:
    """What is wrong with the answer to one bag; nothing if it is right."""

    name: str
    wrong: list[str] = field(default_factory=list)


def shared_folder() -> Path:
    """Where the bags' script is looked for."""
    given = os.environ.get("DVL_CALIB_SHARED")
    return Path(given) if given else ROOT.parent / "shared"


def command(*words: object) -> str:
    """What `dvl-calib` prints, in a process of its own."""
    line = [sys.executable, "-m", "dvl_calib_ros.cli.main", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=ROOT)
    return done.stdout + done.stderr


def rpy_std_deg(rpy: Sequence[float], turn_covariance: np.ndarray) -> np.ndarray:
    """Of roll, pitch, yaw (3,), from the covariance (3, 3) rad² of a small turn about the body's axes."""
    mounted, step = Rotation.from_euler("xyz", rpy), 1e-6
    moved = [(Rotation.from_rotvec(each) * mounted).as_euler("xyz") for each in step * np.eye(3)]
    jacobian = np.array([np.angle(np.exp(1j * (each - np.array(rpy)))) for each in moved]).T / step
    return np.degrees(np.sqrt(np.diag(jacobian @ turn_covariance @ jacobian.T)))


def off(value: float, truth: float, std: float, at_least: float) -> bool:
    """Whether a value is wrong."""
    return abs(value - truth) > max(3.0 * std, at_least)


def mounting_errors(mounting: Mapping[str, Any], truth: Mapping[str, Any], rpy_deg: Sequence[float]) -> list[str]:
    """What is wrong with a result file's mounting."""
    wrong = []
    rpy, covariance = mounting["corrected_rpy"], np.array(mounting["pose_covariance"])
    std = rpy_std_deg(rpy, covariance[3:, 3:])
    for name, value, true, sigma, least in zip(
        ("roll", "pitch", "yaw"), np.degrees(rpy), rpy_deg, std, ANGLES_DEG, strict=True
    ):
        difference = math.remainder(value - true, 360.0)
        if off(difference, 0.0, sigma, least):
            wrong.append(f"{name} {value:+.2f}° ± {sigma:.2f}°, truth {true:+.2f}°")
    scale_std = mounting["scale_error_ahead_std"]
    if scale_std is not None and "scale" in truth:
        scale = 100.0 * mounting["scale_error_ahead"]
        if off(scale, truth["scale"], 100.0 * scale_std, SCALE):
            wrong.append(f"scale {scale:+.2f} %, truth {truth['scale']:+.2f} %")
    position = mounting["position"]
    if position is not None and "arm" in truth:
        away = float(np.abs(np.subtract(position, truth["arm"])).max())
        if away > POSITION_M:
            wrong.append(f"position {np.round(position, 2).tolist()} is written, the DVL is at {truth['arm']}")
    late_std = mounting["dvl_time_offset_std"]
    if late_std is not None and "late" in truth:
        late = mounting["dvl_time_offset"]
        if off(late, truth["late"], late_std, DELAY_S):
            wrong.append(f"late by {late:+.2f} s, truth {truth['late']:+.2f} s")
    return wrong


def judge(bag: Path, truth: Mapping[str, Any], work: Path) -> Judged:
    """Ask doctor and replay of one bag."""
    judged, name = Judged(bag.name), bag.name
    examined, replayed, saved = work / "doctor.json", work / "replay.json", work / "saved.yaml"
    said = command("doctor", bag, "--json", examined)
    answer = command("replay", bag, "--json", replayed, "--save", saved)
    if not examined.exists() or not replayed.exists():
        judged.wrong.append(f"no answer: {(answer.strip().splitlines() or ['nothing said'])[-1]}")
        return judged
    doctor = json.loads(examined.read_text())["verdict"]
    verdict = yaml.safe_load(saved.read_text())["verification"]["verdict"]
    if (doctor == "no") != (verdict == "reject"):
        judged.wrong.append(f"doctor says {doctor}, replay {verdict}")
    if name in NONE_TO_GIVE:
        first = NONE_TO_GIVE[name]
        if verdict != "reject" or not said.lstrip().startswith(first) or first not in answer.partition("reject")[0]:
            judged.wrong.append(f"{first!r} is not the first thing said, or it is not rejected ({verdict})")
        return judged
    if verdict == "reject":
        judged.wrong.append("rejected")
    rpy: Sequence[float] = truth.get("rpy", ())
    if name in SECOND:
        ours, other, topic = SECOND[name]
        rpy = truth[ours]
        if "two DVLs" not in said or "two DVLs" not in answer:
            judged.wrong.append("that there are two DVLs is not said")
        second = work / "second.yaml"
        command("replay", bag, "--dvl-topic", topic, "--save", second)
        mounting = yaml.safe_load(second.read_text())["mounting"]
        judged.wrong += [f"{topic}: {each}" for each in mounting_errors(mounting, {}, truth[other])]
    mounting = yaml.safe_load(saved.read_text())["mounting"]
    judged.wrong += mounting_errors(mounting, truth, rpy)
    return judged


def main(argv: Sequence[str]) -> int:
    """0 if all are right, or if there is nothing to judge; 1 if not."""
    parser = argparse.ArgumentParser(prog="python -m validation stacks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="bags to judge; default: all")
    parser.add_argument("--cases", type=Path, metavar="DIR", help="bags that are there, with truth.json beside them")
    arguments = parser.parse_args(argv)
    script = shared_folder() / SCRIPT
    if arguments.cases is None and not script.exists():
        print(f"skipped: {SCRIPT} is not in the shared folder (set DVL_CALIB_SHARED), nor is --cases given")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        cases = arguments.cases
        if cases is None:
            cases = Path(folder) / "cases"
            subprocess.run([sys.executable, script, cases, *arguments.names], check=True, capture_output=True)
        truths = json.loads((cases / "truth.json").read_text())
        chosen = [name for name in truths if not arguments.names or name in arguments.names]
        right = 0
        for name in chosen:
            work = Path(folder) / f"of_{name}"
            work.mkdir()
            judged = judge(cases / name, truths[name], work)
            right += not judged.wrong
            print(f"{name:24} {'right' if not judged.wrong else 'WRONG: ' + '; '.join(judged.wrong)}", flush=True)
    print(f"{right} of {len(chosen)} right")
    return 0 if right == len(chosen) else 1
