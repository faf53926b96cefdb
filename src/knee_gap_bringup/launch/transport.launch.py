"""Environment in which raw 1280x720 images at 60 Hz are not lost; included by the other launch files."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import SetEnvironmentVariable

CONFIG = Path(get_package_share_directory("knee_gap_bringup")) / "config"
# A shared-memory segment that holds the images, and an allocator that keeps its pages.
TRANSPORT = {
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(CONFIG / "fastdds.xml"),
    "MALLOC_MMAP_THRESHOLD_": "268435456",
    "MALLOC_TRIM_THRESHOLD_": "1073741824",
    "MALLOC_TOP_PAD_": "67108864",
}


def generate_launch_description() -> LaunchDescription:
    """Set the variables."""
    return LaunchDescription([SetEnvironmentVariable(name, value) for name, value in TRANSPORT.items()])
