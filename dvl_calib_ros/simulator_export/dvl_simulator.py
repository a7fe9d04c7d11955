"""Export to DVL-Simulator (RWTH Aachen): parameters of its ROS 2 node, YAML.

In three places its sources use a setting differently from its name. `rotation_body_to_sensor_frame` is applied in the
order z, y, x: yaw comes first. `lever_arm_body_to_sensor_frame` is in the sensor's axes. Scale and biases are drawn
uniformly from ± an interval; with a constant seed the draws are known (C++ defines mt19937; libstdc++ makes a double of
two words), and the interval is chosen to give the wanted value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import yaml

from ..calibration.numerics.frames import rotation_from_rpy
from .dvl_description import DvlDescription
from .writer import Settings, Simulator, beams_of, comment, mixed_scale, split

TITLE = "DVL-Simulator"
# first seed whose draws are all far from zero, because a small draw would need a large interval
SEED = 1
BEAM_ANGLE_DEG = 22.5
DEFAULTS: dict[str, Any] = {
    "sample_time": 0.2,
    "seed": 42,
    "use_constant_seed": False,
    "beam_velocity_noise_std": 0.01,
    "scale_factor_noise_std": 0.0,
    "beam_bias_noise_std": 5.0e-04,
    "gyroscope_noise_std": [0.000207479860047933, 0.000243411420514079, 0.000187943045943727],
    "interval_initial_scale_factor": 0.1,
    "interval_initial_beam_bias": [0.0, 0.0, 0.0, 0.0],
    "beam_bias_correlation_time": 1800.0,
    "resolution": 1.0e-04,
    "beam_angle": BEAM_ANGLE_DEG,
    "min_altitude": 0.05,
    "max_altitude": 50.0,
    "distance_to_ground": -5.0,
    "max_velocity": 3.75,
}
ENABLED = ("beam_velocity_noise", "scale_factor", "beam_bias", "gyroscope_noise", "quantization", "altitude_limit",
           "velocity_limit")  # fmt: skip
GENERAL = ("sample_time", "seed", "use_constant_seed")
# correlation time of a bias that must stay constant: 30 years
FOR_EVER_S = 1.0e9


def write(description: DvlDescription) -> Settings:
    """Return the settings of a DVL with scale and beam biases, which the simulator draws by its seed."""
    beams = beams_of(description.noise_std, math.radians(BEAM_ANGLE_DEG))
    scale = mixed_scale(description)
    drawn = draws(SEED)
    roll, pitch, yaw = (math.degrees(angle) for angle in description.mounting_rpy)
    body_from_dvl = rotation_from_rpy(description.mounting_rpy)
    configured: dict[str, Any] = {
        "sample_time": None if description.rate_hz is None else 1.0 / description.rate_hz,
        "seed": SEED,
        "use_constant_seed": True,
        "beam_velocity_noise_std": beams.std if beams else None,
        "beam_angle": math.degrees(beams.angle) if beams and beams.is_found else None,
        "interval_initial_scale_factor": float(100.0 * scale / drawn[0]),
        "lever_arm_body_to_sensor_frame": (body_from_dvl.T @ np.array(description.lever_arm)).tolist(),
        "rotation_body_to_sensor_frame": [yaw, pitch, roll],
    }
    if any(description.velocity_bias):
        angle = beams.angle if beams else math.radians(BEAM_ANGLE_DEG)
        bias = directions(angle) @ np.array(description.velocity_bias) / drawn[1:]
        configured |= {
            "interval_initial_beam_bias": bias.tolist(),
            "beam_bias_noise_std": 0.0,
            "beam_bias_correlation_time": FOR_EVER_S,
        }
    values, from_vehicle, assumed = split(configured, DEFAULTS)
    assumed["model_enable_settings"] = "all true"
    document = {
        "dvl_simulator": {
            "general_settings": {name: values[name] for name in GENERAL},
            "model_parameter_settings": {name: value for name, value in values.items() if name not in GENERAL},
            "model_enable_settings": {f"enable_{name}": True for name in ENABLED},
        }
    }
    above = "".join(f"# {line}\n" for line in comment(TITLE, description, from_vehicle, assumed).splitlines())
    return Settings(
        above + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120),
        from_vehicle,
        assumed,
        beams.axis_std if beams else None,
        scale,
        (
            f"the intervals of scale and biases are made for the constant seed {SEED}: leave it; every run then has "
            "the same noise, and another C++ library than libstdc++ may draw others",
            "rotation_body_to_sensor_frame has yaw, pitch, roll, and the lever arm is in the sensor's axes, as the "
            "simulator's sources use them",
        ),
        frozenset({"scale", "velocity_bias"}),
    )


def draws(seed: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the first five uniform draws (5,) in -1 .. 1 for a seed, as shares of ± an interval; scale, then beams."""
    words = np.random.RandomState(seed).randint(0, 1 << 32, size=10, dtype=np.uint32).astype(float)
    return 2.0 * (words[::2] + words[1::2] * 2.0**32) / 2.0**64 - 1.0


def directions(angle: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return beam directions (4, 3); velocity along each = directions @ velocity."""
    azimuth = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    across = math.sin(angle)
    return np.column_stack([np.cos(azimuth) * across, np.sin(azimuth) * across, np.full(4, math.cos(angle))])


SIMULATOR = Simulator(
    TITLE, write, "use it as the node's parameter file; its odometry must be of the reference point, forward-left-up"
)
