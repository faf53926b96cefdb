"""Writing of bags."""
