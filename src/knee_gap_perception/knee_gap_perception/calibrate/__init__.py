"""The command `calibrate`: a calibration file from a recording."""
