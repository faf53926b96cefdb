"""Errors of bags."""

from knee_gap_core.values.errors import KneeGapError


class BagError(KneeGapError):
    """A bag, topic, type or command that cannot be used; the message is one line and gives the reason."""


class DiskFullError(BagError):
    """The disk is full; what could not be written waits in memory."""
