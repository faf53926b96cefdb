"""Pose of the lens from tracked bodies: validity, label swaps, reference body."""
