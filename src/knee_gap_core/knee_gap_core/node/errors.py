"""What can be wrong with how a node was started."""

from knee_gap_core.values.errors import KneeGapError


class ConfigurationError(KneeGapError):
    """A node cannot run as it was told to; the message says which rule, value and choices."""
