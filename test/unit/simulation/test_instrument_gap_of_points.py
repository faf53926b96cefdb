"""The instrument gap between points of surfaces whose gap is known exactly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tissue_grids import grid, planes, spread

from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.surfaces.instrument_gap import CONE, REACH, instrument_gap

MICROMETRE = 1e-6


def test_between_two_planes_fits_what_they_are_apart() -> None:
    edges = [[0.4e-3, -2e-3, -1.5e-3], [-0.2e-3, 2e-3, 3.1e-3]]
    found = instrument_gap(planes(2e-3), edges, [0.0, 0.0, 2.0])
    assert found.diameter == pytest.approx(4e-3, abs=2 * MICROMETRE)
    assert abs(found.axis_direction[1]) < 1e-3
    assert np.linalg.norm(found.axis_direction) == pytest.approx(1.0)


@pytest.mark.parametrize("cone", [0.0, 3.0, 6.0, 8.0, 12.0])
def test_a_view_slanted_to_two_planes_loses_what_the_cone_cannot_turn_back(cone: float) -> None:
    """A cylinder of half length R at an angle a to planes 2h apart touches them with the rims of its ends.

    There R sin a + r cos a = h, that is 2r = (2h - 2R sin a) / cos a; a is what the cone leaves of 8 degrees.
    """
    slant, height = np.radians(8.0), 2e-3
    turn = Rotation.from_rotvec([slant, 0.0, 0.0]).as_matrix()
    edges = np.array([[0.0, -height, 0.0], [0.0, height, 0.0]]) @ turn.T
    found = instrument_gap(planes(height, slant), edges, [0.0, 0.0, 1.0], cone=np.radians(cone))
    left = max(0.0, slant - np.radians(cone))
    fits = (2.0 * height - 2.0 * REACH * np.sin(left)) / np.cos(left)
    # The rims of the ends touch between points of the grid, by up to its spacing along the axis.
    assert found.diameter == pytest.approx(fits, abs=2 * MICROMETRE + 0.16e-3 * np.sin(left))


@pytest.mark.parametrize(
    ("view", "cone"), [(0.0, 0.0), (14.0, 0.0), (14.0, 10.0), (-14.0, 10.0), (6.0, 10.0)]
)
def test_between_two_cylinders_at_different_depths(view: float, cone: float) -> None:
    """Seen along u, cylinders with parallel axes L apart leave (C1 - C0) . n - R0 - R1 = L cos a - R0 - R1.

    n is perpendicular to u and the axes, and a the angle of u with what is perpendicular to C1 - C0.
    """
    centres, radii = np.array([[-7.5e-3, 2.0e-3], [4.6e-3, -1.4e-3]]), (5.5e-3, 3.2e-3)
    along = spread(6e-3, 0.08e-3)
    points = []
    for (y, z), radius in zip(centres, radii, strict=True):
        angles = np.linspace(-np.pi, np.pi, round(2 * np.pi * radius / 0.04e-3))
        ring = grid(along, angles)
        points.append(
            np.stack([ring[:, 0], y + radius * np.cos(ring[:, 1]), z + radius * np.sin(ring[:, 1])], axis=-1)
        )
    apart = centres[1] - centres[0]
    distance = float(np.linalg.norm(apart))
    # Turned by `view` from the direction in which the cylinders are farthest apart.
    angle = np.arctan2(-apart[1], apart[0]) + np.radians(view)
    observation = np.array([0.0, np.sin(angle), np.cos(angle)])
    across = np.array([0.0, np.cos(angle), -np.sin(angle)])
    # Lines of sight along u touch where the normal is perpendicular to u.
    edges = [
        np.array([0.0, *centres[0]]) + radii[0] * across,
        np.array([0.0, *centres[1]]) - radii[1] * across,
    ]
    found = instrument_gap(np.concatenate(points), edges, observation, cone=np.radians(cone))
    left = max(0.0, np.radians(abs(view) - cone))
    assert found.diameter == pytest.approx(distance * np.cos(left) - sum(radii), abs=2 * MICROMETRE)


@pytest.mark.parametrize("cone", [0.0, 10.0])
def test_between_a_sphere_and_a_plane_beside_its_lowest_point(cone: float) -> None:
    """An axis at the height q over the plane that passes the centre at a distance a sideways touches both if
    a^2 + (h + R - q)^2 = (R + q)^2, so that q = (a^2 + h^2 + 2 h R) / (2 (h + 2 R)).

    The section lies at x = a0, and the centre z0 behind it: turned sideways by the cone c, the axis passes at
    a = a0 cos c + z0 sin c.
    """
    radius, height, beside, behind = 9e-3, 3e-3, 2.5e-3, 3e-3
    flat = grid(np.arange(-2e-3, 9e-3, 0.08e-3), spread(12e-3, 0.08e-3))
    plane = np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=-1)
    angles = grid(np.arange(0.0, 1.2, 0.006), np.arange(-np.pi, np.pi, 0.006))
    ball = np.stack(
        [
            np.sin(angles[:, 0]) * np.cos(angles[:, 1]),
            np.cos(angles[:, 0]),
            np.sin(angles[:, 0]) * np.sin(angles[:, 1]),
        ],
        axis=-1,
    )
    ball = [0.0, -height - radius, behind] + radius * ball
    top = -height - radius + np.sqrt(radius**2 - beside**2 - behind**2)
    edges = [[beside, top, 0.0], [beside, 0.0, 0.0]]
    found = instrument_gap(np.concatenate([ball, plane]), edges, [0.0, 0.0, 1.0], cone=np.radians(cone))
    aside = beside * np.cos(np.radians(cone)) + behind * np.sin(np.radians(cone))
    fits = (aside**2 + height**2 + 2.0 * height * radius) / (height + 2.0 * radius)
    assert found.diameter == pytest.approx(fits, abs=2 * MICROMETRE)


def test_tissue_before_the_lens_and_beyond_the_reach_does_not_count() -> None:
    edges = [[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]]
    walls = planes(2e-3)
    fits = instrument_gap(walls, edges, [0.0, 0.0, 1.0]).diameter
    plug = np.concatenate([walls, grid(spread(3e-3, 0.1e-3), spread(2e-3, 0.1e-3), np.array([-6e-3]))])
    assert instrument_gap(plug, edges, [0.0, 0.0, 1.0]).diameter < 0.2e-3
    behind_lens = instrument_gap(plug, edges, [0.0, 0.0, 1.0], lens=[0.0, 0.0, -5.9e-3])
    assert behind_lens.diameter == pytest.approx(fits, abs=1e-9)
    assert instrument_gap(plug, edges, [0.0, 0.0, 1.0], reach=5.5e-3).diameter >= fits - 1e-9


@pytest.mark.parametrize(
    ("edges", "view", "cone"),
    [
        ([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [0.0, 0.0, 1.0], CONE),
        ([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], [0.0, 0.0, 1.0], CONE),
        ([[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]], [0.0, 0.0, 0.0], CONE),
        ([[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]], [0.0, np.inf, 1.0], CONE),
        ([[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]], [0.0, 1.0, 0.0], CONE),
        ([[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]], [0.0, 0.0, 1.0], 2.0),
    ],
)
def test_what_is_no_section_is_refused(edges: list[list[float]], view: list[float], cone: float) -> None:
    with pytest.raises(SimulationError):
        instrument_gap(planes(2e-3), edges, view, cone=cone)


def test_points_that_are_none_are_refused() -> None:
    edges = [[0.0, -2e-3, 0.0], [0.0, 2e-3, 0.0]]
    for points in (np.zeros((0, 3)), np.zeros((4, 2)), np.full((4, 3), np.nan)):
        with pytest.raises(SimulationError):
            instrument_gap(points, edges, [0.0, 0.0, 1.0])


# Both scenes
