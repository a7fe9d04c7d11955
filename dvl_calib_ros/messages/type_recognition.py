"""Recognition of message types by their fields, for any package name.

Forks and ports of a driver send its messages under their own package names: waterlinked_a50_ros_driver and dvl_a50_msgs
equal dvl_msgs, stonefish_msgs and dave_interfaces equal uuv_sensor_ros_plugins_msgs.
"""

from __future__ import annotations

from collections.abc import Collection

from .drivers import VELOCITY_TYPES, VelocityType, add_type

# characteristic fields of a DVL's message, the most specific first -> the known type with the same layout
_ALIKE: tuple[tuple[frozenset[str], str], ...] = (
    (
        frozenset({"header", "velocity", "velocity_valid", "fom", "altitude", "beams"}),
        "dvl_msgs/msg/DVL",
    ),
    (
        frozenset({"header", "velocity", "coordinate_mode", "velocity_mode", "velocity_covar", "num_good_beams"}),
        "ds_sensor_msgs/msg/Dvl",
    ),
    (
        frozenset(
            {"header", "velocity", "velocity_mode", "velocity_covar", "num_good_beams", "beam_velocities_valid",
             "altitude", "beam_ranges_valid", "range"}
        ),
        "marine_acoustic_msgs/msg/Dvl",
    ),
    (
        frozenset({"header", "velocity", "velocity_covariance", "altitude"}),
        "uuv_sensor_ros_plugins_msgs/msg/DVL",
    ),
)  # fmt: skip


def recognised(name: str, fields: Collection[str]) -> VelocityType | None:
    """Return the type of this name if known, else by its fields; None if they are not a DVL's.

    A recognised type is then also known by its name.
    """
    known = VELOCITY_TYPES.get(name)
    if known is not None:
        return known
    like = next((like for needed, like in _ALIKE if needed <= set(fields)), None)
    return None if like is None else add_type(name, like)
