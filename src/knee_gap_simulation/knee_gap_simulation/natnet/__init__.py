"""NatNet server of simulated rigid bodies."""
