"""Errors of the scope's calibration in the estimate."""
