"""The diagnosis judged on recordings of a second generator, which was written without a look at its code.

Half of the cases have nothing wrong, by kind of noise; the others one effect of the table, two or three, or one that
the table does not have. Sizes are in sigma: q of the effect after the calibration, q_left after the other effects too.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from dvl_calib_ros.errors import InputError

from .drawn import share
from .second_recordings import HULLS, Array, Case, Effects, Motion, Noise, motion_of, residual, streams_of, write
from .stacks import ROOT

KINDS = ("white", "slow", "tails", "tails and slow", "gaps")
CLASSES = ("one", "several", "one", "outside")
# From 4 sigma on a linear test tells an effect from chance
VISIBLE_Q = 4.0
# Sizes drawn, in sigma, and the least that is kept of an effect together with others
SIZES_Q, LEAST_Q = (4.0, 80.0), 2.5
# A size stays within these ratios of the nominal one, whatever q that is
RATIOS = (0.1, 6.0)
# By how much less a closure on a second recording may be than the least that was claimed
SECOND_LESS = 0.1
# Half a per cent is rounding: an interval of 1.00 to 1.00 holds 0.997
CLOSURE_ROUNDING = 0.005
LONGEST_S = 300.0
# Two samples that are farther apart than so many periods have a drop-out between them: one lost sample is none
LONGEST_PERIODS = 2.5
# Parameters that say when, which or how long: not a size
TIMES = ("at_s", "again_at_s", "from_s", "to_s", "period_s", "phase", "beam", "width_s")
Result = dict[str, Any]
Drawn = Callable[[np.random.Generator, float], dict[str, float]]


def _vector(size: float, *keys: str) -> Drawn:
    """Return what draws a vector of any direction and a nominal length; of one key: its sign."""

    def draw(rng: np.random.Generator, _: float) -> dict[str, float]:
        way = rng.normal(size=len(keys))
        return dict(zip(keys, (size * way / np.linalg.norm(way)).tolist(), strict=True))

    return draw


def _later(size: float, key: str, **times: tuple[float, float]) -> Drawn:
    """Return what draws a size of either sign, with times in shares of the recording."""

    def draw(rng: np.random.Generator, seconds: float) -> dict[str, float]:
        return {key: size * float(rng.choice([-1, 1])),
                **{name: seconds * float(rng.uniform(*within)) for name, within in times.items()}}  # fmt: skip

    return draw


def _lock(rng: np.random.Generator, seconds: float) -> dict[str, float]:
    """Draw a current that the DVL tracks for a half or the whole of the recording."""
    lock = _vector(0.12, "east_mps", "north_mps")(rng, seconds)
    if rng.random() < 0.5:
        lock |= {"from_s": seconds * float(rng.uniform(0.1, 0.3)), "to_s": seconds * float(rng.uniform(0.6, 0.9))}
    return lock


def _beam(rng: np.random.Generator, _: float) -> dict[str, float]:
    return {"mps": 0.1 * float(rng.choice([-1, 1])), "beam": float(rng.integers(4)),
            "period_s": float(rng.uniform(40, 120)), "phase": float(rng.random())}  # fmt: skip


TABLE: dict[str, Drawn] = {
    "lever_arm": _vector(0.5, "x_m", "y_m", "z_m"),
    "dvl_time_offset": _vector(0.2, "seconds"),
    "reference_time_offset": _vector(0.2, "seconds"),
    "attitude_time_offset": _vector(0.2, "seconds"),
    "time_offset_jump": _later(0.4, "seconds", at_s=(0.25, 0.75)),
    "clock_drift": _vector(6.0, "seconds_per_hour"),
    "reference_lag": lambda *_: {"time_constant_s": 0.4},
    "velocity_bias": _vector(0.04, "x_mps", "y_mps", "z_mps"),
    "quadratic_scale": _vector(0.015, "coefficient_s_per_m"),
    "scale_drift": _vector(0.2, "rate_per_hour"),
    "sound_speed_layer": _vector(0.002, "ratio_per_m"),
    "misalignment_drift": _vector(0.3, "y_rad_per_hour", "z_rad_per_hour"),
    "mount_flexure": _vector(0.02, "y_rad_per_mps", "z_rad_per_mps"),
    "axis_nonorthogonality": _vector(0.03, "xy_rad", "xz_rad", "yz_rad"),
    "heading_error": _vector(0.03, "sin_rad", "cos_rad"),
    "water_lock": _lock,
    "sideslip": _vector(0.2, "coefficient_s"),
    "tilt_coupling": _vector(0.2, "x_per_pitch", "z_per_pitch", "y_per_roll", "z_per_roll"),
}
OUTSIDE: dict[str, Drawn] = {
    "thrust_bias": _vector(0.04, "mps"),
    "switched_beam": _beam,
    "magnetic_passage": _later(0.15, "rad", at_s=(0.2, 0.8), width_s=(0.02, 0.06)),
    "roll_rate_coupling": _vector(0.8, "m"),
}


def _noise(rng: np.random.Generator, kind: str) -> Noise:
    """Draw instruments with a kind of noise; claims of half of them are wrong."""
    dvl, reference = float(np.exp(rng.uniform(*np.log([0.003, 0.015])))), float(rng.uniform(0.01, 0.05))
    claims = 3.0 ** rng.uniform(-1.0, 1.0, 2) if rng.random() < 0.5 else np.ones(2)
    slow, tails, gaps = "slow" in kind, "tails" in kind, kind == "gaps"
    return Noise(
        kind, dvl, reference, (float(rng.uniform(0.5, 1.0)), float(rng.uniform(1.0, 2.0))),
        slow * float(rng.choice([0.0, rng.uniform(0.3, 0.8)])) * dvl, slow * float(rng.uniform(0.3, 1.0)) * reference,
        slow * math.radians(rng.uniform(0.03, 0.12)), float(rng.uniform(10.0, 60.0)),
        (tails and bool(rng.random() < 0.5), tails),
        (int(gaps * rng.integers(0, 4)), int(gaps * rng.integers(1, 5))), (float(claims[0]), float(claims[1])),
    )  # fmt: skip


def _vehicle(rng: np.random.Generator, seed: tuple[int, ...], kind: str, dives: bool = False) -> Case:
    hull = str(rng.choice(["torpedo", "glider"] if dives else list(HULLS)))
    missions = [each for each in HULLS[hull].missions if not dives or each in ("yo-yo", "spiral")]
    yaw, arm = float(rng.choice([0.0, 0.0, 45.0, -90.0])), rng.normal(0.0, [0.4, 0.1, 0.2])
    x, y, z = np.radians(rng.normal(0.0, [0.7, 0.7, 1.5])).tolist()
    return Case(
        seed, hull, str(rng.choice(missions)), float(rng.uniform(150.0, 600.0)),
        (float(rng.choice([1, 2, 4, 5, 8, 10])), float(rng.choice([1, 2, 5, 10])), float(rng.choice([50, 100]))),
        (0.0, 0.0, math.radians(yaw)), tuple(np.round(arm, 2).tolist()), (x, y, z),
        float(rng.normal(0.0, 0.006)), _noise(rng, kind),
    )  # fmt: skip


def _stamps(case: Case) -> Array:
    return np.arange(0.0, case.seconds, 1.0 / case.rates_hz[0])


def _calibration_columns(case: Case, motion: Motion, stamps: Array) -> list[Array]:
    """Return what three small turns and three scales change in the DVL's velocity, (n, 3) each."""
    at = motion.at(stamps)
    seen = (at.velocity + np.cross(at.rate, case.arm_m)) @ case.calibration.T
    return [*(np.cross(axis, seen) for axis in np.eye(3)), *(seen * axis for axis in np.eye(3))]


def _spectrum(case: Case, motion: Motion, frequencies_hz: Array) -> Array:
    """Return the noise's power in a DVL sample's difference by frequency, (m/s)² (n, 3)."""
    noise, (rate, of_reference, _) = case.noise, case.rates_hz
    a = math.exp(-1.0 / (rate * noise.memory_s))
    slow = (1 - a * a) / (1 - 2 * a * np.cos(2 * np.pi * frequencies_hz / rate) + a * a)
    dvl = noise.dvl**2 + noise.slow_dvl**2 * slow
    reference = noise.reference**2 * rate / of_reference + noise.slow_reference**2 * slow
    horizontal = dvl + reference + noise.slow_heading**2 * float(np.mean(motion.earth[:, :2] ** 2)) * slow
    vertical = dvl * noise.vertical[0] ** 2 + reference * noise.vertical[1] ** 2
    return np.stack([horizontal, horizontal, vertical], -1)


def _received(case: Case, motion: Motion, stamps: Array) -> Array:
    """Return which stamps lie in no drop-out of DVL or reference (n,)."""
    received = np.ones(len(stamps), dtype=bool)
    for stream, rate in zip(streams_of(case, motion)[:2], case.rates_hz, strict=False):
        at = np.r_[-1.0 / rate, stream.measured, case.seconds + 1.0 / rate]
        received &= np.diff(at)[np.searchsorted(at, stamps, side="right") - 1] < LONGEST_PERIODS / rate
    return received


def _left(column: Array, others: Sequence[Array]) -> Array:
    """Return the residual of a column after a least-squares fit of others."""
    matrix = np.stack([each.ravel() for each in others], -1)
    rest: Array = column.ravel() - matrix @ np.linalg.lstsq(matrix, column.ravel(), rcond=None)[0]
    return rest


def visibility(case: Case, motion: Motion) -> dict[str, tuple[float, float]]:
    """Return of each effect its size in sigma: with the calibration fitted, and with the other effects as well."""
    stamps = _stamps(case)
    received = _received(case, motion, stamps)[:, None]
    root = np.sqrt(_spectrum(case, motion, np.fft.rfftfreq(len(stamps), 1.0 / case.rates_hz[0])))

    def whitened(column: Array) -> Array:
        white: Array = np.fft.irfft(np.fft.rfft(column, axis=0) / root, len(column), axis=0) * received
        return white

    calibration = [whitened(each) for each in _calibration_columns(case, motion, stamps)]
    columns = {name: whitened(residual(case, motion, {name: given}, stamps)) for name, given in case.effects.items()}
    sizes = {}
    for name, column in columns.items():
        others = [*calibration, *(each for other, each in columns.items() if other != name)]
        sizes[name] = tuple(float(np.linalg.norm(_left(column, beside))) for beside in (calibration, others))
    return {name: (alone, left) for name, (alone, left) in sizes.items()}


def true_closure(case: Case, motion: Motion, found: Effects) -> float:
    """Return the fall of the squared noise-free error if `found` is corrected, as a share; nan without an error."""
    stamps = _stamps(case)
    calibration = _calibration_columns(case, motion, stamps)
    gap = residual(case, motion, case.effects, stamps)
    before, after = (_left(each, calibration) for each in (gap, gap - residual(case, motion, found, stamps)))
    return 1.0 - float(after @ after) / float(before @ before) if float(before @ before) > 0 else math.nan


def draw(seed: int, number: int, *, only: str | None = None) -> tuple[Case, str]:
    """Return a case and its class: nulls with every kind of noise, and effects, in turn."""
    turn = number if only else number // 2
    group = only or ("null" if number % 2 == 0 else CLASSES[turn % len(CLASSES)])
    of_effects = str(np.random.default_rng((seed, number, 0, 8)).choice(KINDS))
    kind = KINDS[turn % len(KINDS)] if group == "null" else of_effects
    for attempt in itertools.count():
        identity = (seed, number, attempt)
        rng = np.random.default_rng(identity)
        if group == "null":
            return _vehicle(rng, identity, kind), group
        pool = OUTSIDE if group == "outside" else TABLE
        names = rng.choice(list(pool), int(rng.integers(2, 4)) if group == "several" else 1, replace=False)
        case = _vehicle(rng, identity, kind, "sound_speed_layer" in names)
        motion, effects = motion_of(case), {}
        for name in map(str, names):
            given = pool[name](rng, case.seconds)
            nominal = visibility(replace(case, effects={name: given}), motion)[name][0]
            ratio = float(np.clip(np.exp(rng.uniform(*np.log(SIZES_Q))) / nominal, *RATIOS))
            effects[name] = {key: each if key in TIMES else each * ratio for key, each in given.items()}
        case = replace(case, effects=effects)
        if min(left for _, left in visibility(case, motion).values()) >= LEAST_Q:
            return case, group
    raise AssertionError


def _answer(case: Case, folder: Path) -> tuple[dict[str, Any], float]:
    """Return what `dvl-calib diagnose` writes of the case's bag, and its CPU in s."""
    bag, written = folder / "bag", folder / "diagnosis.json"
    write(case, bag)
    line = [sys.executable, "-m", "dvl_calib_ros.cli.main", "diagnose", str(bag), "--json", str(written),
            "--profile", "none", "-p", f"lever_arm:={list(case.arm_m)}",
            "-p", f"mounting_rpy:={list(case.mounting_rpy)}"]  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd=ROOT, timeout=LONGEST_S)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not written.exists():
        return {"verdict": "error", "effects": [], "gap": {}, "says": (done.stderr or done.stdout)[-200:]}, cpu
    document: dict[str, Any] = json.loads(written.read_text())
    return document, cpu


def sizes_of(effects: Sequence[Result]) -> dict[str, dict[str, float]]:
    """Return the sizes of an answer's effects, with the delay or arm that is known only together with one of them."""
    found = {each["name"]: {key: given["value"] for key, given in each["parameters"].items()
                            if given["value"] is not None} for each in effects}  # fmt: skip
    for each in effects:
        both = each.get("combination")
        if not both:
            continue
        known, axis, speed = both["arm_less_speed_times_delay_m"]["value"], both["parameter"], both["speed_mps"]
        if each["name"] == "lever_arm":
            found.setdefault(both["clock"], {"seconds": (found["lever_arm"][axis] - known) / speed})
        else:
            found.setdefault("lever_arm", {axis: known + speed * found[each["name"]]["seconds"]})
    return found


def is_right(group: str, truth: Sequence[str], verdict: str, named: Sequence[Sequence[str]]) -> bool:
    """Return whether a verdict with its sets of effects is right; of an effect outside the table, without a closure."""
    if group == "null":
        return verdict in ("no_gap", "insufficient_excitation")
    if group == "outside":
        return verdict == "unknown"
    return verdict in ("known", "ambiguous") and sorted(truth) in [sorted(each) for each in named]


def judge(seed: int, number: int, *, only: str | None = None) -> Result:
    """Draw, write, diagnose and judge one case."""
    case, group = draw(seed, number, only=only)
    motion = motion_of(case)
    with tempfile.TemporaryDirectory() as folder:
        said, cpu = _answer(case, Path(folder))
    choices = [[each["name"], *each["equivalent_to"]] for each in said["effects"]]
    named = [list(each) for each in itertools.product(*choices)] if choices else []
    found = sizes_of(said["effects"])
    right = is_right(group, list(case.effects), said["verdict"], named)
    interval = said["gap"].get("closure_ci95", [None, None])
    explained = said["verdict"] in ("known", "ambiguous") and None not in interval
    true = true_closure(case, motion, found) if explained and case.effects else None
    second = None
    if group == "outside" and explained:
        rng = np.random.default_rng([*case.seed, 9])
        again = replace(case, seed=(*case.seed, 9), mission=str(rng.choice(HULLS[case.hull].missions)))
        second = true_closure(again, motion_of(again), found)
        right = second >= interval[0] - SECOND_LESS
    sizes = visibility(case, motion) if case.effects else {}
    return {
        "seed": seed, "number": number, "class": group, "right": right, "verdict": said["verdict"], "named": named,
        "says": said.get("says") or said["reasons"][0]["says"], "q": sizes, "closure": said["gap"].get("closure"),
        "closure_ci95": interval, "true_closure": true, "second_closure": second,
        "effects": said["effects"], "cpu_s": cpu, "case": asdict(case),
    }  # fmt: skip


def summary(results: Sequence[Result]) -> list[str]:
    """Return the table: shares with their bounds, CPU, and a line for each miss."""

    def of(*groups: str) -> list[Result]:
        return [each for each in results if each["class"] in groups]

    def line(title: str, rows: Sequence[Result], key: str = "right") -> str:
        return f"{title:<58} {share(sum(bool(each[key]) for each in rows), len(rows))}"

    def is_slow(result: Result) -> bool:
        return "slow" in result["case"]["noise"]["kind"]

    effects, nulls = of("one", "several"), [each | {"alarm": not each["right"]} for each in of("null")]
    plain = [each for each in effects if min(left for _, left in each["q"].values()) >= VISIBLE_Q]
    claimed = [each | {"inside": abs(each["true_closure"] - np.clip(each["true_closure"], *each["closure_ci95"]))
                                 <= CLOSURE_ROUNDING}
               for each in effects if each["true_closure"] is not None]  # fmt: skip
    cpu = [each["cpu_s"] for each in results]
    lines = [
        line("one effect or more: right", effects),
        line(f"  of those with q_left of {VISIBLE_Q:g} and more", plain),
        line("  one effect", of("one")), line("  two or three", of("several")),
        line("  without slow noise", [each for each in effects if not is_slow(each)]),
        line("true closure inside the claimed interval", claimed, "inside"),
        line("  without slow noise", [each for each in claimed if not is_slow(each)], "inside"),
        line("outside the table: unknown, or holds on a second recording", of("outside")),
        line("nulls: false alarms", nulls, "alarm"),
        *(line(f"  {kind}", [each for each in nulls if each["case"]["noise"]["kind"] == kind], "alarm")
          for kind in KINDS),
        f"CPU of a diagnosis: median {np.median(cpu):.1f} s, largest {max(cpu):.1f} s",
    ]  # fmt: skip
    for each in [*effects, *of("outside", "null")]:
        if not each["right"]:
            q = ", ".join(f"{name} {alone:.0f}/{left:.0f}" for name, (alone, left) in each["q"].items()) or "nothing"
            case = each["case"]
            lines.append(f"  {each['seed']} {each['number']} {case['hull']}, {case['mission']}, {case['noise']['kind']}"
                         f" noise; truth (q/q_left): {q}; {each['verdict']}: {each['says']}")  # fmt: skip
    return lines


def main(argv: Sequence[str]) -> int:
    """Judge the cases and print the table; return 0."""
    parser = argparse.ArgumentParser(prog="python -m validation second_trial", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of all cases; default: %(default)s")
    parser.add_argument("--count", type=int, default=48, metavar="N", help="of cases; default: %(default)s")
    parser.add_argument("--only", choices=("null", *dict.fromkeys(CLASSES)), help="cases of one class alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all cases with truth and answer")
    parser.add_argument("--bag", type=Path, metavar="DIR", help="only write the bag of the first case")
    arguments = parser.parse_args(argv)
    if arguments.count < 1 or arguments.seed < 0:
        raise InputError("--seed is 0 or more, --count 1 or more")
    if arguments.bag is not None:
        write(draw(arguments.seed, 0, only=arguments.only)[0], arguments.bag)
        return 0
    results = []
    for number in range(arguments.count):
        results.append(judge(arguments.seed, number, only=arguments.only))
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(results, indent=1) + "\n")
    print("\n".join(summary(results)))
    return 0
