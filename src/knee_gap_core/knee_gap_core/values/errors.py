"""The base of all errors of the suite, and why a measurement is refused.

Each message is one line with the rule and the value that broke it.
"""


class KneeGapError(ValueError):
    """What the suite raises on purpose: an input, a setting or a file that cannot be used."""


class MeasurementError(KneeGapError):
    """These views do not allow a number."""


class BadInputError(MeasurementError):
    """An impossible value: not finite, not a unit vector, negative, of the wrong shape, not a choice."""


class BaselineTooShortError(MeasurementError):
    """The lens positions are closer than their errors: even the direction of travel is unknown."""


class EpipoleError(MeasurementError):
    """A bearing lies along the baseline, within the admitted error: it spans no triangle with it."""


class CheiralityError(MeasurementError):
    """The two rays to a point do not meet in front of both lenses."""


class UnderconstrainedError(MeasurementError):
    """The two rays to a point are parallel: it is at infinity, and the gap is unknown."""
