"""The edges at the section, carried on while no image shows them; and the profile along the opening."""

from dataclasses import replace

import numpy as np
import pytest
from vectors import unit

from knee_gap_core.values.edges import EdgeKind, EdgeState, GapEdges, SectionEdges
from knee_gap_core.values.poses import LensPose
from knee_gap_uncertainty.instrument_gap.gap_profile import gap_profile
from knee_gap_uncertainty.instrument_gap.instrument_gap import Edges, opening_of
from knee_gap_uncertainty.instrument_gap.section_edges import NOT_FINITE, NOT_YET, UNSEEN, SectionInView
from knee_gap_uncertainty.scope_calibration.posed_view import PosedView, posed_view

POINTS = np.array([[0.0, -0.003, 0.012], [0.0, 0.003, 0.012]])
EDGES = np.array([[0.0, -0.002, 0.0125], [0.0, 0.002, 0.0125]])
SEEN = (EdgeState.SEEN, EdgeState.SEEN)


def at(seconds, place=(0.0, 0.0, 0.0), states=SEEN, **changes) -> tuple[GapEdges, PosedView]:
    """Observation and view of the points and edges from a lens at a place."""
    stamp_ns = int(1e9 * seconds)
    towards = unit(POINTS - place)
    outer = towards[..., :, None] * towards[..., None, :]
    section = SectionEdges(states, unit(EDGES - place), np.full(2, 1e-3), 3e-3)
    if EdgeState.UNKNOWN in states:
        section = SectionEdges(states)
    if changes:
        section = SectionEdges(**{**section.__dict__, **changes})
    edges = GapEdges.of_points(stamp_ns, 1, towards, 1e-6 * (np.eye(3) - outer), 4e-3)
    edges = replace(edges, kinds=(EdgeKind.CONTOUR, EdgeKind.RIM), section=section)
    pose = LensPose(stamp_ns, "world", np.array(place), np.array([0.0, 0.0, 0.0, 1.0]), 1e-12 * np.eye(6))
    return edges, posed_view(edges, pose, 3.0, 0.0)


HIDDEN = (EdgeState.UNKNOWN, EdgeState.SEEN)


def test_edges_that_are_seen_are_passed_on_in_the_frame_of_the_points():
    found = SectionInView(0.7).at(*at(1.0), 0.012)
    assert isinstance(found, Edges)
    np.testing.assert_allclose(found.bearings, unit(EDGES), atol=1e-12)
    assert found.bounded
    assert found.error == 3e-3


def test_before_any_image_showed_the_edges_there_are_none():
    assert SectionInView(0.7).at(*at(1.0, states=HIDDEN), 0.012) == NOT_YET


def test_hidden_edges_are_carried_on_with_an_error_that_grows_with_time_and_motion():
    section = SectionInView(0.7)
    section.at(*at(1.0), 0.012)
    still = section.at(*at(1.1, states=HIDDEN), 0.012)
    later = section.at(*at(1.5, states=HIDDEN), 0.012)
    moved = section.at(*at(1.5, (0.001, 0.0, 0.0), HIDDEN), 0.012)
    np.testing.assert_allclose(still.bearings, unit(EDGES), atol=1e-9)
    assert 3e-3 < still.error < later.error < moved.error
    # What is added has to cover how far the edges of this scene really went.
    true = unit(EDGES - [0.001, 0.0, 0.0])
    away = np.arccos(np.clip((true * moved.bearings).sum(axis=1), -1.0, 1.0))
    assert away.max() < moved.error


def test_edges_that_are_not_seen_for_too_long_are_given_up():
    section = SectionInView(0.7)
    section.at(*at(1.0), 0.012)
    assert section.at(*at(1.71, states=HIDDEN), 0.012) == UNSEEN
    assert section.at(*at(0.9, states=HIDDEN), 0.012) == UNSEEN


def test_an_edge_at_the_border_bounds_the_gap_from_below_only():
    found = SectionInView(0.7).at(*at(1.0, states=(EdgeState.SEEN, EdgeState.AT_BORDER)), 0.012)
    assert not found.bounded


@pytest.mark.parametrize(
    "changes",
    [
        {"error": np.nan},
        {"error": 0.0},
        {"deviations": np.array([1e-3, -1e-3])},
        {"bearings": np.full((2, 3), np.nan)},
        {"bearings": 2.0 * unit(EDGES)},
    ],
)
def test_edges_with_numbers_that_cannot_be_are_refused(changes):
    assert SectionInView(0.7).at(*at(1.0, **changes), 0.012) == NOT_FINITE


def profile(widths):
    """Profile over sections 1 mm apart along x with half widths [m] at a depth of 12 mm."""
    lens = np.zeros(3)
    sections = []
    for k, width in enumerate(widths):
        x = 1e-3 * (k - len(widths) // 2)
        bearings = unit(np.array([[x, -width, 0.012], [x, width, 0.012]]))
        sections.append(SectionEdges(SEEN, bearings, np.full(2, 1e-3), 3e-3))
    edges = Edges(sections[len(widths) // 2].bearings, np.full(2, 1e-3), 3e-3, (1, 1))
    points = unit(POINTS)
    opening = opening_of(points, edges.bearings)
    ranges = np.linalg.norm(POINTS - lens, axis=1)
    near_far = (0.98 * ranges, 1.02 * ranges)
    return gap_profile(5, "world", 3, sections, np.eye(3), ranges, near_far, opening, edges)


def test_a_slit_of_one_width_has_a_flat_profile_and_the_chosen_section_is_the_widest():
    found = profile([0.002] * 7)
    assert len(found.gap) == 7
    assert np.ptp(found.gap) < 0.15e-3
    assert found.chosen_is_widest
    np.testing.assert_allclose(np.diff(found.position), 1e-3, rtol=0.1)
    assert (found.gap_min <= found.gap).all()
    assert (found.gap <= found.gap_max).all()
    # Away from the points depth is extrapolated.
    width = found.gap_max - found.gap_min
    assert width[0] > width[3] < width[6]


def test_an_opening_that_widens_to_one_side_has_its_widest_section_there():
    found = profile(np.linspace(0.0015, 0.0030, 7))
    assert found.widest == 6
    assert not found.chosen_is_widest


def test_sections_without_both_edges_are_left_out():
    found = profile([0.002, 0.002, np.nan, 0.002, 0.002, 0.002, 0.002])
    assert len(found.gap) == 6
    empty = profile([np.nan, 0.002, np.nan])
    assert empty.widest == 0


def test_an_edge_that_left_the_picture_while_the_other_is_hidden_bounds_from_below_only():
    section = SectionInView(0.7)
    section.at(*at(1.0), 0.012)
    found = section.at(*at(1.1, states=(EdgeState.UNKNOWN, EdgeState.AT_BORDER)), 0.012)
    assert not found.bounded


def test_a_carried_edge_is_as_uncertain_as_the_points_that_carry_it():
    section = SectionInView(0.7)
    section.at(*at(1.0), 0.012)
    # Both the point then and the point now are known to 4e-3 rad.
    assert section.at(*at(1.03, states=HIDDEN), 0.012).error > 3e-3 + 2 * 4e-3
