"""What somebody waits for who types a command: CPU of the whole process, its imports among it.

The peer is an interpreter that does nothing, which is in all of them. Bags are simulated, with a lever arm and a delay.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from . import Measurement

ROUNDS = 2
# What all are divided by takes 15 ms: its noise would be that of all ratios.
ROUNDS_OF_NOTHING = 20
_DVL_CALIB = ["-m", "dvl_calib_ros.cli.main"]
_EFFECTS = ["--effect", "lever_arm:x_m=-1.2", "--effect", "dvl_time_offset:seconds=0.25"]
RECORDINGS = 5


def measure(quick: bool = False) -> list[Measurement]:
    """Help, doctor and replay of ten minutes; diagnosis of ten minutes, of five recordings and of an hour.

    quick: only the first three, in half the rounds.
    """
    nothing = _cpu(["-c", "pass"], ROUNDS_OF_NOTHING)
    rounds = ROUNDS // 2 if quick else ROUNDS
    with tempfile.TemporaryDirectory() as folder:
        ten = _bag(folder, "ten", 600.0, 5.0)
        cases = [
            ("dvl-calib --help", ["--help"], 0.1),
            ("dvl-calib doctor, ten minutes at 5 Hz", ["doctor", ten], 2.0),
            ("dvl-calib replay, ten minutes at 5 Hz", ["replay", ten], 1.0),
        ]
        if not quick:
            hour = _bag(folder, "hour", 3600.0, 10.0)
            each = [_bag(folder, f"of_400_s_{seed}", 400.0, 5.0, seed) for seed in range(RECORDINGS)]
            cases += [
                ("dvl-calib diagnose, ten minutes at 5 Hz", ["diagnose", ten], 5.0),
                (f"dvl-calib diagnose, {RECORDINGS} recordings of 400 s at 5 Hz", ["diagnose", *each], 15.0),
                ("dvl-calib diagnose, an hour at 10 Hz", ["diagnose", hour], 30.0),
            ]
        # what is over at once is as often disturbed as an interpreter that does nothing
        often = {"--help": ROUNDS_OF_NOTHING}
        found = [
            (what, _cpu([*_DVL_CALIB, *arguments], often.get(arguments[0], rounds)), limit)
            for what, arguments, limit in cases
        ]
    return [
        Measurement(
            f"{what}, CPU",
            f"{seconds:.2f} s",
            f"{nothing:.3f} s (interpreter)",
            f"{seconds / nothing:.1f}",
            f"<= {limit:g} s",
            seconds <= limit,
            seconds / nothing,
        )
        for what, seconds, limit in found
    ]


def _bag(folder: str, name: str, seconds: float, rate_hz: float, seed: int = 0) -> str:
    path = str(Path(folder) / name)
    rates = ["--dvl-rate", f"{rate_hz:g}", "--gnss-rate", f"{rate_hz:g}"]
    motion = ["--trajectory", "lawnmower", "--duration", f"{seconds:g}", "--seed", str(seed)]
    command = [sys.executable, *_DVL_CALIB, "simulate", path, *motion, *rates, *_EFFECTS]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return path


def _cpu(arguments: list[str], rounds: int) -> float:
    """CPU time (s), user and system, of an interpreter with arguments; the least of some, as others only ever add.

    With bytecode, as of what is installed: the first time compiles it.
    """
    times = []
    with tempfile.TemporaryDirectory() as bytecode:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = bytecode
        for _ in range(1 + rounds):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times)
