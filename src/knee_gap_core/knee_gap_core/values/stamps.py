"""Stamps as whole nanoseconds, and std_msgs/Header from and to them."""

from typing import Any

NANOSECONDS = 1_000_000_000


def stamp_ns(header: Any) -> int:
    """Stamp [ns] of a std_msgs/Header; nanoseconds of a second or more are taken as just below one."""
    return int(header.stamp.sec) * NANOSECONDS + min(int(header.stamp.nanosec), NANOSECONDS - 1)


def set_stamp(header: Any, stamp: int) -> None:
    """Set the stamp of a std_msgs/Header, or of anything with its fields, to nanoseconds."""
    header.stamp.sec, header.stamp.nanosec = divmod(stamp, NANOSECONDS)
