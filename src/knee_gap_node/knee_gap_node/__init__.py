"""What every node shares: parameters from a dataclass, QoS by purpose, diagnostics, start and stop."""
