"""Calibration of a tracked scope: lens, body-to-lens, tip, turn of the oblique scope, clock of the video."""
