"""Vehicles with frames and signs as crews get them right and wrong, drawn at random, on physics of their own.

Half of the cases have nothing wrong. `doctor` and `replay` see each bag without options. An answer is wrong if roll,
pitch or yaw is off by more than 3 sigma and 0.7 degrees in the base_link of the vehicle's own TF tree.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dvl_calib_ros.errors import InputError

from .stacks import command, off, rpy_std_deg
from .surveys.physics import FIX, IMU, ODOMETRY, TF, TWIST, Bag

Array = np.ndarray
STEP_S = 0.02
LEAST_DEG = 0.7
# `doctor` and `replay` reject a misalignment from 5 degrees on by design; half a degree for the error of the estimate.
LARGE_DEG = 4.5
GRAVITY = 9.81
# Amplitude of the slow heading and tilt errors of an INS, degrees, and bounds of their periods, s.
HEADING_ERROR_DEG, TILT_ERROR_DEG, ATTITUDE_ERROR_S = 0.15, 0.04, (60.0, 200.0)
LATITUDE, LONGITUDE, METRES_PER_DEGREE = 43.1, 5.9, 111_195.0
DOWN = Rotation.from_euler("x", np.pi)
"""Forward-right-down in forward-left-up, and the reverse."""
NED_FROM_ENU = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
NWU_FROM_ENU = Rotation.from_euler("z", -np.pi / 2)
SAME = Rotation.identity()
OUTCOMES = ("right", "USABLE AND WRONG", "REJECTED", "rejected rightly")


@dataclass(frozen=True)
class Kind:
    """Class of vehicle: speeds m/s, legs s, turn rates deg/s, tilt of waves deg, and what it does besides driving."""

    speeds: tuple[float, float]
    legs: tuple[float, float]
    turn_rates: tuple[float, float]
    tilt: tuple[float, float]
    references: tuple[float, float, float]  # how often: velocity, odometry, positions
    sway: float = 0.0
    vertical: float = 0.0
    dive_deg: float = 0.0


KINDS = {
    "surface craft": Kind((0.8, 2.2), (20.0, 45.0), (5.0, 12.0), (1.5, 3.5), (0.5, 0.25, 0.25)),
    "AUV": Kind((0.8, 1.8), (25.0, 50.0), (4.0, 9.0), (0.4, 1.2), (0.4, 0.5, 0.1), vertical=0.02, dive_deg=9.0),
    "ROV": Kind((0.3, 0.9), (12.0, 30.0), (6.0, 15.0), (0.8, 2.0), (0.4, 0.55, 0.05), sway=0.35, vertical=0.15),
    "tank vehicle": Kind((0.2, 0.6), (6.0, 14.0), (12.0, 30.0), (1.0, 3.0), (0.3, 0.7, 0.0), sway=0.1, vertical=0.05),
}


@dataclass(frozen=True)
class Case:
    """Vehicle and conventions of a seed; angles in degrees of forward-left-up axes, lengths in m, times in s."""

    seed: int
    kind: str
    seconds: float
    z_down: bool
    base: str
    imu: str
    imu_frame: str
    acceleration: bool
    reference: str
    reference_axes: str
    reference_frame: str
    reference_std: float
    dvl: str
    dvl_frame: str
    transform: str
    mounting_yaw: float
    off_rpy: tuple[float, float, float]
    scale: float
    arm: tuple[float, float, float]
    antenna: tuple[float, float, float]
    dvl_std: float
    noise: bool = True

    @property
    def mounted(self) -> Rotation:
        """Return the DVL's true orientation, forward-left-up axes in forward-left-up axes."""
        return Rotation.from_euler("z", self.mounting_yaw, degrees=True) * Rotation.from_euler(
            "xyz", self.off_rpy, degrees=True
        )

    @property
    def to_base(self) -> Rotation:
        """Return the rotation from forward-left-up to the axes of this vehicle's base_link."""
        return DOWN if self.z_down else SAME

    @property
    def data_are_down(self) -> bool:
        """Return whether z of the DVL's data points down."""
        return self.z_down or self.dvl in ("z down, as its transform says", "undeclared frd")

    def accepted(self) -> list[Rotation]:
        """Return the orientations of the DVL in base_link that are right; several if axes are undeclared."""
        data = self.mounted * DOWN if self.data_are_down else self.mounted
        right = [self.to_base * data]
        if self.dvl == "undeclared frd":
            right.append(self.mounted)
            if self.imu == "undeclared ned" and (not self.transform or self.mounting_yaw % 180.0 == 0.0):
                right.append(DOWN * self.mounted * DOWN)  # the same messages come from a vehicle that is z down
        return right

    def conventions(self) -> dict[str, str]:
        """Return what totals are counted by."""
        return {
            "vehicle": self.kind,
            "base": f"z down, {self.base}" if self.z_down else "REP-103",
            "imu": f"{self.imu}, {'with' if self.acceleration else 'no'} acceleration",
            "reference": f"{self.reference}, {self.reference_axes} in {self.reference_frame}",
            "dvl": self.dvl,
            "transform": self.transform or "none",
        }

    def faults(self) -> list[str]:
        """Return what is undeclared or wrong."""
        named = [("IMU", self.imu), ("reference", self.reference_axes), ("DVL", self.dvl)]
        return [f"{name} {what}" for name, what in named if what.startswith(("undeclared", "mirrored", "wrong"))]

    def may_reject(self) -> bool:
        """Return whether a rejection is right: no calibration mends it, or two causes explain the data alike."""
        turned = (self.imu == "undeclared nwu") != (self.reference_axes == "undeclared nwu")
        in_earth = self.reference != "odometry" or self.reference_axes == "undeclared enu"
        return (
            self.dvl.startswith(("mirrored", "wrong"))
            or (turned and in_earth and not self.transform)
            or math.degrees(Rotation.from_euler("xyz", self.off_rpy, degrees=True).magnitude()) >= LARGE_DEG
        )


def draw(seed: int) -> Case:
    """Return the case of a seed."""
    rng = np.random.default_rng([seed, 20])

    def one(shares: dict[Any, float]) -> Any:
        """Draw a key with the share of its value."""
        return list(shares)[int(rng.choice(len(shares), p=np.array([*shares.values()]) / sum(shares.values())))]

    def three(bound: float) -> tuple[float, float, float]:
        x, y, z = (float(each) for each in rng.uniform(-bound, bound, 3))
        return x, y, z

    name = one({"surface craft": 0.35, "AUV": 0.25, "ROV": 0.25, "tank vehicle": 0.15})
    z_down = one({False: 0.85, True: 0.15})
    base = one({"base_link": 0.5, "base_link_frd": 0.3, "base_link_ned": 0.2}) if z_down else "base_link"
    transform = one({"": 0.3, "/tf_static": 0.45, "URDF": 0.25})
    reference = one(dict(zip(("velocity", "odometry", "positions"), KINDS[name].references, strict=True)))
    clean = one({True: 0.5, False: 0.5})
    imu, axes, dvl = "ned" if z_down else "enu", "declared", "own axes"
    if transform and not z_down and one({True: 0.2, False: 0.8}):
        dvl = "z down, as its transform says"
    own_axes = dvl
    while not clean and (imu, axes, dvl) == ("ned" if z_down else "enu", "declared", own_axes):
        if not z_down:
            imu = one({"enu": 0.7, "undeclared ned": 0.18, "undeclared nwu": 0.12})
        if reference == "velocity":
            axes = one({"declared": 0.7, "undeclared ned": 0.18, "undeclared nwu": 0.12})
        elif reference == "odometry":
            axes = one({"declared": 0.6, "undeclared enu": 0.2, "undeclared ned" if z_down else "undeclared frd": 0.2})
        # of a vehicle that is z down the DVL's data are so as well, as its transform says
        shares = {own_axes: 0.65, "mirrored y": 0.05, "mirrored z": 0.05}
        if not z_down:
            shares["undeclared frd"] = 0.15
        if transform:
            shares["wrong sign of yaw in the transform"] = 0.1
        dvl = one(shares)
    yaw = one({0.0: 0.5, 45.0: 0.2, 90.0: 0.1, 135.0: 0.08, 180.0: 0.12}) * one({1.0: 0.5, -1.0: 0.5})
    if dvl.startswith("wrong"):
        yaw = one({45.0: 0.5, 90.0: 0.3, 135.0: 0.2}) * one({1.0: 0.5, -1.0: 0.5})
    frame = {"odometry": "odom", "positions": "gnss_link"}.get(reference, "")
    if reference == "velocity":
        if axes == "declared":
            told = {"ned": 0.7, "map_ned": 0.3} if z_down else {"enu": 0.3, "map": 0.3, "world": 0.2, "ned": 0.2}
        else:
            told = {"world": 0.5, "map": 0.5}
        frame = one(told)
    std = {"tank vehicle": (0.004, 0.01), "surface craft": (0.02, 0.05)}.get(name, (0.01, 0.03))
    return Case(
        seed, name, float(rng.uniform(360.0, 600.0)), z_down, base, imu,
        "imu_link" if transform or z_down else one({base: 0.5, "imu_link": 0.5}),
        one({True: 0.6, False: 0.4}), reference, axes, frame, float(rng.uniform(*std)), dvl,
        "dvl_link", transform, float(yaw), three(3.0), float(rng.uniform(-0.01, 0.01)), three(1.0 / math.sqrt(3.0)),
        three(0.6) if reference == "positions" and transform else (0.0, 0.0, 0.0), float(rng.uniform(0.004, 0.015)),
    )  # fmt: skip


@dataclass(frozen=True)
class Motion:
    """Forward-left-up body in ENU: velocity, turn rate, acceleration less gravity in the body, position; (N, 3)."""

    attitude: Rotation
    velocity: Array
    rate: Array
    force: Array
    position: Array


def motion_of(case: Case) -> Motion:
    """Return what the vehicle does."""
    rng, kind = np.random.default_rng([case.seed, 21]), KINDS[case.kind]
    time = np.arange(0.0, case.seconds, STEP_S)

    def swell(amplitude: float, low_s: float = 3.0, high_s: float = 8.0) -> Array:
        """Return two waves of periods between the bounds."""
        angles = (2 * np.pi * (time / rng.uniform(low_s, high_s) + rng.random()) for _ in range(2))
        return amplitude * (np.sin(next(angles)) + 0.5 * np.sin(next(angles)))

    turn, surge, sway, dive = (np.zeros_like(time) for _ in range(4))
    low, high = kind.speeds
    speeds = (rng.uniform(low, 0.6 * low + 0.4 * high), rng.uniform(0.4 * low + 0.6 * high, high))
    begun, leg, side = 0.0, 0, int(rng.choice([-1, 1]))
    while begun < case.seconds:
        length = rng.uniform(*kind.legs)
        here = (time >= begun) & (time < begun + length)
        speed = speeds[leg % 2] * rng.uniform(0.9, 1.1)
        surge[here] = speed
        sway[here] = kind.sway * rng.uniform(-1.0, 1.0)
        dive[here] = kind.dive_deg * rng.uniform(-1.0, 1.0)
        rate, angle = rng.uniform(*kind.turn_rates), rng.uniform(40.0, 180.0)
        # turns to both sides: sides alternate, then come at random
        side = -side if leg < 4 else int(rng.choice([-1, 1]))
        turning = (time >= begun + length) & (time < begun + length + angle / rate)
        turn[turning], surge[turning] = side * math.radians(rate), speed
        begun, leg = begun + length + angle / rate, leg + 1
    smooth = {name: gaussian_filter1d(each, seconds / STEP_S) for name, each, seconds in (
        ("turn", turn, 0.7), ("surge", surge, 1.5), ("sway", sway, 1.5), ("dive", dive, 3.0))}  # fmt: skip
    tilt = math.radians(rng.uniform(*kind.tilt))
    yaw = rng.uniform(-np.pi, np.pi) + np.cumsum(smooth["turn"]) * STEP_S
    roll = swell(tilt) - rng.uniform(0.1, 0.4) * smooth["turn"] * smooth["surge"]
    pitch = swell(0.7 * tilt) + np.radians(smooth["dive"] + rng.uniform(-1.5, 1.5))
    attitude = Rotation.from_euler("ZYX", np.c_[yaw, pitch, roll])
    orbital = 0.6 * tilt  # m/s: 0.03 in waves that tilt by 3 degrees
    velocity = np.c_[
        smooth["surge"] * (1.0 - np.exp(-time / 5.0)) + swell(orbital),
        smooth["sway"] - rng.uniform(0.05, 0.3) * smooth["surge"] * smooth["turn"] + swell(orbital),
        swell(0.5 * orbital),
    ]
    if not kind.dive_deg:  # the vertical is held, whatever the pitch
        up = swell(orbital) + swell(kind.vertical, 25.0, 60.0)
        velocity[:, 2] += (up - attitude.apply(velocity)[:, 2]) / attitude.as_matrix()[:, 2, 2]
    over_ground = attitude.apply(velocity)
    turned = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / (2 * STEP_S)
    force = attitude.inv().apply(np.gradient(over_ground, STEP_S, axis=0) + np.array([0.0, 0.0, GRAVITY]))
    position = np.cumsum((over_ground[1:] + over_ground[:-1]) / 2 * STEP_S, axis=0)
    return Motion(attitude, velocity, np.vstack([turned[:1], turned, turned[-1:]]), force,
                  np.vstack([np.zeros(3), position]))  # fmt: skip


def dvl_velocities(case: Case, motion: Motion) -> Array:
    """Return what the DVL would send without noise, m/s (N, 3)."""
    at_dvl = motion.velocity + np.cross(motion.rate, case.arm)
    data = (1.0 + case.scale) * case.mounted.inv().apply(at_dvl)
    if case.data_are_down:
        data = DOWN.apply(data)
    if case.dvl.startswith("mirrored"):
        data[:, "xyz".index(case.dvl[-1])] *= -1.0
    return data


def write(case: Case, path: Path) -> None:
    """Write the bag of a case to a new folder."""
    rng, motion, bag = np.random.default_rng([case.seed, 22]), motion_of(case), Bag()
    n = len(motion.velocity)

    def noise(std: float, k: int) -> Array:
        return rng.normal(0.0, std, (k, 3)) * case.noise

    def every(step: int, begin: int) -> Array:
        return np.arange(begin, n - 1, step)

    at = every(int(rng.choice([5, 10])), 25)
    bias = noise(0.003, 1)
    for i, each in zip(at, dvl_velocities(case, motion)[at] + bias + noise(case.dvl_std, len(at)), strict=True):
        bag.add(i * STEP_S + 0.02, "/dvl/velocity", TWIST,
                bag.velocity(TWIST, i * STEP_S, case.dvl_frame, each, case.dvl_std))  # fmt: skip
    _write_reference(case, motion, bag, every(int(rng.choice([5, 10])), 17), noise)
    waves = 2 * np.pi * STEP_S * np.arange(n)[:, None] / rng.uniform(*ATTITUDE_ERROR_S, 3) + rng.uniform(0.0, 6.0, 3)
    slow = case.noise * np.array([TILT_ERROR_DEG, TILT_ERROR_DEG, HEADING_ERROR_DEG]) * np.sin(waves)
    seen = Rotation.from_euler("xyz", slow, degrees=True) * motion.attitude
    _write_imu(case, motion, seen, bag, every(2, 5), noise)
    _write_transforms(case, bag)
    bag.write(path)


def _write_imu(case: Case, motion: Motion, seen: Rotation, bag: Bag, at: Array, noise: Any) -> None:
    world = {"enu": SAME, "undeclared nwu": NWU_FROM_ENU}.get(case.imu, NED_FROM_ENU)
    axes = DOWN if case.imu.endswith("ned") else SAME
    turned = (world * seen[at] * axes).as_quat().tolist()
    rates = axes.apply(motion.rate[at] + noise(0.001, len(at)))
    forces = axes.apply(motion.force[at] + noise(0.03, len(at)))
    small, none = (1e-6 * np.eye(3)).ravel(), np.array([-1.0, *[0.0] * 8])
    for k, i in enumerate(at):
        orientation = bag.new("geometry_msgs/msg/Quaternion", *turned[k])
        force = bag.vector(forces[k] if case.acceleration else np.zeros(3))
        message = bag.new(IMU, bag.header(i * STEP_S, case.imu_frame), orientation, small, bag.vector(rates[k]), small,
                          force, 900.0 * small if case.acceleration else none)  # fmt: skip
        bag.add(i * STEP_S + 0.003, "/imu/data", IMU, message)


def _write_reference(case: Case, motion: Motion, bag: Bag, at: Array, noise: Any) -> None:
    """Write velocity over ground, odometry or positions."""
    attitude, std = motion.attitude[at], case.reference_std
    over_ground = attitude.apply(motion.velocity[at]) + noise(std, len(at))
    world = NED_FROM_ENU if case.z_down else SAME
    if case.reference == "positions":
        std *= 0.5
        for i, (east, north, up) in zip(
            at, motion.position[at] + attitude.apply(case.antenna) + noise(std, len(at)), strict=True
        ):
            message = bag.new(
                FIX, bag.header(i * STEP_S, case.reference_frame), bag.new("sensor_msgs/msg/NavSatStatus", 2, 1),
                LATITUDE + north / METRES_PER_DEGREE,
                LONGITUDE + east / (METRES_PER_DEGREE * math.cos(math.radians(LATITUDE))), float(up),
                (std**2 * np.eye(3)).ravel(), 2,
            )  # fmt: skip
            bag.add(i * STEP_S + 0.05, "/gnss/fix", FIX, message)
        return
    if case.reference == "velocity":
        if case.reference_frame.endswith("ned") or case.reference_axes == "undeclared ned":
            world = NED_FROM_ENU
        elif case.reference_axes == "undeclared nwu":
            world = NWU_FROM_ENU
        for i, each in zip(at, world.apply(over_ground), strict=True):
            bag.add(i * STEP_S + 0.05, "/gnss/velocity", TWIST,
                    bag.velocity(TWIST, i * STEP_S, case.reference_frame, each, std))  # fmt: skip
        return
    sent = case.to_base.apply(attitude.inv().apply(over_ground))
    sent = {"undeclared frd": DOWN.apply(sent), "undeclared enu": over_ground,
            "undeclared ned": NED_FROM_ENU.apply(over_ground)}.get(case.reference_axes, sent)  # fmt: skip
    positions = world.apply(motion.position[at])
    poses = world * attitude * case.to_base
    for k, i in enumerate(at):
        message = bag.velocity(ODOMETRY, i * STEP_S, case.base, sent[k], std)
        message.header.frame_id = "odom_ned" if case.z_down else case.reference_frame
        message.pose.pose.position = bag.new("geometry_msgs/msg/Point", *positions[k].tolist())
        message.pose.pose.orientation = bag.quaternion(poses[k])
        bag.add(i * STEP_S + 0.05, "/ins/odometry", ODOMETRY, message)


def _write_transforms(case: Case, bag: Bag) -> None:
    """Write where DVL, IMU and antenna are, in the axes of the vehicle's base_link."""
    if not case.transform and not case.z_down:
        return
    yaw = -case.mounting_yaw if case.dvl.startswith("wrong") else case.mounting_yaw
    nominal = case.to_base * Rotation.from_euler("z", yaw, degrees=True)
    if case.z_down or case.dvl == "z down, as its transform says":
        nominal = nominal * DOWN
    told = [("imu_link", np.zeros(3), SAME)]
    if case.transform:
        told.append((case.dvl_frame, case.to_base.apply(case.arm), nominal))
    if case.reference == "positions":
        told.append((case.reference_frame, case.to_base.apply(case.antenna), SAME))
    if case.transform == "URDF":
        joints = "".join(
            f'<link name="{name}"/><joint name="{name}_joint" type="fixed"><parent link="{case.base}"/>'
            f'<child link="{name}"/><origin xyz="{" ".join(f"{each:.6f}" for each in place)}" '
            f'rpy="{" ".join(f"{each:.9f}" for each in turn.as_euler("xyz"))}"/></joint>'
            for name, place, turn in told
        )
        text = f'<robot name="vehicle"><link name="{case.base}"/>{joints}</robot>'
        bag.add(0.0, "/robot_description", "std_msgs/msg/String", bag.new("std_msgs/msg/String", text))
        return
    transforms = [
        bag.new("geometry_msgs/msg/TransformStamped", bag.header(0.0, case.base), name,
                bag.new("geometry_msgs/msg/Transform", bag.vector(place), bag.quaternion(turn)))
        for name, place, turn in told
    ]  # fmt: skip
    bag.add(0.0, "/tf_static", TF, bag.new(TF, transforms))


@dataclass
class Answer:
    """Outcome of a case, verdicts, roll, pitch and yaw in degrees with 1 sigma, what is wrong and the reasons."""

    outcome: str
    doctor: str = "none"
    verdict: str = "none"
    rpy: str = "none"
    said: list[str] = field(default_factory=list)

    @property
    def contradicts(self) -> bool:
        """Return whether doctor says yes where replay rejects, or no where it does not."""
        return (self.doctor, self.verdict) in (("yes", "reject"), ("no", "accept"), ("no", "marginal"))


def errors_of(rpy: Sequence[float], std_deg: Array, truth: Rotation) -> list[str]:
    """Return the angles of an answer (rad) that are wrong."""
    wrong = []
    true = truth.as_euler("xyz", degrees=True)
    for name, value, sigma, right in zip(("roll", "pitch", "yaw"), np.degrees(rpy), std_deg, true, strict=True):
        difference = math.remainder(value - right, 360.0)
        if off(difference, 0.0, sigma, LEAST_DEG):
            wrong.append(f"{name} off by {difference:+.2f} ± {sigma:.2f}")
    return wrong


def judge(case: Case, folder: Path) -> Answer:
    """Write the bag of a case and judge what doctor and replay say of it."""
    bag, examined, replayed, saved = (folder / name for name in ("bag", "doctor.json", "replay.json", "saved.yaml"))
    write(case, bag)
    said = command("doctor", bag, "--json", examined)
    said += command("replay", bag, "--json", replayed, "--save", saved)
    rejected = "rejected rightly" if case.may_reject() else "REJECTED"
    if not examined.exists() or not replayed.exists() or not saved.exists():
        return Answer(rejected, said=["no answer", *said.strip().splitlines()[-1:]])
    document = yaml.safe_load(saved.read_text())
    verification = document["verification"]
    answer = Answer(rejected, json.loads(examined.read_text())["verdict"], verification["verdict"])
    mounting = document["mounting"]
    rpy = mounting["corrected_rpy"]
    std = rpy_std_deg(rpy, np.array(mounting["pose_covariance"])[3:, 3:])
    answer.rpy = " ".join(f"{each:+.2f} ± {sigma:.2f}" for each, sigma in zip(np.degrees(rpy), std, strict=True))
    if answer.verdict != "reject":
        wrong = min((errors_of(rpy, std, truth) for truth in case.accepted()), key=len)
        answer.outcome = "USABLE AND WRONG" if wrong else "right"
        answer.said += wrong
        others = {"forward-left-up": case.mounted, "z up, DVL z down": case.mounted * DOWN,
                  "z down": DOWN * case.mounted * DOWN, "z down, DVL z up": DOWN * case.mounted}  # fmt: skip
        answer.said += [f"right if base_link were {name}" for name, truth in others.items()
                        if wrong and not errors_of(rpy, std, truth)]  # fmt: skip
    answer.said += verification["reasons"]
    return answer


def line_of(case: Case, answer: Answer) -> str:
    """Return the line of a case: seed, conventions, answer and truth, reasons."""
    roll, pitch, yaw = case.accepted()[0].as_euler("xyz", degrees=True)
    drawn = "; ".join(f"{name} {what}" for name, what in case.conventions().items())
    contradicts = ", DOCTOR AND REPLAY CONTRADICT" if answer.contradicts else ""
    return (
        f"{case.seed}  {answer.outcome}{contradicts}  doctor {answer.doctor}, replay {answer.verdict}  [{drawn}]  "
        f"wrong: {', '.join(case.faults()) or 'nothing'}  "
        f"answer {answer.rpy}, truth {roll:+.2f} {pitch:+.2f} {yaw:+.2f}  "
        f"{' | '.join(answer.said)}"
    )


def main(argv: Sequence[str]) -> int:
    """Judge the cases; return 0, or 1 if an answer is usable and wrong or doctor and replay contradict each other."""
    parser = argparse.ArgumentParser(prog="python -m validation frames", description=__doc__)
    parser.add_argument("--seed", type=int, default=700, metavar="N", help="of the first case; default: %(default)s")
    parser.add_argument("--count", type=int, default=100, metavar="M", help="of cases; default: %(default)s")
    parser.add_argument("--show", action="store_true", help="print a line for right answers as well")
    parser.add_argument("--bag", type=Path, metavar="DIR", help="only write the bag of the first case")
    arguments = parser.parse_args(argv)
    if arguments.count < 1 or arguments.seed < 0:
        raise InputError("--seed is 0 or more, --count 1 or more")
    if arguments.bag is not None:
        write(draw(arguments.seed), arguments.bag)
        return 0
    totals: dict[str, Counter[str]] = defaultdict(Counter)
    everything: Counter[str] = Counter()
    for seed in range(arguments.seed, arguments.seed + arguments.count):
        case = draw(seed)
        with tempfile.TemporaryDirectory() as folder:
            answer = judge(case, Path(folder))
        outcomes = [answer.outcome, *["contradict"] * answer.contradicts]
        everything.update(outcomes)
        for name, what in {**case.conventions(), "wrong": ", ".join(case.faults()) or "nothing"}.items():
            totals[f"{name}: {what}"].update(outcomes)
        if arguments.show or answer.outcome in OUTCOMES[1:3] or answer.contradicts:
            print(line_of(case, answer), flush=True)
    for name, counts in [*sorted(totals.items()), ("all", everything)]:
        each = ", ".join(f"{counts[outcome]} {outcome}" for outcome in (*OUTCOMES, "contradict") if counts[outcome])
        print(f"{name:56}  {each}")
    return 1 if everything["USABLE AND WRONG"] or everything["contradict"] else 0
