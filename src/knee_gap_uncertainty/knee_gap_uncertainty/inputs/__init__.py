"""Inputs of the estimator beside edges: lens poses, scope rotations, the leg body."""
