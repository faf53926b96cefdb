"""Rotation of an oblique scope in its camera head: notch, shaft axis, rotated poses."""
