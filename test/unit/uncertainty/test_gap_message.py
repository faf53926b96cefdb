"""The answer as a message: nothing of an estimate is left out, and nothing of the message is made up."""

from dataclasses import fields

import numpy as np

from knee_gap_core.bag.message_types import blank
from knee_gap_core.values.gap_estimate import GapEstimate, GapStatus
from knee_gap_core.values.rejection import Rejection
from knee_gap_uncertainty.estimation.acceptance import Reason
from knee_gap_uncertainty.estimation.messages import SHARES, fill_gap_estimate

NUMBERS = [field.name for field in fields(GapEstimate) if field.type is float]


def numbers_of(message: object) -> dict[str, float]:
    """Plain numbers of a message by their names, the shares of the variance apart."""
    return {
        field.name: getattr(message, field.name)
        for field in fields(message)
        if isinstance(getattr(message, field.name), float) and field.name not in SHARES
    }


def test_each_number_of_the_message_is_that_of_the_estimate() -> None:
    given = {name: 1.0 + index for index, name in enumerate(NUMBERS)}
    message = fill_gap_estimate(
        blank("knee_gap_msgs/msg/GapEstimate"), GapEstimate(5, "world", GapStatus.VALID, **given)
    )
    assert numbers_of(message) == given


def test_what_is_not_known_is_nan_with_a_reason() -> None:
    estimate = GapEstimate(5, "world", GapStatus.NO_EDGES, rejection=Rejection(Reason.SILENCE))
    message = fill_gap_estimate(blank("knee_gap_msgs/msg/GapEstimate"), estimate)
    assert np.isnan([*numbers_of(message).values()]).all()
    assert np.isnan([getattr(message, name) for name in SHARES]).all()
    assert message.reason == Reason.SILENCE
    assert message.status == GapStatus.NO_EDGES
