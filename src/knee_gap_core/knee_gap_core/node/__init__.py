"""Nodes and commands without ROS: wiring of cores, parameters and their rules, command lines."""
