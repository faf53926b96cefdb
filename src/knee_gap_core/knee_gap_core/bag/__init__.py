"""Bags of ROS 2, read and written without ROS: the one reader and the one writer of every command."""
