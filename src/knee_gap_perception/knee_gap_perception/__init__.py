"""Perception: the edges of the instrument gap in images, and the tracked pose of the lens."""
