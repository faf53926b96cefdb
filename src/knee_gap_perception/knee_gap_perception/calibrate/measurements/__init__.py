"""Measurements from a recording: boards, image motion, poses."""
