"""Nodes and commands: base node, parameters and their rules, command lines, start and stop."""
