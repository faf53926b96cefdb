"""Coverage of the published intervals: a study on simulated tracks, run by one command."""
