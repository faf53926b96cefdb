"""Maximum likelihood over all views of a track, and its confidence interval."""
