"""A bag through the three nodes: `ros2 launch knee_gap_bringup replay.launch.py bag:=bags/sample`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

SHARE = Path(get_package_share_directory("knee_gap_bringup"))
INPUTS = ("image_raw/compressed", "camera_info", "scope_body/pose")
OUTPUTS = (
    "gap_edges",
    "scope_pose",
    "scope_turn",
    "scope_notch",
    "scope_calibration",
    "gap",
    "gap/min",
    "gap/max",
    "gap/snr",
    "motion_advice",
)
# Time for the last image to pass through the nodes [s].
DRAIN = 1.0


def start(context: object) -> list[object]:
    """Nodes, player and recorder; everything ends when the bag does."""
    namespace = "/" + LaunchConfiguration("namespace").perform(context)
    bag = LaunchConfiguration("bag").perform(context)
    out = LaunchConfiguration("out").perform(context)
    given = LaunchConfiguration("params").perform(context)
    # A simulated bag carries the place of the lens on the tracked body, and its medium, beside it.
    beside = Path(bag) / "scope.yaml"
    parameters = [str(beside)] if not given and beside.is_file() else [given] if given else []
    player = Node(
        package="knee_gap_replay",
        executable="play",
        arguments=[
            bag,
            "--rate",
            LaunchConfiguration("rate"),
            "--topics",
            *(f"{namespace}/{topic}" for topic in INPUTS),
            "--wait-for",
            *(f"{namespace}/{topic}" for topic in INPUTS),
            "--delay",
            "1",
        ],
        output="screen",
    )
    nodes = [
        Node(
            package="knee_gap_perception",
            executable="segmentation_node",
            namespace=namespace,
            parameters=[*parameters, {"image_transport": "compressed"}],
        ),
        Node(
            package="knee_gap_perception",
            executable="tracking_node",
            namespace=namespace,
            parameters=parameters,
        ),
        Node(package="knee_gap_uncertainty", executable="uncertainty_node", namespace=namespace),
    ]
    if out:
        topics = [f"{namespace}/{topic}" for topic in OUTPUTS]
        nodes.append(
            Node(package="knee_gap_replay", executable="record", arguments=[out, *topics], output="screen")
        )
    end = TimerAction(period=DRAIN, actions=[EmitEvent(event=Shutdown(reason="the bag has ended"))])
    return [*nodes, player, RegisterEventHandler(OnProcessExit(target_action=player, on_exit=[end]))]


def generate_launch_description() -> LaunchDescription:
    """Arguments and what they start."""
    transport = PythonLaunchDescriptionSource(str(SHARE / "launch" / "transport.launch.py"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="bag folder or .mcap file"),
            DeclareLaunchArgument("out", default_value="", description="bag to record the results in"),
            DeclareLaunchArgument("rate", default_value="1.0"),
            DeclareLaunchArgument(
                "params", default_value="", description="parameters of the nodes; scope.yaml of the bag"
            ),
            DeclareLaunchArgument("namespace", default_value="knee_gap"),
            IncludeLaunchDescription(transport),
            OpaqueFunction(function=start),
        ]
    )
