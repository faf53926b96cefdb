"""The instrument gap: closed forms, laws, and both scenes against slow independent searches."""

import numpy as np
import pytest
from scipy.optimize import differential_evolution, minimize_scalar
from scipy.spatial.transform import Rotation
from tissue_grids import free_radius

from knee_gap_core.values.arrays import Array
from knee_gap_core.values.rigid_transforms import from_rotation_vectors, inverse
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.scene import KneeScene
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.recordings.scene_truth import SceneTruth
from knee_gap_simulation.recordings.section_truth import edge_contacts, section_truth, true_instrument_gap
from knee_gap_simulation.rims.scene import RimScene
from knee_gap_simulation.scope.arthroscope import Scope
from knee_gap_simulation.scope.hand_motion import HandMotion
from knee_gap_simulation.scope.lens import Lens
from knee_gap_simulation.surfaces.distance_field import CAPSULE, CONDYLE, MENISCUS, PLATEAU
from knee_gap_simulation.surfaces.instrument_gap import CONE, REACH, instrument_gap

MICROMETRE = 1e-6


class Section:
    """A section of a scene: its lens, its edges' bearings, and what was found there."""

    def __init__(self, scene: KneeScene | RimScene, T_scene_lens: Array, place: Array) -> None:
        self.truth = SceneTruth(
            scene, from_rotation_vectors([0.4, -0.2, 0.9], [0.3, -0.1, 1.2]), Lens(), Scope()
        )
        self.scene, self.T_scene_lens = scene, T_scene_lens
        self.T_world_lens = self.truth.T_world_scene @ T_scene_lens
        self.pixel = Lens().pixels(T_scene_lens[:3, :3].T @ (place - T_scene_lens[:3, 3]))
        self.edges = self.truth.edges_at_section(self.T_world_lens, self.pixel)
        self.points = edge_contacts(scene, T_scene_lens, self.edges)
        view = T_scene_lens[:3, :3] @ (self.edges[0] + self.edges[1])
        self.view = view / np.linalg.norm(view)
        self.found = true_instrument_gap(scene, T_scene_lens, self.edges)


def knee_section(level: int, seed: int) -> Section:
    simulator = KneeSimulator(level, seed)
    assert simulator.settings.gap is not None
    middle = simulator.scene.ridge(0.5e-3)[0] - (0.0, 0.5 * simulator.settings.gap, 0.0)
    return Section(simulator.scene, simulator.pose(1.2), middle)


def rim_section(seed: int) -> Section:
    motion = HandMotion(travel=0.008, depth=0.010, seed=seed)
    return Section(RimScene.random(0.004, seed), motion.poses(np.array(1.2)), np.array([0.8e-3, 0.0, 0.0]))


@pytest.fixture(scope="module")
def sections() -> dict[str, Section]:
    return {"knee": knee_section(1, 811), "rough knee": knee_section(3, 812), "rims": rim_section(21)}


NAMES = ("knee", "rough knee", "rims")


def seen_from_the_opening(scene: KneeScene, section: Section) -> Array:
    """Points of the knee where rays end that leave the middle of the opening in all directions."""
    k = np.arange(24000) + 0.5
    height, turn = 1.0 - 2.0 * k / len(k), np.pi * (1.0 + np.sqrt(5.0)) * k
    round_ = np.sqrt(1.0 - height**2)
    rays = np.stack([round_ * np.cos(turn), round_ * np.sin(turn), height], axis=-1)
    points = []
    for step in np.linspace(-1.0, 1.0, 21):
        start = section.found.axis_point + step * REACH * section.found.axis_direction
        if (start - section.T_scene_lens[:3, 3]) @ section.view < 0.0:
            continue
        points.append(scene.cast(start, rays)[0])
    return np.concatenate(points)


def seen_from_above(scene: RimScene) -> Array:
    """Points of both leaves under a grid, and of their rims, by bisection between leaf and wall."""
    down = np.array([0.0, 0.0, 1.0])

    def drop(x: float, ys: Array) -> tuple[Array, Array]:
        hits = [scene.cast(np.array([x, y, -9e-3]), down[None]) for y in ys]
        return np.array([hit[0][0] for hit in hits]), np.array([hit[3][0] for hit in hits])

    points = []
    for x in np.arange(-3.5e-3, 5.0e-3, 0.05e-3):
        leaf, surfaces = drop(
            x, np.concatenate([np.arange(-4e-3, 0.0, 0.1e-3), np.arange(0.0, 4e-3, 0.1e-3)])
        )
        points.append(leaf[surfaces != 2])
        for sign in (-1.0, 1.0):
            low, high = 0.0, 4e-3
            for _ in range(30):
                middle = 0.5 * (low + high)
                if drop(x, np.array([sign * middle]))[1][0] == 2:
                    low = middle
                else:
                    high = middle
            points.append(drop(x, np.array([sign * high]))[0])
    return np.concatenate(points)


@pytest.mark.parametrize("name", NAMES)
def test_a_slow_search_over_points_found_otherwise_agrees(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    scene = section.scene
    cloud = seen_from_the_opening(scene, section) if isinstance(scene, KneeScene) else seen_from_above(scene)
    cloud = cloud[(cloud - section.T_scene_lens[:3, 3]) @ section.view >= 0.0]
    aside = np.linalg.norm(np.cross(cloud - section.points.mean(axis=0), section.view), axis=1)
    cloud = cloud[aside < 0.5 * section.found.diameter + 2.2e-3]
    basis = np.linalg.svd(section.view[None])[2][1:]

    def axis(place: Array) -> tuple[Array, Array]:
        share, polar, azimuth = place
        tilt = np.array([np.cos(azimuth), np.sin(azimuth)]) @ basis
        direction = np.cos(polar) * section.view + np.sin(polar) * tilt
        return section.points[0] + share * (section.points[1] - section.points[0]), direction

    slow = differential_evolution(
        lambda place: -free_radius(cloud, *axis(place)),
        [(0.0, 1.0), (0.0, CONE), (-np.pi, np.pi)],
        seed=5,
        maxiter=40,
        popsize=10,
        tol=1e-7,
    )
    # These points are sparser, so that they leave a little more room, but not to the surface itself.
    assert -2.0 * slow.fun == pytest.approx(section.found.diameter, abs=20 * MICROMETRE)
    crossing, direction = axis(slow.x)
    if isinstance(scene, KneeScene):
        exact = exact_radius_in_knee(section, crossing, direction)
    else:
        exact = free_radius(scene.tissue_samples(crossing, 0.012).points, crossing, direction)
    assert 2.0 * exact < section.found.diameter + MICROMETRE


@pytest.mark.parametrize("name", NAMES)
def test_the_axis_that_is_found_keeps_all_rules(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    found = section.found
    assert np.degrees(np.arccos(found.axis_direction @ section.view)) <= 10.0 + 1e-6
    beside = section.points - found.axis_point
    assert np.linalg.norm(np.cross(*beside)) < 1e-12
    assert beside[0] @ beside[1] < 0.0
    # No instrument is thicker than two points of tissue on both sides of it are apart.
    assert found.diameter < np.linalg.norm(section.points[1] - section.points[0])


@pytest.mark.parametrize("name", NAMES)
def test_more_directions_fit_thicker_instruments(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    gaps = [
        true_instrument_gap(
            section.scene, section.T_scene_lens, section.edges, cone=np.radians(cone)
        ).diameter
        for cone in (0.0, 1.0, 3.0, 5.0, 10.0, 15.0)
    ]
    assert (np.diff(gaps) >= -0.5 * MICROMETRE).all()
    assert gaps[-1] > gaps[0] + 5e-6


@pytest.mark.parametrize("name", NAMES)
def test_the_frame_does_not_matter(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    samples = section.scene.tissue_samples(section.points.mean(axis=0), 0.013).points
    lens = section.T_scene_lens[:3, 3]
    here = instrument_gap(samples, section.points, section.view, lens=lens)
    turn = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
    for rotation in (turn, turn @ np.diag([-1.0, 1.0, 1.0])):
        shift = np.array([0.4, -0.2, 0.1])
        there = instrument_gap(
            samples @ rotation.T + shift,
            section.points @ rotation.T + shift,
            rotation @ section.view,
            lens=rotation @ lens + shift,
        )
        assert there.diameter == pytest.approx(here.diameter, abs=1e-8)
        assert np.linalg.norm(np.cross(there.axis_direction, rotation @ here.axis_direction)) < 1e-2
    # The two edges have no order.
    swapped = instrument_gap(samples, section.points[::-1], section.view, lens=lens)
    assert swapped.diameter == pytest.approx(here.diameter, abs=1e-8)
    # The samples around one section are all that it needs.
    assert section.found.diameter == pytest.approx(here.diameter, abs=2 * MICROMETRE)


def exact_radius_in_knee(section: Section, crossing: Array, direction: Array) -> float:
    """Distance of the surface from an axis: rays at right angles to it, ever finer around the shortest."""
    assert isinstance(section.scene, KneeScene)
    scene, lens = section.scene, section.T_scene_lens[:3, 3]
    first = np.cross(direction, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)

    def lengths(place: float, angles: Array) -> Array:
        rays = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second
        points, _, _, far = scene.cast(crossing + place * direction, rays)
        return np.where((points - lens) @ section.view >= 0.0, far, np.inf)

    places, angles = np.linspace(-REACH, REACH, 400), np.linspace(-np.pi, np.pi, 720)
    coarse = np.array([lengths(place, angles) for place in places])
    best = float(coarse.min())
    for row, column in np.argwhere(coarse < best + 5 * MICROMETRE)[::5]:
        place, angle, step, turn = places[row], angles[column], 50e-6, 0.009
        for _ in range(4):
            around, near = angle + np.linspace(-turn, turn, 15), place + np.linspace(-step, step, 15)
            finer = np.array([lengths(at, around) for at in near.clip(-REACH, REACH)])
            at = np.unravel_index(np.argmin(finer), finer.shape)
            place, angle, step, turn = near[at[0]], around[at[1]], 0.3 * step, 0.3 * turn
        best = min(best, float(finer.min()))
    return best


@pytest.mark.parametrize("name", ["knee", "rough knee"])
def test_samples_of_the_knee_are_dense_enough(sections: dict[str, Section], name: str) -> None:
    """Samples only make a gap too wide, and the exact gap is at least what is free around the axis found."""
    section = sections[name]
    exact = exact_radius_in_knee(section, section.found.axis_point, section.found.axis_direction)
    excess = section.found.diameter - 2.0 * exact
    assert -1e-9 < excess < 2 * MICROMETRE


def test_samples_of_the_rims_are_dense_enough(sections: dict[str, Section]) -> None:
    section = sections["rims"]
    scene, found = section.scene, section.found
    assert isinstance(scene, RimScene)
    exact = []
    for side in (0, 1):

        def away(x: float, side: int = side) -> float:
            return float(
                np.linalg.norm(np.cross(scene.rim(x)[side][0] - found.axis_point, found.axis_direction))
            )

        starts = np.linspace(-3e-3, 4e-3, 141)
        begin = starts[int(np.argmin([away(x) for x in starts]))]
        exact.append(
            minimize_scalar(
                away, bounds=(begin - 1e-4, begin + 1e-4), method="bounded", options={"xatol": 1e-9}
            ).fun
        )
    # It is the rims that the instrument touches, both of them.
    assert -1e-9 < 0.5 * found.diameter - min(exact) < MICROMETRE
    assert max(exact) - min(exact) < MICROMETRE


def test_samples_lie_on_their_surfaces() -> None:
    scene = knee_section(3, 813).scene
    assert isinstance(scene, KneeScene)
    samples = scene.tissue_samples(np.zeros(3), 0.018)
    for side, surfaces in enumerate(((CONDYLE,), (PLATEAU, MENISCUS), (CAPSULE,))):
        points = samples.points[samples.sides == side]
        off = np.min([np.abs(scene.distance(points, surface)) for surface in surfaces], axis=0)
        assert len(points) > 10000
        assert off.max() < 1e-9


# Edges and sections


@pytest.mark.parametrize("name", NAMES)
def test_edges_at_a_section_are_where_the_gap_ends(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    middle = Lens().bearings(section.pixel)
    for edge, point in zip(section.edges, section.points, strict=True):
        inward = (middle - edge) / np.linalg.norm(middle - edge)
        sides = np.stack([edge + 2e-4 * inward, edge - 2e-4 * inward])
        sides /= np.linalg.norm(sides, axis=1)[:, None]
        assert section.scene.looks_into_gap(section.T_scene_lens, sides).tolist() == [True, False]
        # The line of sight touches its point.
        T_lens_scene = inverse(section.T_scene_lens)
        seen = T_lens_scene[:3, :3] @ point + T_lens_scene[:3, 3]
        assert np.linalg.norm(np.cross(seen, edge)) < 20 * MICROMETRE


@pytest.mark.parametrize("name", NAMES)
def test_the_line_across_is_the_narrowest(sections: dict[str, Section], name: str) -> None:
    section = sections[name]
    ends = Lens().pixels(section.edges)
    across = ends[1] - ends[0]
    for turn in (-0.3, -0.1, 0.1, 0.3):
        c, s = np.cos(turn), np.sin(turn)
        direction = np.array([[c, -s], [s, c]]) @ across
        other = section.truth.edges_at_section(section.T_world_lens, section.pixel, direction)
        width = np.linalg.norm(np.diff(Lens().pixels(other), axis=0))
        assert width > np.linalg.norm(across) - 0.1
    assert (section.edges @ section.T_scene_lens[1, :3])[0] < (section.edges @ section.T_scene_lens[1, :3])[1]


def test_no_edges_are_made_up(sections: dict[str, Section]) -> None:
    section = sections["knee"]
    tissue = Lens().pixels(section.edges[0] - 0.1 * (section.edges[1] - section.edges[0]))
    assert np.isnan(section.truth.edges_at_section(section.T_world_lens, tissue)).all()
    assert np.isnan(section.truth.edges_at_section(section.T_world_lens, [3.0, 3.0])).all()
    with pytest.raises(SimulationError):
        section.truth.instrument_gap(section.T_world_lens, np.full((2, 3), np.nan))
    with pytest.raises(SimulationError):
        section.truth.instrument_gap(section.T_world_lens, np.stack([section.edges[0]] * 2))
    middle, across = section.edges.mean(axis=0), section.edges[1] - section.edges[0]
    with pytest.raises(SimulationError, match="off all tissue"):
        section.truth.instrument_gap(section.T_world_lens, middle + np.outer([-0.1, 0.1], across))


@pytest.mark.parametrize("name", NAMES)
def test_a_line_of_sight_that_misses_narrowly_touches_nearly_the_same(
    sections: dict[str, Section], name: str
) -> None:
    """Edges that are read a pixel wrong move the truth by far less than that pixel is wide."""
    section = sections[name]
    across = (
        (section.edges[1] - section.edges[0]) * 2e-3 / np.linalg.norm(section.edges[1] - section.edges[0])
    )
    for wrong in (np.stack([across, -across]), np.stack([-across, across])):
        gap = true_instrument_gap(section.scene, section.T_scene_lens, section.edges + wrong).diameter
        assert gap == pytest.approx(section.found.diameter, abs=15 * MICROMETRE)


def test_the_world_and_the_scene_agree(sections: dict[str, Section]) -> None:
    section = sections["knee"]
    there = section.truth.instrument_gap(section.T_world_lens, section.edges)
    assert there.diameter == pytest.approx(section.found.diameter, abs=1e-12)
    back = there.moved(inverse(section.truth.T_world_scene))
    assert np.allclose(back.axis_point, section.found.axis_point, atol=1e-12)
    assert np.allclose(back.axis_direction, section.found.axis_direction, atol=1e-12)


def test_what_else_is_true_of_a_section(sections: dict[str, Section]) -> None:
    section = sections["knee"]
    truth = section_truth(section.scene, section.T_scene_lens, section.edges)
    assert truth.instrument.diameter == section.found.diameter
    assert truth.along_view.diameter <= truth.instrument.diameter
    assert np.cross(truth.along_view.axis_direction, section.view) == pytest.approx(np.zeros(3), abs=1e-12)
    assert truth.nearest_distance <= truth.edge_distance
    assert truth.across_view < truth.edge_distance
    assert isinstance(section.scene, KneeScene)
    assert truth.nearest_distance >= section.scene.nearest_distance()[0] - 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_the_truth_follows_the_edges_without_jumps(sections: dict[str, Section], name: str) -> None:
    """Edges up to 0.7 degrees inside the opening or in the tissue keep their sides; the truth is smooth."""
    section = sections[name]
    across = (section.edges[1] - section.edges[0]) / np.linalg.norm(section.edges[1] - section.edges[0])
    gaps = []
    for inward in np.radians(np.arange(-0.7, 0.71, 0.1)):
        edges = section.edges + inward * np.stack([across, -across])
        points = edge_contacts(section.scene, section.T_scene_lens, edges)
        assert points[0, 1] < 0.0 < points[1, 1]
        gaps.append(true_instrument_gap(section.scene, section.T_scene_lens, edges).diameter)
    assert np.abs(np.diff(gaps)).max() < 30 * MICROMETRE
    assert np.ptp(gaps) < 150 * MICROMETRE


@pytest.mark.parametrize("yaw", [-40.0, -25.0, 25.0, 40.0])
def test_an_oblique_line_of_sight_touches_what_it_passes(yaw: float) -> None:
    """Rims far to the side, some of them behind the lens, are not what a line of sight comes closest to."""
    scene = RimScene.random(0.004, 7)
    T_scene_lens = from_rotation_vectors(
        [0.0, np.radians(yaw), 0.0], [-np.radians(yaw) * 9e-3, 0.3e-3, -9e-3]
    )
    lens = T_scene_lens[:3, 3]
    upper, lower = scene.rim(0.2e-3)
    for inward in (0.0, 0.008):
        away = np.concatenate([upper, lower]) - lens
        bearings = away / np.linalg.norm(away, axis=1)[:, None] @ T_scene_lens[:3, :3]
        across = (bearings[1] - bearings[0]) / np.linalg.norm(bearings[1] - bearings[0])
        bearings = bearings + inward * np.stack([across, -across])
        for order in ([0, 1], [1, 0]):
            points = edge_contacts(scene, T_scene_lens, bearings[order])[order]
            assert np.linalg.norm(points - np.concatenate([upper, lower]), axis=1).max() < (
                2 * MICROMETRE if inward == 0.0 else 0.4e-3
            )
