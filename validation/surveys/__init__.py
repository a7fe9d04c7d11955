"""Random surveys by physics of their own, through the command line: usable and wrong, right and rejected.

Each survey is a process of its own; what is done is kept in --results and not done again. Wrong is yaw off by more than
3 sigma and 0.5 degrees, or pitch by more than 3 sigma and 0.7 degrees.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.stats import beta

from ..stacks import ROOT, command, rpy_std_deg
from .physics import draw, write_survey

YAW_DEG, PITCH_DEG, SIGMAS = 0.5, 0.7, 3.0
# One survey takes seconds; what takes longer hangs (s)
LONGEST_S = 300.0
# Of a reason, characters
SHOWN = 100


def judge_one(seed: int) -> dict[str, Any]:
    """Write, replay and judge the survey of a seed: verdict, errors and σ in degrees, what was drawn."""
    with tempfile.TemporaryDirectory() as folder:
        bag, saved = Path(folder) / "bag", Path(folder) / "saved.yaml"
        truth = write_survey(draw(seed), bag)
        said = command("replay", bag, "--save", saved)
        if not saved.exists():
            return {**truth, "seed": seed, "verdict": "none", "said": said.strip().splitlines()[-1:]}
        document = yaml.safe_load(saved.read_text())
    mounting = document["mounting"]
    std = rpy_std_deg(mounting["corrected_rpy"], np.array(mounting["pose_covariance"])[3:, 3:])
    off = [
        math.remainder(found - true, 360.0)
        for found, true in zip(np.degrees(mounting["corrected_rpy"]), truth["rpy_deg"], strict=True)
    ]
    verification = document["verification"]
    return {
        **truth, "seed": seed, "verdict": verification["verdict"], "reason": verification["reasons"][0],
        "model": document["model"], "off_deg": off, "std_deg": std.tolist(),
    }  # fmt: skip


def is_wrong(result: dict[str, Any]) -> bool:
    """Whether yaw or pitch is not what it says."""
    if "off_deg" not in result:
        return True
    _, pitch, yaw = np.abs(result["off_deg"])
    _, pitch_std, yaw_std = result["std_deg"]
    return bool(yaw > max(SIGMAS * yaw_std, YAW_DEG) or pitch > max(SIGMAS * pitch_std, PITCH_DEG))


def share(k: int, n: int) -> str:
    """k of n with 95 % bounds (Clopper and Pearson)."""
    if not n:
        return "0 of 0"
    low = 0.0 if k == 0 else float(beta.ppf(0.025, k, n - k + 1))
    high = 1.0 if k == n else float(beta.ppf(0.975, k + 1, n - k))
    return f"{k} of {n} ({100.0 * k / n:.1f} %, 95 % bounds {100.0 * low:.1f} to {100.0 * high:.1f})"


def summary(results: Sequence[dict[str, Any]]) -> list[str]:
    """Rates, coverage, and misses by name."""
    usable = [each for each in results if each["verdict"] in ("accept", "marginal")]
    wrong = [each for each in usable if is_wrong(each)]
    rejected = [each for each in results if each["verdict"] == "reject" and not is_wrong(each)]
    covered = sum(abs(each["off_deg"][2]) <= 2.0 * each["std_deg"][2] for each in usable)
    lines = [
        f"usable and wrong: {share(len(wrong), len(usable))}",
        f"rejected though right: {share(len(rejected), len(results))}",
        f"yaw within 2 sigma: {share(covered, len(usable))}",
        f"verdicts: {dict(Counter(each['verdict'] for each in results))}",
    ]
    for title, misses in (("wrong", wrong), ("rejected", rejected)):
        for each in misses:
            drawn = each["drawn"]
            what = [drawn["manoeuvre"], drawn["reference"], "tf" if drawn["transform"] else "no tf"]
            what += [f"{name} {drawn[name]:.2f}" for name in ("dvl_late", "reference_late", "compass") if drawn[name]]
            what += ["lasting noise"] * drawn["lasting"] + ["antenna"] * any(drawn["antenna"])
            off, std = each["off_deg"], each["std_deg"]
            yaw, pitch = (f"{off[at]:+.2f} ± {std[at]:.2f}" for at in (2, 1))
            lines.append(
                f"  {title} {each['seed']}: {', '.join(what)}; mounted at {drawn['mounting_yaw']:g}; yaw {yaw}, pitch "
                f"{pitch}; {each['model']}; {each['reason'][:SHOWN]}"
            )
    return lines


def main(argv: Sequence[str]) -> int:
    """0; 2 for a wrong call."""
    parser = argparse.ArgumentParser(prog="python -m validation surveys", description=__doc__)
    parser.add_argument("--cases", type=int, default=300, metavar="N", help="surveys; default: %(default)s")
    parser.add_argument("--seed", type=int, default=23_000, metavar="S", help="of the first; default: %(default)s")
    parser.add_argument("--results", type=Path, metavar="FILE", help="JSON lines: kept, and gone on with")
    parser.add_argument("--one", action="store_true", help="judge the first alone and print it as JSON")
    arguments = parser.parse_args(argv)
    if arguments.one:
        print(json.dumps(judge_one(arguments.seed)))
        return 0
    kept = arguments.results
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    done = {result["seed"]: result for result in map(json.loads, lines)}
    seeds = range(arguments.seed, arguments.seed + arguments.cases)
    for seed in seeds:
        if seed in done:
            continue
        line = [sys.executable, "-m", "validation", "surveys", "--one", "--seed", str(seed)]
        answer = subprocess.run(line, capture_output=True, text=True, check=True, cwd=ROOT, timeout=LONGEST_S).stdout
        done[seed] = json.loads(answer.splitlines()[-1])
        if kept is not None:
            with kept.open("a") as file:
                file.write(json.dumps(done[seed]) + "\n")
    print("\n".join(summary([done[seed] for seed in seeds])))
    return 0
