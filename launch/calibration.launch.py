"""Launch the calibration node.

ros2 launch dvl_calib_ros calibration.launch.py params_file:=my_vehicle.yaml dvl_topic:=/dvl/velocity_report
ros2 launch dvl_calib_ros calibration.launch.py --show-args
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dvl_calib_ros.files.parameter_files import load_parameters

TOPICS = {"dvl_topic": "dvl/twist", "gnss_topic": "gnss/twist", "imu_topic": "imu/data"}
# Saves and ends in well under a second; a node that cannot start at all need not be tried more often.
RESPAWN_DELAY_S = 2.0


def generate_launch_description() -> LaunchDescription:
    """The node with its parameter file."""
    default_file = Path(get_package_share_directory("dvl_calib_ros")) / "config" / "calibration.yaml"
    arguments = [
        DeclareLaunchArgument("params_file", default_value=str(default_file), description="ROS 2 parameter file"),
        DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=f"remaps {topic}")
            for argument, topic in TOPICS.items()
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="",
            choices=["", "true", "false"],
            description="follow /clock; empty: as the parameter file or SetParameter says",
        ),
        DeclareLaunchArgument(
            "respawn", default_value="false", choices=["true", "false"], description="start it again when it has died"
        ),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_node)])


def _node(context: LaunchContext) -> list[Node]:
    def said(argument: str) -> str:
        return LaunchConfiguration(argument).perform(context)

    load_parameters(Path(said("params_file")))  # if it is missing, ROS 2 would only warn, and run on the defaults
    parameters: list = [said("params_file")]
    if said("use_sim_time"):
        parameters.append({"use_sim_time": said("use_sim_time") == "true"})
    # a topic that is left as it is gets no rule: one around the launch file (SetRemap) shall hold
    remappings = [(topic, said(argument)) for argument, topic in TOPICS.items() if said(argument) != topic]
    return [
        Node(
            package="dvl_calib_ros",
            executable="calibration_node",
            namespace=said("namespace"),
            output="screen",
            emulate_tty=True,
            parameters=parameters,
            remappings=remappings,
            respawn=said("respawn") == "true",
            respawn_delay=RESPAWN_DELAY_S,
            arguments=["--ros-args", "--log-level", said("log_level")],
        )
    ]
