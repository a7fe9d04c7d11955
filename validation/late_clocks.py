"""One cause, one answer: what doctor, replay and diagnose say of a late reference and of a late DVL.

On four manoeuvres, at several rates, with a lever arm of -0.6 m that nobody told. A case is right where all three name
the same clock by its size (within 0.05 s and 3 %) and replay calibrates with it, and open where none of them names one.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import dvl_calib_ros as dc
from dvl_calib_ros.bags.writer import Compression, Storage
from dvl_calib_ros.diagnosis.results import FoundEffect
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

CLOCKS = {"reference": "reference_time_offset", "dvl": "dvl_time_offset"}
LATE_S = (0.1, 0.8, 2.5, 5.0, 7.5, 30.0)
MANOEUVRES = ("free", "box", "lawnmower", "figure8")
RATES_HZ = (1.0, 5.0, 10.0)
ARM_M, ARM_WITHIN_M = -0.6, 0.2
# A delay below this is nothing that has to be named, s
SPOKEN_OF_S, SIGMAS = 0.05, 2.0
Said = dict[str, float]
"""Parameter of a clock -> by how much it is late, s."""


def main(argv: Sequence[str]) -> int:
    """Run and print a line a case; 0, or 1 where commands disagree."""
    parser = argparse.ArgumentParser(prog="python -m validation late_clocks", description=__doc__)
    for name, default in (("clocks", CLOCKS), ("late", LATE_S), ("manoeuvres", MANOEUVRES), ("rates", RATES_HZ)):
        parser.add_argument(f"--{name}", default=",".join(f"{each}" for each in default), help="default: %(default)s")
    given = parser.parse_args(argv)
    unknown = {*given.clocks.split(",")} - {*CLOCKS} | {*given.manoeuvres.split(",")} - {*MANOEUVRES}
    if unknown:
        raise InputError(f"{', '.join(sorted(unknown))}: there are {', '.join((*CLOCKS, *MANOEUVRES))}")
    outcomes: Counter[str] = Counter()
    for clock in given.clocks.split(","):
        for late in map(float, given.late.split(",")):
            for manoeuvre in given.manoeuvres.split(","):
                for rate in map(float, given.rates.split(",")):
                    outcome, said = _case(manoeuvre, CLOCKS[clock], late, rate)
                    outcomes[outcome] += 1
                    print(f"{clock:9} {late:5.1f} s  {manoeuvre:9} {rate:4.0f} Hz  {outcome:8}  {said}", flush=True)
    print(", ".join(f"{outcome} {n}" for outcome, n in outcomes.items()))
    return 1 if outcomes["disagree"] else 0


def _case(manoeuvre: str, clock: str, late: float, rate: float) -> tuple[str, str]:
    """What comes of one recording, in a word and in figures."""
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "late"
        effects = injection(f"lever_arm:x_m={ARM_M}"), injection(f"{clock}:seconds={late}")
        errors = DvlErrors((0.01, -0.01, 0.02), (0.003,) * 3, beam_std=0.005)
        scenario = Scenario(manoeuvre, 300.0, 3, errors, gnss_std=0.05, effects=effects, dvl_rate=rate, gnss_rate=rate)
        write_bag(scenario, bag, Storage.MCAP, Compression.NONE)
        examined = dc.doctor(bag)
        replayed = dc.replay(bag, history=False)
        diagnosed = dc.diagnose(bag)
    clocks = examined.discovery.clocks
    by_doctor: Said = {} if clocks is None else dict(clocks.registration.offsets)
    by_diagnosis = {
        each.name: each.parameters["seconds"][0]
        for each in diagnosed.effects
        if isinstance(each, FoundEffect) and each.name in CLOCKS.values()
    }
    result = replayed.replayed.result
    estimate = result.estimate
    by_replay = {name: float(result.parameters[name]) for name in CLOCKS.values()}
    arm = float("nan")
    std = estimate.std_of("time_offset")
    if std is not None:
        delay = estimate.state_of("time_offset")
        by_replay["dvl_time_offset"] += delay if abs(delay) > SIGMAS * std[0] else 0.0
        arm = estimate.state_of("lever_arm_x")
    each = [_spoken_of(one) for one in (by_doctor, by_replay, by_diagnosis)]
    calibrates = replayed.verdict != "reject" and (np.isnan(arm) or abs(arm - ARM_M) < ARM_WITHIN_M)
    is_right = [one.keys() == {clock} and abs(one[clock] - late) <= 0.05 + 0.03 * late for one in each]
    said = "  ".join(
        f"{name} {', '.join(f'{c[:3]} {s:+.2f}' for c, s in one.items()) or '-'}"
        for name, one in zip(("doctor", "replay", "diagnose"), each, strict=True)
    )
    said += f"  {replayed.verdict}, arm {arm:+.2f}"
    if all(is_right):
        return "right" if calibrates else "disagree", said
    return "disagree" if any(each) else "open", said


def _spoken_of(said: Said) -> Said:
    return {name: late for name, late in said.items() if abs(late) >= SPOKEN_OF_S}
