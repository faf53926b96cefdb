"""Estimators of the calibration: intrinsics, hand-eye, pivot, clock."""
