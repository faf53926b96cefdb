"""The width of the instrument gap, with its bounds."""
