"""Detection of the instrument gap in one image, and the confidence in it."""
