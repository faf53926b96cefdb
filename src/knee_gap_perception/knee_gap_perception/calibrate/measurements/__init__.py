"""Measurements taken from a recording: boards, image motion, poses."""
