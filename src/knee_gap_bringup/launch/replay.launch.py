"""A bag played to the three nodes: `ros2 launch knee_gap_bringup replay.launch.py bag:=bags/sample`.

It ends with the bag. The exit code is not 0 if there is not a bag, if `out` exists, or if a process fails.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from knee_gap_bringup.launching.actions import actions, refuse
from knee_gap_bringup.launching.plan import replay_plan, replay_problem

SHARE = Path(get_package_share_directory("knee_gap_bringup"))


def start(context: object) -> list[object]:
    """Nodes, player and recorder."""
    bag, out, rate, params, namespace = (
        LaunchConfiguration(name).perform(context) for name in ("bag", "out", "rate", "params", "namespace")
    )
    refuse(replay_problem(bag, out, rate=rate, params=params))
    return actions(replay_plan(bag, out, rate=rate, params=params, namespace=namespace))


def generate_launch_description() -> LaunchDescription:
    """Arguments and what they start."""
    transport = PythonLaunchDescriptionSource(str(SHARE / "launch" / "transport.launch.py"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="bag folder or .mcap file"),
            DeclareLaunchArgument("out", default_value="", description="bag to record the results to"),
            DeclareLaunchArgument("rate", default_value="1.0", description="times real time"),
            DeclareLaunchArgument(
                "params",
                default_value="",
                description="parameter file of the nodes; calibration.yaml of the bag, else its scope.yaml",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="knee_gap", description="namespace of the nodes and of the bag"
            ),
            IncludeLaunchDescription(transport),
            OpaqueFunction(function=start),
        ]
    )
