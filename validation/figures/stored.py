"""Measured values as they are stored: NAME.json, with commit, date, seeds, load and a tolerance for each value."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from dvl_calib_ros.errors import InputError

from .registry import ROOT, Found, Measurement

MEASURED = ("dvl_calib_ros", "benchmarks", "bags")
_NUMBER = re.compile(r"-?\d+\.\d+")
FOLDER = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Value:
    """low, high: 95 % bounds. n: of how many."""

    value: float | str
    tolerance: float = 0.0
    low: float | None = None
    high: float | None = None
    n: int | None = None

    def __str__(self) -> str:
        return self.value if isinstance(self.value, str) else f"{self.value:.5g}"

    def __format__(self, spec: str) -> str:
        """As a number; `abs.1f` without its sign; `bounds.1f` is VALUE (LOW .. HIGH, n = N)."""
        if spec.startswith("abs"):
            return format(abs(float(self.value)), spec.removeprefix("abs"))
        if not spec.startswith("bounds"):
            return format(self.value, spec)
        digits = spec.removeprefix("bounds") or "g"
        return f"{self.value:{digits}} ({self.low:{digits}} .. {self.high:{digits}}, n = {self.n})"

    def differs(self, other: Value) -> bool:
        """Whether another measurement of the same is farther off than the tolerance."""
        if isinstance(self.value, str) or isinstance(other.value, str):
            return not _alike(str(self.value), str(other.value))
        return not abs(self.value - other.value) <= self.tolerance


def _alike(one: str, other: str) -> bool:
    """Whether two texts are the same but for a last digit of their numbers."""
    texts, numbers = zip(*((_NUMBER.split(text), _NUMBER.findall(text)) for text in (one, other)), strict=True)
    return texts[0] == texts[1] and all(
        abs(float(a) - float(b)) <= 1.01 * 10.0 ** -len(a.partition(".")[2]) for a, b in zip(*numbers, strict=True)
    )


@dataclass(frozen=True)
class Stored:
    """A measurement as it was made. load: of the machine over a minute, before and after."""

    name: str
    command: str
    commit: str
    date: str
    seeds: str
    load: tuple[float, float]
    values: Mapping[str, Value]

    def __getitem__(self, key: str) -> Any:
        """A value, or `made`, `load`, `commit`, `date`, `command`, `seeds`; for templates."""
        if key == "made":
            seeds = "" if self.seeds == "none" else f", {self.seeds}"
            return (
                f"`python -m validation figures {self.name}` ({self.command}{seeds}), commit {self.commit}, {self.date}"
            )
        if key == "load":
            return f"{self.load[0]:.1f} to {self.load[1]:.1f}"
        if key in ("commit", "date", "command", "seeds"):
            return getattr(self, key)
        return self.values[key]


def stored_of(measured: Measurement, found: Found, load: tuple[float, float], commit: str) -> Stored:
    """What a measurement gave, today."""
    values = {}
    for name, each in found.items():
        if isinstance(each, str):
            values[name] = Value(each)
        elif isinstance(each, tuple):
            values[name] = Value(each[0], measured.tolerance(name, each[0]), *each[1:])
        else:
            values[name] = Value(float(each), measured.tolerance(name, float(each)))
    date = datetime.now(timezone.utc).strftime("%-d %B %Y")
    return Stored(measured.name, measured.command, commit, date, measured.seeds, load, values)


def load_average() -> float:
    """Of the last minute."""
    return os.getloadavg()[0]


def save(stored: Stored) -> None:
    """Write NAME.json."""
    document = asdict(stored)
    document["values"] = {
        name: {key: item for key, item in asdict(each).items() if item is not None}
        for name, each in stored.values.items()
    }
    path = FOLDER / f"{stored.name}.json"
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=True) + "\n")


def load(name: str) -> Stored:
    """Raises InputError if it was never measured."""
    path = FOLDER / f"{name}.json"
    if not path.is_file():
        raise InputError(f"{path}: not there; make it with: python -m validation figures {name}")
    document = json.loads(path.read_text())
    document["values"] = {key: Value(**each) for key, each in document["values"].items()}
    return Stored(**{**document, "load": tuple(document["load"])})


def git(*arguments: str) -> str:
    """Output of git in this tree. Raises InputError where there is none."""
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError(f"git {arguments[0]} does not work in {ROOT}; figures name the commit they are of") from error
    return done.stdout.strip()


def head() -> str:
    """The last commit that changed what is measured; with a + where this tree differs from it."""
    changed = git("status", "--porcelain", "--untracked-files=no", "--", *MEASURED)
    return git("log", "-1", "--format=%h", "--abbrev=10", "--", *MEASURED) + "+" * bool(changed)
