"""How often the published intervals hold the truth: a study on simulated tracks, run by one command."""
