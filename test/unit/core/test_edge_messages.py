"""Gap edges through their message and back: every field returns, and an unknown code is UNKNOWN."""

from dataclasses import fields

import numpy as np
import pytest

from knee_gap_core.bag.message_types import blank
from knee_gap_core.conversions.edge_messages import edges_from_message, fill_gap_edges
from knee_gap_core.values.edges import EdgeKind, EdgeState, EdgeStatus, GapEdges, SectionEdges


def drawn(seed: int) -> GapEdges:
    """Edges whose fields all differ."""
    rng = np.random.default_rng(seed)

    def section() -> SectionEdges:
        states = (EdgeState.SEEN, EdgeState.AT_BORDER)
        return SectionEdges(states, rng.normal(size=(2, 3)), rng.normal(size=2), 0.3, rng.normal(size=(2, 2)))

    return GapEdges(
        stamp_ns=1_234_567_890_123_456_789,
        frame_id="optical",
        status=EdgeStatus.VALID,
        track_id=4_000_000_001,
        bearings=rng.normal(size=(2, 3)),
        pixels=rng.normal(size=(2, 2)),
        kinds=(EdgeKind.CONTOUR, EdgeKind.RIM),
        covariances=rng.normal(size=(2, 3, 3)),
        angular_error=0.2,
        hidden=(False, True),
        pose_used=True,
        camera_errors=rng.normal(size=(2, 3, 9)),
        section=section(),
        sections=(section(), SectionEdges()),
    )


def sent(edges: GapEdges) -> GapEdges:
    """The edges as a node receives them."""
    return edges_from_message(
        fill_gap_edges(
            blank("knee_gap_msgs/msg/GapEdges"), edges, lambda: blank("knee_gap_msgs/msg/GapSection")
        )
    )


def test_every_field_returns() -> None:
    given = drawn(1)
    received = sent(given)
    for field in fields(GapEdges):
        if not field.name.startswith("section"):
            np.testing.assert_array_equal(getattr(received, field.name), getattr(given, field.name))
    for field in fields(SectionEdges):
        np.testing.assert_array_equal(
            getattr(received.section, field.name), getattr(given.section, field.name)
        )


def test_of_a_further_section_the_bearings_return_and_the_bound_stands_for_their_errors() -> None:
    given = drawn(2)
    received = sent(given)
    assert len(received.sections) == 2
    first, second = received.sections
    np.testing.assert_array_equal(first.bearings, given.sections[0].bearings)
    assert first.error == given.sections[0].error
    np.testing.assert_allclose(first.deviations, 0.1)
    assert first.seen
    assert second.states == (EdgeState.UNKNOWN, EdgeState.UNKNOWN)


def test_camera_errors_that_are_not_known_have_no_columns() -> None:
    assert sent(GapEdges.without_points(1, "optical", EdgeStatus.NO_GAP)).camera_errors.shape == (2, 3, 0)


@pytest.mark.parametrize("name", ["status", "kind_0", "edge_state_1"])
def test_a_code_that_there_is_not_is_unknown(name: str) -> None:
    message = fill_gap_edges(
        blank("knee_gap_msgs/msg/GapEdges"), drawn(3), lambda: blank("knee_gap_msgs/msg/GapSection")
    )
    setattr(message, name, 200)
    received = edges_from_message(message)
    found = {
        "status": received.status,
        "kind_0": received.kinds[0],
        "edge_state_1": received.section.states[1],
    }
    assert found[name] == 0
    assert received.usable == (name != "status")
