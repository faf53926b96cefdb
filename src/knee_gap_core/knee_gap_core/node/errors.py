"""What can be wrong with how a node was started."""


class ConfigurationError(ValueError):
    """A node cannot run as it was told to; the message says which rule, value and choices."""
