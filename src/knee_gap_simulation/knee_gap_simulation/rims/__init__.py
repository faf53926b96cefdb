"""Two surfaces with sharp rims: the simple scene."""
