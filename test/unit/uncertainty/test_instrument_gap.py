"""The instrument gap against bodies whose gap is known in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vectors import unit

from knee_gap_core.values.edges import EdgeKind
from knee_gap_uncertainty.instrument_gap.gap_kernels import side, widest
from knee_gap_uncertainty.instrument_gap.instrument_gap import (
    CONE,
    CONTOUR_SHAPES,
    TILTS,
    Edges,
    bounds_of_gap,
    edge_points,
    flaw_of,
    instrument_gap,
    opening_of,
    widest_gap,
    worst_case,
)
from knee_gap_uncertainty.multi_view.common_offset import STRAIGHT
from knee_gap_uncertainty.multi_view.maximum_likelihood import MultiViewFit
from knee_gap_uncertainty.two_view.angle_sets import SIGNS
from knee_gap_uncertainty.two_view.translation_volume import displacements

LENS = np.zeros(3)


def tangent(centre, radius, side):
    """Unit vector (3,) from the origin along the tangent to a circle (y, z) and the point that it touches."""
    distance = np.hypot(*centre)
    towards = np.arctan2(centre[0], centre[1])
    angle = towards - side * np.arcsin(radius / distance)
    direction = np.array([0.0, np.sin(angle), np.cos(angle)])
    return direction, direction * np.sqrt(distance**2 - radius**2)


def on_circle(centre, radius, contact, arc, side):
    """The point of a circle `arc` [rad] nearer to the lens than a contact point (3,)."""
    from_centre = contact[1:] - np.array(centre)
    turn = side * arc
    y = np.cos(turn) * from_centre[0] - np.sin(turn) * from_centre[1]
    z = np.sin(turn) * from_centre[0] + np.cos(turn) * from_centre[1]
    return np.array([0.0, centre[0] + y, centre[1] + z])


class TwoCylinders:
    """Cylinders along x on either side of an opening, seen from the origin along z."""

    def __init__(self, centres, radii, arc=0.12):
        self.centres, self.radii = centres, radii
        contacts = [tangent(c, r, s) for c, r, s in zip(centres, radii, (-1.0, 1.0), strict=True)]
        self.edges = np.stack([direction for direction, _ in contacts])
        self.contacts = np.stack([contact for _, contact in contacts])
        self.points = np.stack(
            [
                on_circle(c, r, contact, arc, s)
                for c, r, contact, s in zip(centres, radii, self.contacts, (-1.0, 1.0), strict=True)
            ]
        )

    def gap(self):
        """Width of the widest slab between the cylinders whose middle plane lies within the cone."""
        middle = self.edges.sum(axis=0)
        about = np.arctan2(middle[1], middle[2])
        tilts = about + np.linspace(-CONE, CONE, 2001)
        apart = np.array(self.centres[1]) - np.array(self.centres[0])
        normals = np.stack([np.cos(tilts), -np.sin(tilts)])
        return float((apart @ normals).max() - sum(self.radii))


def bearings(points, lens=LENS):
    return (points - lens) / np.linalg.norm(points - lens, axis=1, keepdims=True)


def fit_of(points, covariance):
    return MultiViewFit(
        points=points,
        gap=float(np.linalg.norm(points[1] - points[0])),
        covariance=covariance,
        centre=np.zeros(3),
        frames=np.zeros((2, 3, 3)),
        unknowns=np.zeros((2, 3)),
        unknowns_covariance=np.zeros((6, 6)),
        chi_square_ratio=1.0,
        scale=1.0,
        used=np.ones((4, 2), bool),
        residuals=np.zeros((4, 2)),
        shares=np.full(4, 0.25),
        bend=STRAIGHT,
    )


def some_cylinders(rng, radii=(0.009, 0.028)):
    """Cylinders as the knee has them: edges 6-18 degrees off the middle, at 8-20 mm."""
    while True:
        lower, upper = rng.uniform(*radii, 2)
        half = np.radians(rng.uniform(6.0, 18.0))
        ranges = rng.uniform(0.009, 0.020, 2)
        centres = []
        for sign, radius, distance in ((-1.0, lower, ranges[0]), (1.0, upper, ranges[1])):
            contact = distance * np.array([sign * np.sin(half), np.cos(half)])
            normal = sign * np.array([np.cos(half), -sign * np.sin(half)])
            centres.append(tuple(contact + radius * normal))
        scene = TwoCylinders(centres, (lower, upper), arc=float(rng.uniform(0.08, 0.2)))
        if scene.gap() > 0.5e-3:
            return scene


@pytest.mark.parametrize("seed", range(12))
def test_with_the_right_radius_the_gap_is_that_between_the_cylinders(seed):
    scene = some_cylinders(np.random.default_rng(seed))
    opening = opening_of(bearings(scene.points), scene.edges)
    ranges = np.linalg.norm(scene.points, axis=1)
    first, second = (np.array([[radius, 1.0]]) for radius in scene.radii)
    found = widest(opening.half, ranges, opening.insets, first, second, TILTS)[0]
    # The distance by which an arc leaves its tangent is taken to second order.
    assert found == pytest.approx(scene.gap(), abs=0.03e-3)


def test_two_flat_faces_that_end_in_rims_leave_what_lies_between_the_rims():
    slope = np.radians(45.0)
    rims = np.array([[0.0, -0.002, 0.012], [0.0, 0.002, 0.012]])
    # The slope of a face is against the line of sight along its edge.
    towards = bearings(rims)
    away = np.array(
        [Rotation.from_rotvec([s * slope, 0, 0]).apply(-d) for s, d in zip((-1, 1), towards, strict=True)]
    )
    points = rims + 0.0005 * away
    opening = opening_of(bearings(points), towards)
    assert (opening.insets > 0.0).all()
    shapes = np.array([[0.0, np.tan(slope)]])
    found = widest(opening.half, np.linalg.norm(points, axis=1), opening.insets, shapes, shapes, TILTS)
    assert found[0] == pytest.approx(0.004, abs=5e-6)
    assert found[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_gap_moves_with_the_scene_and_grows_with_its_scale(seed):
    rng = np.random.default_rng(seed)
    scene = some_cylinders(rng)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.RIM))
    turn, shift = Rotation.random(random_state=seed), rng.uniform(-1.0, 1.0, 3)
    there = widest_gap(scene.points, LENS, opening_of(bearings(scene.points), scene.edges), edges)
    turned = turn.apply(scene.edges)
    moved = turn.apply(scene.points) + shift
    opening = opening_of(bearings(moved, shift), turned)
    assert widest_gap(moved, shift, opening, edges._replace(bearings=turned)) == pytest.approx(
        there, rel=1e-9
    )
    # Rims have no length of their own.
    rims = edges._replace(kinds=(EdgeKind.RIM, EdgeKind.RIM))
    opening = opening_of(bearings(scene.points), scene.edges)
    once, twice = (widest_gap(k * scene.points, LENS, opening, rims) for k in (1.0, 2.0))
    assert twice == pytest.approx(2.0 * once, rel=1e-9)


def test_an_opening_that_is_wider_with_the_same_sides_leaves_more_room():
    scene = some_cylinders(np.random.default_rng(5))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.CONTOUR))
    gaps = []
    for more in np.radians([0.0, 0.3, 0.6]):
        wider = opening._replace(half=opening.half + more)
        gaps.append(widest_gap(scene.points, LENS, wider, edges))
    assert gaps == sorted(gaps)
    assert gaps[0] < gaps[2]


@pytest.mark.parametrize("seed", range(40))
def test_bounds_hold_whatever_the_admitted_errors(seed):
    rng = np.random.default_rng([seed, 31])
    scene = some_cylinders(rng)
    baseline = rng.uniform(0.003, 0.008) * np.array([1.0, 0.0, 0.0])
    psi, theta, shift, edge_error = np.radians(0.5), np.radians(0.4), 0.05e-3, np.radians(0.4)
    lens = [LENS, LENS + baseline]

    def wrong(directions, bound):
        turned = [
            Rotation.from_rotvec(bound * axis / np.linalg.norm(axis)).apply(one)
            for one, axis in zip(directions, rng.standard_normal((2, 3)), strict=True)
        ]
        return np.array(turned)

    present, first = wrong(bearings(scene.points), theta), wrong(bearings(scene.points, lens[1]), theta)
    reported = [place + shift * unit(rng.standard_normal(3)) for place in lens]
    # The edges move across the opening, which is the plane of the cylinders' section.
    signs = rng.choice([-1.0, 1.0], 2)
    edges = np.array(
        [
            Rotation.from_rotvec([sign * edge_error, 0.0, 0.0]).apply(edge)
            for sign, edge in zip(signs, scene.edges, strict=True)
        ]
    )
    opening = opening_of(present, edges)
    lower, upper = worst_case(
        reported[1] - reported[0],
        present,
        first,
        opening,
        Edges(edges, np.full(2, edge_error / 3.0), edge_error, (EdgeKind.CONTOUR, EdgeKind.CONTOUR)),
        psi,
        theta,
        displacements(shift, 1),
        SIGNS["all"],
    )
    assert lower <= scene.gap() <= upper
    assert lower > 0.0


@pytest.mark.parametrize(
    "kinds",
    [
        (EdgeKind.CONTOUR, EdgeKind.CONTOUR),
        (EdgeKind.RIM, EdgeKind.RIM),
        (EdgeKind.UNKNOWN, EdgeKind.UNKNOWN),
    ],
)
def test_the_interval_encloses_the_gap_and_grows_with_each_error(kinds):
    scene = some_cylinders(np.random.default_rng(3))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, kinds)
    exact = instrument_gap(fit_of(scene.points, np.zeros((6, 6))), LENS, opening, edges, 1.96)
    assert exact.lower < exact.gap < exact.upper
    noisy = instrument_gap(fit_of(scene.points, 1e-8 * np.eye(6)), LENS, opening, edges, 1.96)
    assert noisy.upper - noisy.lower > exact.upper - exact.lower
    assert noisy.gap == exact.gap
    blurred = edges._replace(deviations=np.full(2, 5e-3))
    wide = instrument_gap(fit_of(scene.points, np.zeros((6, 6))), LENS, opening, blurred, 1.96)
    assert wide.upper - wide.lower > exact.upper - exact.lower
    assert exact.shares.sum() == pytest.approx(1.0)
    assert wide.shares[0] > exact.shares[0]


def test_points_whose_depth_has_no_bound_leave_the_upper_end_infinite():
    scene = some_cylinders(np.random.default_rng(3))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.RIM))
    found = instrument_gap(fit_of(scene.points, 1e-4 * np.eye(6)), LENS, opening, edges, 1.96)
    assert found.upper == np.inf
    assert np.isfinite(found.lower)


def test_the_axis_leads_away_from_the_lens_within_the_cone():
    scene = some_cylinders(np.random.default_rng(8))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.RIM))
    found = instrument_gap(fit_of(scene.points, np.zeros((6, 6))), LENS, opening, edges, 1.96)
    assert np.linalg.norm(found.axis) == pytest.approx(1.0)
    assert found.axis @ opening.view >= np.cos(CONE) - 1e-12


def test_the_edge_of_a_cylinder_lies_about_where_its_tangent_touches():
    scene = TwoCylinders([(-0.021, 0.012), (0.021, 0.012)], (0.018, 0.018))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.CONTOUR))
    found = edge_points(LENS, scene.points, opening, edges)
    assert np.linalg.norm(found - scene.contacts, axis=1).max() < 0.6e-3


def test_edges_that_cross_and_points_inside_the_opening_are_refused():
    scene = some_cylinders(np.random.default_rng(2))
    points, ranges = bearings(scene.points), np.linalg.norm(scene.points, axis=1)
    assert flaw_of(opening_of(points, scene.edges), ranges, 0.01) == ""
    assert "inside" in flaw_of(opening_of(points, scene.edges[::-1]), ranges, 0.01)
    inside = 0.5 * scene.edges + 0.5 * scene.edges[::-1]
    between = bearings(inside + 0.2 * (scene.edges - inside))
    assert "inside" in flaw_of(opening_of(between, scene.edges), ranges, 0.01)
    one = np.stack([scene.edges[0], scene.edges[0]])
    assert "opening" in flaw_of(opening_of(points, one), ranges, 0.01)


def test_points_that_are_not_beside_their_edges_are_refused():
    scene = some_cylinders(np.random.default_rng(2))
    opening, ranges = opening_of(bearings(scene.points), scene.edges), np.linalg.norm(scene.points, axis=1)
    assert "far from its edge" in flaw_of(opening._replace(insets=np.array([0.03, 0.3])), ranges, 0.01)
    # The same angle is farther from the edge where the tissue is farther from the lens.
    turned = opening._replace(insets=np.array([0.03, 0.08]))
    assert flaw_of(turned, np.array([0.012, 0.012]), 0.01) == ""
    assert "far from its edge" in flaw_of(turned, np.array([0.024, 0.021]), 0.01)
    assert "different distances" in flaw_of(opening, ranges * [1.0, 4.0], 0.01)
    assert flaw_of(opening, np.array([np.nan, 0.01]), 0.01) == ""


@pytest.mark.parametrize("inset", [0.0005, 0.002, 0.02, 0.035])
def test_least_and_greatest_gap_are_so_for_any_error_within_the_bounds(inset):
    """The side is not monotone in the edge's error; both ends are looked for, not assumed."""
    rng = np.random.default_rng(int(1e4 * inset))
    opening = opening_of(bearings(some_cylinders(rng).points), some_cylinders(rng).edges)
    opening = opening._replace(half=0.3, insets=np.full(2, inset), in_plane=np.ones(2))
    ranges, edge_error, image_error = np.array([0.015, 0.013]), 0.011, 0.001
    edges = Edges(
        np.zeros((2, 3)), np.full(2, edge_error / 3.0), edge_error, (EdgeKind.CONTOUR, EdgeKind.CONTOUR)
    )
    lower, upper = bounds_of_gap(ranges, ranges, opening, edges, image_error)
    for _ in range(300):
        wrong = edge_error * rng.uniform(-1.0, 1.0, 2)
        apart = image_error * rng.uniform(-1.0, 1.0, 2)
        first, second = (np.array([CONTOUR_SHAPES[rng.integers(len(CONTOUR_SHAPES))]]) for _ in range(2))
        gap = max(
            side(ranges[0], 0.3 + wrong[0] + tilt, inset - wrong[0] + apart[0], *first[0])
            + side(ranges[1], 0.3 + wrong[1] - tilt, inset - wrong[1] + apart[1], *second[0])
            for tilt in TILTS
        )
        assert lower <= gap <= upper


def test_the_axis_passes_midway_between_what_it_touches():
    scene = TwoCylinders([(-0.021, 0.012), (0.021, 0.019)], (0.018, 0.018))
    opening = opening_of(bearings(scene.points), scene.edges)
    edges = Edges(scene.edges, np.full(2, 1e-3), 3e-3, (EdgeKind.CONTOUR, EdgeKind.CONTOUR))
    found = instrument_gap(fit_of(scene.points, np.zeros((6, 6))), LENS, opening, edges, 1.96)
    away = [
        np.linalg.norm(np.cross(found.axis, np.array([0.0, *centre]) - found.point)) - radius
        for centre, radius in zip(scene.centres, scene.radii, strict=True)
    ]
    assert away == pytest.approx([found.gap / 2.0] * 2, abs=0.15e-3)
