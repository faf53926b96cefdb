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
    params, namespace, respawn, delay, one_process = (
        LaunchConfiguration(name).perform(context)
        for name in ("params", "namespace", "respawn", "respawn_delay", "one_process")
    )
    refuse(live_problem(params, delay))
    plan = live_plan(params, namespace, respawn=respawn == "true", one_process=one_process == "true")
    return actions(plan, float(delay))


def generate_launch_description() -> LaunchDescription:
    """Arguments and what they start."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params",
                default_value=str(CONFIG / "knee_gap.yaml"),
                description="parameter file of the nodes",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="knee_gap", description="namespace of the nodes"
            ),
            DeclareLaunchArgument(
                "respawn",
                default_value="true",
                choices=["true", "false"],
                description="restart a node that ended",
            ),
            DeclareLaunchArgument(
                "respawn_delay", default_value=str(RESPAWN_DELAY), description="pause before a restart [s]"
            ),
            DeclareLaunchArgument(
                "one_process",
                default_value="false",
                choices=["true", "false"],
                description="the three nodes in one process, suite_node",
            ),
            IncludeLaunchDescription(PythonLaunchDescriptionSource(str(TRANSPORT))),
            OpaqueFunction(function=start),
        ]
    )
