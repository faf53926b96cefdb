"""Detection of the instrument gap in one image, and its confidence."""
