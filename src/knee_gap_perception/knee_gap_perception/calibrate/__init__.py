"""The command `calibrate`: from a recording to a calibration file."""
