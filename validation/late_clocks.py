"""One cause, one answer: what doctor, replay and diagnose say of a late reference and of a late DVL.

On four manoeuvres, at several rates, with a lever arm of -0.6 m that nobody told. A case is right where all three name
the same clock by its size (within 0.05 s and 3 %) and replay calibrates with it; within where all three name it, and
the σ that each says, which holds what may be a lever arm, covers what it is off (3 σ); open where none names one.
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
from dvl_calib_ros.calibration.registration.registration import is_beyond_doubt
from dvl_calib_ros.diagnosis.answer.results import Diagnosis
from dvl_calib_ros.discovery.discovery import Discovery
from dvl_calib_ros.errors import InputError
from dvl_calib_ros.simulation.injection import injection
from dvl_calib_ros.simulation.scenario import Scenario, write_bag
from dvl_calib_ros.simulation.sensors import DvlErrors

CLOCKS = {"reference": "reference_time_offset", "dvl": "dvl_time_offset"}
LATE_S = (0.1, 0.8, 2.5, 5.0, 7.5, 30.0)
MANOEUVRES = ("free", "box", "lawnmower", "figure8")
RATES_HZ = (1.0, 5.0, 10.0)
ARM_M, ARM_WITHIN_M = -0.6, 0.2
# Off by more σ than this is wrong.
WRONG = 3.0
Said = dict[str, tuple[float, float]]
"""Parameter of a clock -> by how much it is late, s, and σ."""


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
    said = [_of_doctor(examined.discovery), _of_replay(replayed), _of_diagnosis(diagnosed)]
    estimate = replayed.replayed.result.estimate
    arm, std = (float("nan"), 0.0)
    if (arm_std := estimate.std_of("lever_arm_x")) is not None:
        arm, std = estimate.state_of("lever_arm_x"), float(arm_std[0])
    calibrates = replayed.verdict != "reject" and (np.isnan(arm) or abs(arm - ARM_M) < max(ARM_WITHIN_M, WRONG * std))
    line = "  ".join(
        f"{name} {', '.join(f'{c[:3]} {late:+.2f}±{off:.2f}' for c, (late, off) in one.items()) or '-'}"
        for name, one in zip(("doctor", "replay", "diagnose"), said, strict=True)
    )
    line += f"  {replayed.verdict}, arm {arm:+.2f}±{std:.2f}"
    if not any(said):
        return "open", line
    if not calibrates or any(one.keys() != {clock} for one in said):
        return "disagree", line
    sizes = [one[clock] for one in said]
    if all(abs(size - late) <= 0.05 + 0.03 * late for size, _ in sizes):
        return "right", line
    return "within" if all(abs(size - late) <= WRONG * off for size, off in sizes) else "disagree", line


def _of_doctor(discovery: Discovery) -> Said:
    found = None if discovery.clocks is None else discovery.clocks.registration
    if found is None:
        return {}
    off = {"dvl_time_offset": found.dvl.std, "reference_time_offset": found.reference.std}
    return {name: (late, off.get(name, found.imu.std)) for name, late in found.offsets.items()}


def _of_replay(replayed: dc.Calibration) -> Said:
    """What is taken off, and the delay that is found, if it is beyond doubt with the reference's clock as it is."""
    result = replayed.replayed.result
    estimate, own = result.estimate, _of_doctor(replayed.discovery)
    said = {name: (float(result.parameters[name]), own.get(name, (0.0, 0.0))[1]) for name in CLOCKS.values()}
    if "time_offset" in estimate.state_names:
        at = estimate.state_names.index("time_offset")
        delay, (taken_off, _) = float(estimate.state[at]), said["dvl_time_offset"]
        variance, is_open = estimate.covariance[at, at], estimate.left_open[at, at]
        if taken_off or is_beyond_doubt(delay, float(np.sqrt(variance - is_open))):
            said["dvl_time_offset"] = taken_off + delay, float(np.sqrt(variance))
    return {name: each for name, each in said.items() if each[0]}


def _of_diagnosis(diagnosed: object) -> Said:
    """Of clocks that no other one could stand in for."""
    said: Said = {}
    for each in diagnosed.effects if isinstance(diagnosed, Diagnosis) else ():
        if each.name in CLOCKS.values() and not {*each.equivalent_to} & {*CLOCKS.values()}:
            value, low, high = each.parameters["seconds"]
            said[each.name] = value, (high - low) / 3.92
    return said
