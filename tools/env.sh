# Source this (bash) for the environment of the built workspace, over installed ROS 2 Jazzy or over its wheels.
# shellcheck shell=bash

_knee_gap_checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
_knee_gap_root=${KNEE_GAP_ROOT:-$_knee_gap_checkout}

export PATH="$_knee_gap_root/.venv/bin:$PATH"
if [ -f /opt/ros/jazzy/setup.bash ]; then
  . /opt/ros/jazzy/setup.bash
  # The wrappers colcon writes and rclpy look for libraries beside the system's Python; ours stand in the venv.
  _knee_gap_site=$("$_knee_gap_root/.venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
  export PYTHONPATH="$_knee_gap_site${PYTHONPATH:+:$PYTHONPATH}"
else
  export AMENT_PREFIX_PATH="$_knee_gap_root/.venv" CMAKE_PREFIX_PATH="$_knee_gap_root/.venv"
  export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
  _knee_gap_libraries=$_knee_gap_root/.venv/lib
  for _knee_gap_site in "$_knee_gap_root"/.venv/lib/python3.*/site-packages/ros_*.libs; do
    [ -d "$_knee_gap_site" ] && _knee_gap_libraries=$_knee_gap_libraries:$_knee_gap_site
  done
  export LD_LIBRARY_PATH="$_knee_gap_libraries${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
  # Otherwise every start of Python executes itself again to set the line above.
  export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
fi
if [ -z "${KNEE_GAP_UNDERLAY_ONLY:-}" ]; then
  . "$_knee_gap_root/install/local_setup.bash"
fi

# 1280x720 images at 60 Hz need a shared-memory segment that holds them, and an allocator that keeps its pages.
export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$_knee_gap_checkout/src/knee_gap_bringup/config/fastdds.xml}"
export MALLOC_MMAP_THRESHOLD_=268435456 MALLOC_TRIM_THRESHOLD_=1073741824 MALLOC_TOP_PAD_=67108864
# The matrices here are small: threads of the linear algebra would spin for a second core and win nothing.
export OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
# This machine only, unless the user says otherwise (SUBNET for a controller on another machine).
export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
unset _knee_gap_checkout _knee_gap_root _knee_gap_libraries _knee_gap_site
