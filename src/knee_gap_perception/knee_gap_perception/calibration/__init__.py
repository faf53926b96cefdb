"""Calibration of a tracked scope, as used at run time: camera, lens on the body, rotation, tip, clock."""
