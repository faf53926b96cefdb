"""A knee whose gap is known, the scope that looks at it and the tracker that follows the scope."""
