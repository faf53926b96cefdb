"""Rejection of an estimate: a reason to count by, and the detail of the case."""

from enum import StrEnum
from typing import NamedTuple


class Rejection(NamedTuple):
    """A reason in constant words, which is counted, and the detail of this case, which may be empty."""

    reason: StrEnum
    detail: str = ""

    def __str__(self) -> str:
        """The detail, or the reason if there is none."""
        return self.detail or self.reason.value
