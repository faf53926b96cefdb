"""The three nodes on live topics: `ros2 launch knee_gap_bringup live.launch.py params:=my_scope.yaml`.

The file has all parameters that a laboratory has to set, including image_transport; config/knee_gap.yaml is a
template. A node that ends is restarted (respawn:=false to turn this off). A node that refuses its parameters
ends the launch with its exit code.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from knee_gap_bringup.launching.actions import actions, refuse
from knee_gap_bringup.launching.plan import RESPAWN_DELAY, live_plan, live_problem

SHARE = Path(get_package_share_directory("knee_gap_bringup"))
CONFIG = SHARE / "config"
TRANSPORT = SHARE / "launch" / "transport.launch.py"


def start(context: object) -> list[object]:
    """Three nodes in one namespace, with one parameter file."""
    params, namespace, respawn, delay = (
        LaunchConfiguration(name).perform(context)
        for name in ("params", "namespace", "respawn", "respawn_delay")
    )
    refuse(live_problem(params, delay))
    return actions(live_plan(params, namespace, respawn=respawn == "true"), float(delay))


def generate_launch_description() -> LaunchDescription:
    """Arguments and what they start."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=str(CONFIG / "knee_gap.yaml")),
            DeclareLaunchArgument("namespace", default_value="knee_gap"),
            DeclareLaunchArgument(
                "respawn",
                default_value="true",
                choices=["true", "false"],
                description="restart a node that ended",
            ),
            DeclareLaunchArgument(
                "respawn_delay", default_value=str(RESPAWN_DELAY), description="pause before a restart [s]"
            ),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(TRANSPORT))),
            OpaqueFunction(function=start),
        ]
    )
