"""The three nodes on live topics: `ros2 launch knee_gap_bringup live.launch.py params:=my_scope.yaml`.

The file says all that a laboratory has to set, whether images come compressed included; config/knee_gap.yaml
is one to begin with.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory("knee_gap_bringup"))
CONFIG = SHARE / "config"
TRANSPORT = SHARE / "launch" / "transport.launch.py"
NODES = {
    "segmentation_node": "knee_gap_perception",
    "tracking_node": "knee_gap_perception",
    "uncertainty_node": "knee_gap_uncertainty",
}


def generate_launch_description() -> LaunchDescription:
    """Three nodes in one namespace, with one parameter file."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=str(CONFIG / "knee_gap.yaml")),
            DeclareLaunchArgument("namespace", default_value="knee_gap"),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(TRANSPORT))),
            *(
                Node(
                    package=package,
                    executable=name,
                    name=name,
                    namespace=LaunchConfiguration("namespace"),
                    parameters=[LaunchConfiguration("params")],
                    output="screen",
                )
                for name, package in NODES.items()
            ),
        ]
    )
