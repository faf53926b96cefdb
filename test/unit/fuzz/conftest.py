"""The drawn joint, as in the tests of perception."""

from drawn_joint import joint

__all__ = ["joint"]
