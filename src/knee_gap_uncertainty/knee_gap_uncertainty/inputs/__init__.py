"""What the estimator receives beside edges: lens poses, scope rotations, the leg body."""
