"""Precision of a tracker, from a recording of a body."""
