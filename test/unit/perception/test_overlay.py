"""What people see: marks where the points are, words for the status, the image itself untouched."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knee_gap_core.values.edges import EdgeKind, EdgeStatus, GapEdges
from knee_gap_perception.edge_tracking.edge_tracker import GapEdgeTracker
from knee_gap_perception.edge_tracking.overlay import draw_overlay, words


def test_points_are_marked_and_the_image_is_left_alone(joint: Any, travel: Any) -> None:
    image = travel[1][0]
    detector = GapEdgeTracker()
    edges = detector.process(0, image, joint.camera)
    before = image.copy()
    drawn = draw_overlay(image, edges, detector.gap_mask(), detector.reason, joint.camera)
    np.testing.assert_array_equal(image, before)
    changed = (drawn != image).any(axis=2)
    for column, row in np.rint(edges.pixels).astype(int):
        assert changed[row - 3 : row + 4, column - 3 : column + 4].any()
    assert not changed[-20:, -20:].any()


def test_a_larger_error_is_drawn_larger(joint: Any, travel: Any) -> None:
    image = travel[1][0]
    edges = GapEdgeTracker().process(0, image, joint.camera)
    empty = np.zeros((0, 0), np.uint8)
    small = draw_overlay(image, edges, empty, "", joint.camera) != image
    large = (
        draw_overlay(image, replace(edges, covariances=400 * edges.covariances), empty, "", joint.camera)
        != image
    )
    # Two ellipses, twenty times as wide.
    assert large.sum() > small.sum() + 500


def test_nothing_is_drawn_of_unknown_points() -> None:
    image = np.full((240, 320, 3), 90, np.uint8)
    edges = GapEdges.without_points(0, "lens", EdgeStatus.NO_GAP)
    drawn = draw_overlay(image, edges, np.zeros((0, 0), np.uint8), "shaded tissue")
    assert (drawn[60:] == image[60:]).all()
    assert (drawn[:60] != image[:60]).any()


@pytest.mark.parametrize("status", list(EdgeStatus))
def test_every_status_has_words(status: EdgeStatus) -> None:
    edges = replace(GapEdges.without_points(0, "lens", status), angular_error=np.radians(0.5), track_id=3)
    said = words(edges, "a reason")
    assert ("a reason" in said) == (status is not EdgeStatus.VALID)
    assert ("0.50 deg" in said) == (status is EdgeStatus.VALID)


def test_kinds_are_named(joint: Any, travel: Any) -> None:
    image = travel[1][0]
    edges = GapEdgeTracker().process(0, image, joint.camera)
    empty = np.zeros((0, 0), np.uint8)
    rim, contour = (
        draw_overlay(image, replace(edges, kinds=(kind, kind)), empty, "")
        for kind in (EdgeKind.RIM, EdgeKind.CONTOUR)
    )
    assert (rim != contour).any()
