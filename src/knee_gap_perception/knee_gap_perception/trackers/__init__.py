"""Sources of tracked rigid bodies: topics, NatNet from Motive, and exported takes."""
