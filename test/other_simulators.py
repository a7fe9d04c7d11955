"""Other simulators' DVLs, as their settings say: read from an exported file, and driven through a motion.

Written from the projects' own files, and without anything of `dvl_calib_ros.export`: it is what that is tested with.
"""

from __future__ import annotations

import json
import math
import random
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from yaml_text import parsed

from dvl_calib_ros.bags.writer import BagWriter
from dvl_calib_ros.calibration.numerics.samples import DvlSample, ImuSample, ReferenceSample, VelocityFrame
from dvl_calib_ros.messages.encode import SampleWriter
from dvl_calib_ros.simulation.trajectories import Motion, Waves, add_waves, make_motion

GZ = "{http://gazebosim.org/schema}"
FLIP = np.diag([1.0, -1.0, -1.0])  # forward-right-down <-> forward-left-up


@dataclass
class OtherDvl:
    """A DVL of another simulator. rotation: (3, 3) body from sensor, lever_arm: (3,) m, both forward-left-up. measure:
    true velocities (N, 3) m/s in the sensor's frame -> what it says. std: (3,) m/s of its axes.
    """

    rotation: np.ndarray
    lever_arm: np.ndarray
    rate: float
    measure: Callable[[np.ndarray, np.random.Generator], np.ndarray]
    std: np.ndarray


def floats(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def fixed_axes(rpy) -> np.ndarray:
    return Rotation.from_euler("xyz", rpy).as_matrix()


def through_beams(azimuths_deg, from_vertical_deg: float, std: float, scale: float = 0.0, bias=0.0):
    """Noise on each beam, then least squares."""
    azimuth, tilt = np.deg2rad(azimuths_deg), math.radians(from_vertical_deg)
    beams = np.column_stack(
        [np.cos(azimuth) * math.sin(tilt), np.sin(azimuth) * math.sin(tilt), np.full(4, -math.cos(tilt))]
    )
    solve = np.linalg.pinv(beams)

    def measure(velocity, rng):
        along = velocity @ beams.T * (1.0 + scale) + bias
        return (along + rng.normal(0.0, std, along.shape)) @ solve.T

    return measure, std * np.sqrt(np.diag(solve @ solve.T))


def on_axes(std: float, per_velocity: float = 0.0):
    """Noise on each axis; per_velocity: it grows with the signed velocity, so it shrinks going astern."""

    def measure(velocity, rng):
        return velocity + np.maximum(std + per_velocity * velocity, 0.0) * rng.standard_normal(velocity.shape)

    return measure, np.full(3, std)


def gazebo(path: Path) -> OtherDvl:
    sensor = ElementTree.parse(path).getroot().find("model/link/sensor")
    assert sensor.get("type") == "custom" and sensor.get(f"{GZ}type") == "dvl"
    dvl = sensor.find(f"{GZ}dvl")
    assert dvl.findtext("type") in ("piston", "phased_array")
    assert dvl.find("arrangement").get("degrees") == "true"
    beams = dvl.findall("arrangement/beam")
    assert len(beams) >= 3 and {abs(float(beam.findtext("tilt"))) < 90.0 for beam in beams} == {True}
    bottom = dvl.find("tracking/bottom_mode")
    assert bottom.findtext("when") in ("best", "always") and bottom.find("noise").get("type") == "gaussian"
    assert floats(dvl.findtext("reference_frame")).tolist() == [0.0] * 6
    assert 0.0 < float(dvl.findtext("minimum_range")) < float(dvl.findtext("maximum_range"))
    pose = floats(sensor.findtext("pose"))
    azimuths = [float(beam.findtext("rotation")) for beam in beams]
    std = float(bottom.findtext("noise/stddev"))
    return OtherDvl(
        fixed_axes(pose[3:]), pose[:3], float(sensor.findtext("update_rate")),
        *through_beams(azimuths, float(beams[0].findtext("tilt")), std),
    )  # fmt: skip


def stonefish(path: Path) -> OtherDvl:
    sensor = ElementTree.parse(path).getroot()
    assert (sensor.tag, sensor.get("type")) == ("sensor", "dvl") and sensor.find("link").get("name")
    assert float(sensor.find("specs").get("beam_angle")) > 0.0
    noise, origin = sensor.find("noise"), sensor.find("origin")
    measure, std = on_axes(float(noise.get("velocity")), 0.01 * float(noise.get("velocity_percent")))
    rotation = FLIP @ fixed_axes(floats(origin.get("rpy")))  # bodies are forward-right-down
    return OtherDvl(rotation, FLIP @ floats(origin.get("xyz")), float(sensor.get("rate")), measure, std)


def holoocean(path: Path) -> OtherDvl:
    sensor = json.loads(path.read_text())
    assert sensor["sensor_type"] == "DVLSensor"
    configuration = sensor["configuration"]
    assert set(configuration) <= {
        "Elevation", "DebugLines", "VelSigma", "VelCov", "ReturnRange", "MaxRange", "RangeSigma", "RangeCov"
    }  # fmt: skip
    rotation = fixed_axes(np.deg2rad(sensor["rotation"]))
    measure, std = through_beams([0, 90, 180, 270], configuration["Elevation"], configuration["VelSigma"])
    return OtherDvl(rotation, np.array(sensor["location"]), sensor["Hz"], measure, std)


def dvl_simulator(path: Path) -> OtherDvl:
    """With its generator and its ways: rotations in the order z, y, x, the lever arm in the sensor's axes."""
    document = parsed(path.read_text())["dvl_simulator"]
    general, model = document["general_settings"], document["model_parameter_settings"]
    assert all(document["model_enable_settings"].values()) and len(document["model_enable_settings"]) == 7
    assert general["use_constant_seed"], "scale is drawn by chance"
    uniform = mt19937_doubles(general["seed"], 5)
    scale = 0.01 * model["interval_initial_scale_factor"] * (2.0 * uniform[0] - 1.0)
    bias = np.array(model["interval_initial_beam_bias"]) * (2.0 * uniform[1:] - 1.0)
    rotation = Rotation.from_euler("ZYX", model["rotation_body_to_sensor_frame"], degrees=True).as_matrix()
    lever_arm = rotation @ np.array(model["lever_arm_body_to_sensor_frame"])
    # its beams point up; so would a bias
    azimuth, tilt = np.deg2rad([45.0, 135.0, 225.0, 315.0]), math.radians(model["beam_angle"])
    beams = np.column_stack(
        [np.cos(azimuth) * math.sin(tilt), np.sin(azimuth) * math.sin(tilt), np.full(4, math.cos(tilt))]
    )
    solve, std, step = np.linalg.pinv(beams), model["beam_velocity_noise_std"], model["resolution"]

    def measure(velocity, rng):
        along = velocity @ beams.T * (1.0 + scale) + bias
        return np.round((along + rng.normal(0.0, std, along.shape)) @ solve.T / step) * step

    return OtherDvl(rotation, lever_arm, 1.0 / general["sample_time"], measure, std * np.sqrt(np.diag(solve @ solve.T)))


def mt19937_doubles(seed: int, n: int) -> np.ndarray:
    """What std::uniform_real_distribution draws from std::mt19937 in libstdc++: two words a double, the low one first.

    Python's own generator is the same one; its state is set as C++ sets it from one number.
    """
    state = [seed & 0xFFFFFFFF]
    for i in range(1, 624):
        state.append((1812433253 * (state[-1] ^ (state[-1] >> 30)) + i) & 0xFFFFFFFF)
    generator = random.Random()
    generator.setstate((3, (*state, 624), None))
    words = [generator.getrandbits(32) for _ in range(2 * n)]
    return np.array([(low + high * 2**32) / 2**64 for low, high in zip(words[::2], words[1::2], strict=True)])


READERS = {"gazebo": gazebo, "stonefish": stonefish, "holoocean": holoocean, "dvl-simulator": dvl_simulator}


def write_log(path: Path, dvl: OtherDvl, seconds: float, seed: int, reference_std: float = 0.02) -> None:
    """A log of that simulator, in which a vehicle drives about: DVL, its true velocity but for some noise, IMU."""
    driven(seconds, seed, reference_std).write(path, dvl)


def driven(seconds: float, seed: int, reference_std: float) -> BagLog:
    """A vehicle that drives about in waves, by chance."""
    rng = np.random.default_rng(seed)
    return BagLog(add_waves(make_motion("free", seconds, 100.0, rng), Waves(0.3, 5.0), rng), rng, reference_std)


@dataclass
class BagLog:
    motion: Motion
    rng: np.random.Generator
    reference_std: float
    start_ns: int = 1_765_000_000_000_000_000

    def write(self, path: Path, dvl: OtherDvl) -> None:
        with BagWriter(path) as bag:
            SampleWriter(bag).recording(*self.samples(dvl))

    def samples(
        self, dvl: OtherDvl, frame: VelocityFrame = VelocityFrame.ENU
    ) -> tuple[list[ImuSample], list[ReferenceSample], list[DvlSample]]:
        time = self.motion.time
        moved = self.motion.velocity_body + np.cross(self.motion.angular_velocity, dvl.lever_arm)
        at = np.arange(0.0, time[-1], 1.0 / dvl.rate)
        said = dvl.measure(self._at(at, moved) @ dvl.rotation, self.rng)
        claimed = np.diag(dvl.std**2)
        samples = [DvlSample(self._stamp(t), tuple(row), claimed) for t, row in zip(at, said.tolist(), strict=True)]
        at = np.arange(0.05, time[-1], 0.2)
        velocity = self.motion.velocity_body
        if frame is VelocityFrame.ENU:
            velocity = np.einsum("nij,nj->ni", self.motion.rotation_enu_from_body, velocity)
        velocity = self._at(at, velocity)
        velocity = velocity + self.rng.normal(0.0, self.reference_std, velocity.shape)
        truth = np.eye(3) * self.reference_std**2
        reference = [
            ReferenceSample(self._stamp(t), tuple(row), truth, frame)
            for t, row in zip(at, velocity.tolist(), strict=True)
        ]
        every = slice(None, None, 5)
        attitude = Rotation.from_matrix(self.motion.rotation_enu_from_body[every]).as_quat().tolist()
        rates = self.motion.angular_velocity[every].tolist()
        imu = [
            ImuSample(self._stamp(t), tuple(q), tuple(w)) for t, q, w in zip(time[every], attitude, rates, strict=True)
        ]
        return imu, reference, samples

    def _stamp(self, t: float) -> int:
        return self.start_ns + round(1e9 * float(t))

    def _at(self, at: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(at, self.motion.time, column) for column in values.T])
