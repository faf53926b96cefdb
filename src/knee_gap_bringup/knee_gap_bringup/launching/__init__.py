"""What a launch starts, in which order, and how it ends."""
