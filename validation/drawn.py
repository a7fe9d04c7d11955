"""Recordings drawn at random, replayed with no option and judged: usable and wrong, right and rejected."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from scipy.stats import beta

from dvl_calib_ros.calibration.models.parameters import Parameters
from dvl_calib_ros.verdict.verdicts import VERDICTS

from .stacks import ROOT, command, rpy_std_deg

# An answer is wrong if it is off by more than so many of its σ, and by what its kind of recording says
SIGMAS = 3.0
NAMES = ("roll", "pitch", "yaw", "scale")
# One recording takes seconds; what takes longer hangs (s)
LONGEST_S = 300.0
# Of a reason, characters
SHOWN = 100
# A reject that was asked for: how the sentence begins, and from which misalignment on, degrees
(ASKED,) = (kind.says.partition("{")[0] for kind in VERDICTS if kind.code == "MISALIGNMENT_LARGE")
ASKED_FROM_DEG = math.degrees(Parameters().reject_misalignment)

Result = dict[str, Any]


@dataclass(frozen=True)
class Judge:
    """Of one way to draw recordings.

    command: of `python -m validation`. first: seed. write: the bag of a seed to a new folder; returns its truth:
    rpy_deg, misalignment_deg from what was told, perhaps scale (percent), and drawn. least: error of roll, pitch, yaw
    (degrees) and scale (percent) that is not yet wrong, whatever σ says; inf: not judged. said: what was drawn.
    """

    command: str
    first: int
    write: Callable[[int, Path], Result]
    least: tuple[float, float, float, float]
    said: Callable[[Mapping[str, Any]], str]

    def judge_one(self, seed: int) -> Result:
        """Write, replay and judge the recording of a seed: verdict, errors and σ, what was drawn."""
        with tempfile.TemporaryDirectory() as folder:
            bag, saved = Path(folder) / "bag", Path(folder) / "saved.yaml"
            truth = self.write(seed, bag)
            said = command("replay", bag, "--save", saved)
            if not saved.exists():
                return {**truth, "seed": seed, "verdict": "none", "said": said.strip().splitlines()[-1:]}
            document = yaml.safe_load(saved.read_text())
        mounting, verification = document["mounting"], document["verification"]
        rpy, turned = mounting["corrected_rpy"], np.array(mounting["pose_covariance"])[3:, 3:]
        std = rpy_std_deg(rpy, turned).tolist()
        # what another day adds is none of this recording's, whose truth is one
        own = document["models"][document["model"]]
        of_days = (np.array(own["covariance"]) - np.array(own["covariance_of_recording"]))[:3, :3]
        body_from_dvl = Rotation.from_euler("xyz", rpy).as_matrix()
        own_std = rpy_std_deg(rpy, turned - body_from_dvl @ of_days @ body_from_dvl.T).tolist()
        off = [
            math.remainder(found - true, 360.0)
            for found, true in zip(np.degrees(mounting["corrected_rpy"]), truth["rpy_deg"], strict=True)
        ]
        if mounting["scale_error_ahead_std"] is not None and "scale" in truth:
            off.append(100.0 * mounting["scale_error_ahead"] - truth["scale"])
            std.append(100.0 * mounting["scale_error_ahead_std"])
        return {
            **truth, "seed": seed, "verdict": verification["verdict"], "reason": verification["reasons"][0],
            "asked": truth["misalignment_deg"] >= ASKED_FROM_DEG
            and any(each.startswith(ASKED) for each in verification["reasons"]),
            "model": document["model"], "off_deg": off, "std_deg": std, "own_std_deg": own_std,
        }  # fmt: skip

    def is_wrong(self, result: Result) -> bool:
        """Whether an angle or the scale is not what it says."""
        if "off_deg" not in result:
            return True
        judged = zip(result["off_deg"], result["std_deg"], self.least, strict=False)
        return any(abs(off) > max(SIGMAS * std, least) for off, std, least in judged)

    def summary(self, results: Sequence[Result]) -> list[str]:
        """Rates, coverage, and misses by name."""
        usable = [each for each in results if each["verdict"] in ("accept", "marginal")]
        wrong = [each for each in usable if self.is_wrong(each)]
        right = [each for each in results if each["verdict"] == "reject" and not self.is_wrong(each)]
        rejected = [each for each in right if not each["asked"]]
        own = [each for each in usable if "own_std_deg" in each]
        lines = [
            f"usable and wrong: {share(len(wrong), len(usable))}",
            f"rejected though right: {share(len(rejected), len(results))}; {len(right) - len(rejected)} more as asked: "
            f"they are mounted {ASKED_FROM_DEG:g}° or more beside what was told",
            *(
                f"{NAMES[i]} within 2 sigma: {share(sum(abs(off) <= 2.0 * std for off, std in of), len(of))}"
                for i in range(len(NAMES))
                if math.isfinite(self.least[i])
                for of in [[(e["off_deg"][i], e["std_deg"][i]) for e in usable if i < len(e["off_deg"])]]
            ),
            "yaw within 2 sigma of this recording alone: "
            + share(sum(abs(each["off_deg"][2]) <= 2.0 * each["own_std_deg"][2] for each in own), len(own)),
            f"verdicts: {dict(Counter(each['verdict'] for each in results))}",
        ]
        for title, misses in (("wrong", wrong), ("rejected", rejected)):
            for each in misses:
                numbers = zip(NAMES, each["off_deg"], each["std_deg"], self.least, strict=False)
                off = ", ".join(f"{n} {off:+.2f} ± {std:.2f}" for n, off, std, least in numbers if math.isfinite(least))
                lines.append(
                    f"  {title} {each['seed']}: {self.said(each['drawn'])}; {off}; {each['model']}; "
                    f"{each['reason'][:SHOWN]}"
                )
        return lines

    def main(self, argv: Sequence[str], description: str | None) -> int:
        """0; 2 for a wrong call."""
        parser = argparse.ArgumentParser(prog=f"python -m validation {self.command}", description=description)
        parser.add_argument(
            "--first", "--seed", type=int, default=self.first, metavar="SEED", help="of the first; default: %(default)s"
        )
        parser.add_argument("--count", "--cases", type=int, default=300, metavar="N", help="default: %(default)s")
        parser.add_argument("--results", type=Path, metavar="FILE", help="JSON lines: kept, and gone on with")
        parser.add_argument("--jobs", type=int, default=1, metavar="N", help="at once; default: %(default)s")
        parser.add_argument("--one", action="store_true", help="judge the first alone and print it as JSON")
        arguments = parser.parse_args(argv)
        if arguments.one:
            print(json.dumps(self.judge_one(arguments.first)))
            return 0
        kept = arguments.results
        lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
        done = {result["seed"]: result for result in map(json.loads, lines)}
        seeds = range(arguments.first, arguments.first + arguments.count)
        with ThreadPoolExecutor(max(arguments.jobs, 1)) as pool:
            for result in pool.map(self._apart, [seed for seed in seeds if seed not in done]):
                done[result["seed"]] = result
                if kept is not None:
                    with kept.open("a") as file:
                        file.write(json.dumps(result) + "\n")
        print("\n".join(self.summary([done[seed] for seed in seeds])))
        return 0

    def _apart(self, seed: int) -> Result:
        line = [sys.executable, "-m", "validation", self.command, "--one", "--first", str(seed)]
        answer = subprocess.run(line, capture_output=True, text=True, check=True, cwd=ROOT, timeout=LONGEST_S).stdout
        result: Result = json.loads(answer.splitlines()[-1])
        return result


def share(k: int, n: int) -> str:
    """k of n with 95 % bounds (Clopper and Pearson)."""
    if not n:
        return "0 of 0"
    low = 0.0 if k == 0 else float(beta.ppf(0.025, k, n - k + 1))
    high = 1.0 if k == n else float(beta.ppf(0.975, k + 1, n - k))
    return f"{k} of {n} ({100.0 * k / n:.1f} %, 95 % bounds {100.0 * low:.1f} to {100.0 * high:.1f})"
