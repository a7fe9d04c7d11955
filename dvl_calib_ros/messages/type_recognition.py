"""Types recognised by their fields, whatever their package is called.

Forks and ports of a driver send its messages under packages of their own: waterlinked_a50_ros_driver and dvl_a50_msgs
are dvl_msgs in all but the name, stonefish_msgs and dave_interfaces are as uuv_sensor_ros_plugins_msgs.

Recordings opened with all that is known of message types.
"""

from __future__ import annotations

from collections.abc import Collection

from .drivers import VELOCITY_TYPES, VelocityType, add_type

# fields that tell a DVL's message, the most telling first -> the type that is read alike
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
    """The type of this name: as it is known, else by its fields; None if they are not a DVL's.

    One that is recognised is known from then on by its name as well.
    """
    known = VELOCITY_TYPES.get(name)
    if known is not None:
        return known
    like = next((like for needed, like in _ALIKE if needed <= set(fields)), None)
    return None if like is None else add_type(name, like)
