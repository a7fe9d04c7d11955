"""What somebody waits for who types a command: CPU of the whole process, its imports among it.

The peer of what reads a bag is a process that reads and deserialises the same bag with rosbags: it imports, reads and
computes as ours do, so that the ratio is the same on another machine. That of --help is an interpreter that does
nothing. Bags are simulated, with a lever arm and a delay.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from . import Measurement
from .replay import PEER

ROUNDS = 3
# What is over at once is as often disturbed as an interpreter that does nothing, and noise of it that of the ratio
ROUNDS_OF_HELP = 20
_DVL_CALIB = ["-m", "dvl_calib_ros.cli.main"]
_NOTHING = ["-c", "pass"]
_READ = ["-c", PEER + "import sys\nfor bag in sys.argv[1:]:\n    work(bag)\n"]
_EFFECTS = ["--effect", "lever_arm:x_m=-1.2", "--effect", "dvl_time_offset:seconds=0.25"]
RECORDINGS = 5


def measure(quick: bool = False) -> list[Measurement]:
    """Help, doctor and replay of ten minutes; diagnosis of ten minutes, of five recordings and of an hour.

    quick: only the first three.
    """
    with tempfile.TemporaryDirectory() as folder:
        ten = _bag(folder, "ten", 600.0, 5.0)
        found = [_help(), _reading("doctor, ten minutes at 5 Hz", [ten], 2.0)]
        found.append(_reading("replay, ten minutes at 5 Hz", [ten], 1.0))
        if not quick:
            hour = _bag(folder, "hour", 3600.0, 10.0)
            each = [_bag(folder, f"of_400_s_{seed}", 400.0, 5.0, seed) for seed in range(RECORDINGS)]
            found.append(_reading("diagnose, ten minutes at 5 Hz", [ten], 5.0))
            found.append(_reading(f"diagnose, {RECORDINGS} recordings of 400 s at 5 Hz", each, 15.0))
            found.append(_reading("diagnose, an hour at 10 Hz", [hour], 30.0))
    return found


def _help() -> Measurement:
    ours, nothing = _cpu(([*_DVL_CALIB, "--help"], _NOTHING), ROUNDS_OF_HELP)
    return _measurement("--help", ours, nothing, "interpreter", 0.1)


def _reading(what: str, bags: Sequence[str], limit: float) -> Measurement:
    """The command that what begins with, of bags."""
    command = what.replace(",", "").split()[0]
    ours, reading = _cpu(([*_DVL_CALIB, command, *bags], [*_READ, *bags]), ROUNDS)
    return _measurement(what, ours, reading, "rosbags, read and deserialise", limit)


def _measurement(what: str, seconds: float, peer: float, whose: str, limit: float) -> Measurement:
    return Measurement(
        f"dvl-calib {what}, CPU",
        f"{seconds:.2f} s",
        f"{peer:.3f} s ({whose})",
        f"{seconds / peer:.1f}",
        f"<= {limit:g} s",
        seconds <= limit,
        seconds / peer,
    )


def _bag(folder: str, name: str, seconds: float, rate_hz: float, seed: int = 0) -> str:
    path = str(Path(folder) / name)
    rates = ["--dvl-rate", f"{rate_hz:g}", "--gnss-rate", f"{rate_hz:g}"]
    motion = ["--trajectory", "lawnmower", "--duration", f"{seconds:g}", "--seed", str(seed)]
    command = [sys.executable, *_DVL_CALIB, "simulate", path, *motion, *rates, *_EFFECTS]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return path


def _cpu(sides: Sequence[Sequence[str]], rounds: int) -> list[float]:
    """CPU time (s), user and system, of an interpreter with the arguments of each side.

    In turns, and of each the least of some, as others only ever add. With bytecode, as of what is installed: the first
    time compiles it.
    """
    times: list[list[float]] = [[] for _ in sides]
    with tempfile.TemporaryDirectory() as bytecode:
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        environment["PYTHONPYCACHEPREFIX"] = bytecode
        for _ in range(1 + rounds):
            for arguments, own in zip(sides, times, strict=True):
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                done = subprocess.run([sys.executable, *arguments], capture_output=True, env=environment)
                if done.returncode not in (0, 1):  # 1: rejected, which is an answer
                    raise RuntimeError(done.stderr.decode())
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                own.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return [min(own) for own in times]
