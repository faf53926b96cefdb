"""The knee's shape and its truth, against brute force and against its own pictures."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from knee_gap_core.values.edges import EdgeKind
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.ground_truth import Visibility
from knee_gap_simulation.knee.scene import NEAREST_WITHIN, KneeScene
from knee_gap_simulation.knee_simulator import KneeSimulator
from knee_gap_simulation.surfaces.distance_field import CONDYLE, MENISCUS, PLATEAU

SEEDS = (3, 17, 40)


@pytest.fixture(scope="module")
def simulator() -> KneeSimulator:
    return KneeSimulator(1, 17, gap=0.004, depth=0.010, duration_s=0.5, difficulty={"texture": 0})


@pytest.fixture(scope="module")
def frames(simulator):
    return list(simulator.frames(0, 30, 15))


def surface_samples(scene: KneeScene, surface: int, start: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Points of one surface: where lines from start (n, 3) along towards (3,) first change its side."""
    reach = np.linspace(0.0, 0.012, 801)
    line = start[:, None] + reach[:, None] * towards
    distance = scene.distance(line.reshape(-1, 3), surface).reshape(len(start), len(reach))
    first = (distance < 0.0).argmax(axis=1)
    return line[np.arange(len(start)), first][(distance < 0.0).any(axis=1)]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_gap_is_the_smallest_distance_between_the_surfaces(seed):
    """Against brute force over dense samples of both surfaces: they come no nearer, and nearly as near."""
    scene = KneeScene.random(0.0045, seed)
    nearest, below, above = scene.nearest_distance()
    assert nearest == pytest.approx(0.0045, abs=1e-8)
    assert np.linalg.norm(above - below) == pytest.approx(nearest, abs=1e-12)
    assert np.abs(scene.distance(above, CONDYLE)) < 1e-9
    everywhere = np.linspace(-NEAREST_WITHIN, NEAREST_WITHIN, 49), np.linspace(-0.004, 0.006, 81)
    closely = below[0] + 4e-4 * np.linspace(-1.0, 1.0, 41), below[2] + 4e-4 * np.linspace(-1.0, 1.0, 41)
    for grid, lower_bound, upper_bound in ((everywhere, 3e-5, 4e-4), (closely, 3e-5, 6e-5)):
        x, z = (part.ravel() for part in np.meshgrid(*grid, indexing="ij"))
        down = np.stack([x, np.full(x.shape, -0.002), z], axis=-1)
        lower = np.vstack(
            [surface_samples(scene, s, down, np.array([0.0, 1.0, 0.0])) for s in (MENISCUS, PLATEAU)]
        )
        wide = np.stack([x + above[0] - below[0], np.full(x.shape, 0.0), z + above[2] - below[2]], axis=-1)
        upper = surface_samples(scene, CONDYLE, wide, np.array([0.0, -1.0, 0.0]))
        brute = cKDTree(upper).query(lower)[0].min()
        assert nearest - lower_bound < brute < nearest + upper_bound


def test_rays_stop_at_the_first_surface(simulator, frames):
    """Walk each ray in small steps: all free before the hit, on the surface at it."""
    T_scene_lens = inverse(simulator.T_world_scene) @ frames[0].T_world_lens
    pixels = np.random.default_rng(4).uniform([290.0, 5.0], [990.0, 710.0], (300, 2))
    bearings = simulator.lens.bearings(pixels)
    bearings = bearings[np.isfinite(bearings[:, 0])]
    origin, directions = T_scene_lens[:3, 3], bearings @ T_scene_lens[:3, :3].T
    points, normals, surfaces, lengths = simulator.scene.cast(origin, directions)
    assert len(set(surfaces)) >= 3
    assert (np.einsum("ij,ij->i", normals, directions) < 1e-2).all()
    for point, surface in zip(points, surfaces, strict=True):
        assert abs(simulator.scene.distance(point, int(surface))[0]) < 2e-6
    share = np.linspace(0.0, 1.0, 400)[:-1]
    walk = origin + (share[:, None, None] * lengths[:, None]) * directions
    assert simulator.scene.distance(walk.reshape(-1, 3)).min() > -2e-6


def test_hits_are_exact(simulator, frames):
    """Off grazing rays the surface is met to a nanometre, not merely to the renderer's tolerance."""
    pixels = np.random.default_rng(5).uniform([400.0, 60.0], [880.0, 660.0], (200, 2))
    points = simulator.points(frames[0], pixels)
    T_scene_world = inverse(simulator.T_world_scene)
    local = points.points @ T_scene_world[:3, :3].T + T_scene_world[:3, 3]
    observation = frames[0].T_world_lens[:3, 3] - points.points
    facing = (
        np.einsum("ij,ij->i", points.normals, observation / np.linalg.norm(observation, axis=1)[:, None])
        > 0.1
    )
    for place, surface in zip(local[facing], points.surfaces[facing], strict=True):
        assert abs(simulator.scene.distance(place, int(surface))[0]) < 1e-9


def test_points_are_found_again(simulator, frames):
    """A visible point's pixel in a later frame shows that very point."""
    pixels = np.random.default_rng(6).uniform([420.0, 80.0], [860.0, 640.0], (120, 2))
    points = simulator.points(frames[0], pixels)
    same = simulator.follow(points, frames[0])
    seen = same.visibility == Visibility.VISIBLE
    assert np.abs(same.pixels - pixels).max() < 1e-6
    assert seen.mean() > 0.95
    later = simulator.follow(points, frames[1])
    there = simulator.points(frames[1], later.pixels[later.visible])
    assert np.linalg.norm(there.points - points.points[later.visible], axis=1).max() < 60e-6
    assert np.abs(later.pixels - pixels)[later.visible].max() > 0.5


def test_hidden_points_are_told(simulator, frames):
    points = simulator.points(frames[0], [[642.0, 250.0]])
    lens = frames[0].T_world_lens[:3, 3]
    deeper = points._replace(points=points.points + 0.1 * (points.points - lens))
    assert simulator.follow(deeper, frames[0]).visibility[0] == Visibility.BEHIND_TISSUE
    behind = points._replace(points=2.0 * lens - points.points)
    assert simulator.follow(behind, frames[0]).visibility[0] == Visibility.OUT_OF_VIEW


def test_contour_offsets_agree_with_the_mask(simulator, frames):
    """The distance to the nearest edge, by rays, against that to the nearest gap pixel of the picture."""
    frame = frames[0]
    rows, columns = np.nonzero(frame.gap_mask)
    gap = np.stack([columns, rows], axis=-1).astype(float)
    column = 642
    inside = rows[columns == column]
    for edge, sign, kind in ((inside.min(), -1, EdgeKind.CONTOUR), (inside.max(), 1, EdgeKind.RIM)):
        for away in (4, 12, 25):
            pixel = np.array([column, edge + sign * away], dtype=float)
            observation = simulator.follow(simulator.points(frame, pixel), frame)
            brute = np.linalg.norm(gap - pixel, axis=1).min()
            assert observation.contour_offset_px[0] == pytest.approx(brute, abs=1.2)
            assert observation.edge_kinds[0] == kind
            expected = brute / simulator.lens.focal_px
            assert observation.contour_offset[0] == pytest.approx(expected, rel=0.1, abs=0.003)
    middle = np.array([column, 0.5 * (inside.min() + inside.max())])
    assert not simulator.follow(simulator.points(frame, middle), frame).contour_offset_px[0] > 0.0


def test_the_mask_is_dark(frames):
    for frame in frames:
        brightness = frame.image.max(axis=-1)
        disc = np.hypot(*(np.indices(brightness.shape) - np.array([357.8, 642.6])[:, None, None])) < 350.0
        assert 0.03 < frame.gap_mask.mean() < 0.3
        assert np.median(brightness[frame.gap_mask]) < 0.45 * np.median(brightness[disc & ~frame.gap_mask])


def test_a_closed_joint_shows_no_gap():
    simulator = KneeSimulator(0, 17, gap=None, duration_s=0.1)
    assert simulator.nearest_distance < 0.0
    frame = next(simulator.frames())
    assert frame.gap_mask.mean() < 2e-4
    assert frame.image.max() > 100


def test_a_scene_survives_json():
    scene = KneeScene.random(0.005, 8)
    assert KneeScene.from_dict(json.loads(json.dumps(scene.as_dict()))) == scene


def test_impossible_gaps_are_refused():
    with pytest.raises(SimulationError, match=r"\[1, 12\] mm, not 30 mm"):
        KneeScene.random(0.03, 1)
