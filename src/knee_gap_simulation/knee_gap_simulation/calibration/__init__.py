"""Simulated calibration recordings."""
