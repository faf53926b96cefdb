"""The command `tracker_precision`: precision of a tracker from a recording of a body."""
