"""A NatNet server of simulated bodies."""
